//! The command line that asks servers: noun then verb. Data to stdout, talk to stderr, `-o json` is the contract.
//!
//! Invariant: nothing here serves, and nothing here opens what a server keeps: that is the program's, which has this crate's commands beside its own. What
//! both need to find a server, or to read a site or a list of tasks, is here.

mod area;
mod audit;
mod bundle;
pub mod client;
pub mod clock;
mod context;
mod contexts;
mod doctor;
mod door;
mod duration;
pub mod endpoint;
pub mod enrol;
mod exit;
mod explain;
mod health;
mod incident;
mod lookup;
mod map;
pub mod out;
pub mod pages;
mod planner;
mod presence;
mod push;
mod quarantine;
mod released;
mod robot;
mod robot_target;
pub mod roles;
mod rollout;
pub mod samples;
pub mod sim;
pub mod site_answer;
pub mod site_file;
pub mod stop;
pub mod stop_service;
mod task;
pub mod task_list;
mod token;
mod zone;

pub use duration::duration;

use clap::Subcommand;
use client::Exit;
use out::Out;
use std::pin::Pin;

/// Everything that this crate runs.
#[derive(Subcommand)]
pub enum Command {
    /// Simulated robots: the program itself parses `sim`, which has a verb that runs some.
    #[command(skip)]
    Sim(sim::Verb),
    /// Stops: the program itself parses `stop`, which has a verb that serves.
    #[command(skip)]
    Stop(Box<stop::Request>),
    /// Tasks: submit, look at, cancel, retry.
    #[command(subcommand)]
    Task(task::Verb),
    /// Robots: look at, take out of work, enrol.
    #[command(subcommand)]
    Robot(robot::Verb),
    /// Let robots and tasks go on that stand held, after their stop was reset: `midshift resume --stop ID`.
    Resume(Box<task::Resume>),
    /// Passages and standing places.
    #[command(subcommand)]
    Zone(zone::Verb),
    /// What a person should look into.
    #[command(subcommand)]
    Incident(incident::Verb),
    /// Live rules of areas.
    #[command(subcommand)]
    Area(area::Verb),
    /// Live rules of the planner: how robots are chosen for tasks.
    #[command(subcommand)]
    Planner(planner::Verb),
    /// Site files.
    #[command(subcommand)]
    Map(map::Verb),
    /// Signed software for robots: keys, building, signing, checking, bringing it to the server.
    #[command(subcommand)]
    Bundle(bundle::Verb),
    /// Roll-outs of software over robots at work, in waves: write one down, check, begin, watch, judge, take back.
    #[command(subcommand)]
    Rollout(Box<rollout::Verb>),
    /// Bundles that robots went back from and do not get again.
    #[command(subcommand)]
    Quarantine(quarantine::Verb),
    /// Who decided what: look, take it away, and check that nothing of it was changed.
    #[command(subcommand)]
    Audit(Box<audit::Verb>),
    /// Sign in to a site: prove it by its root, and remember it with a token.
    Login(context::Login),
    /// Which sites are remembered, and which one is used.
    #[command(subcommand)]
    Context(context::Verb),
    /// Rights of people and programs.
    #[command(subcommand)]
    Token(token::Verb),
    /// Look for what may be wrong: server, store, robots, certificates, clocks, disk, limits, and who can reach what.
    Doctor(doctor::Doctor),
    /// Whether one process serves: exit code 0 or 1, for health checks.
    Health(health::Health),
    /// What a reason means and what to try.
    ExplainError {
        /// The code, e.g. BATTERY_LOW. Without it: all.
        code: Option<String>,
    },
}

impl Command {
    /// Whether it prints a page if one is asked for.
    pub fn makes_page(&self) -> bool {
        matches!(self, Self::Rollout(verb) if verb.makes_page())
    }
}

/// Runs one command. Boxed, so that its body is compiled here and not where it is awaited.
pub fn run(command: Command, out: &Out) -> Pin<Box<dyn Future<Output = Result<(), Exit>> + '_>> {
    Box::pin(dispatch(command, out))
}

async fn dispatch(command: Command, out: &Out) -> Result<(), Exit> {
    match command {
        Command::Sim(verb) => sim::run(verb, out).await,
        Command::Task(verb) => task::run(verb, out).await,
        Command::Robot(verb) => robot::run(verb, out).await,
        Command::Stop(request) => stop::run(*request, out).await,
        Command::Resume(resume) => resume.run(out).await,
        Command::Zone(verb) => zone::run(verb, out).await,
        Command::Incident(verb) => incident::run(verb, out).await,
        Command::Area(verb) => area::run(verb, out).await,
        Command::Planner(verb) => planner::run(verb, out).await,
        Command::Map(verb) => map::run(verb, out).await,
        Command::Bundle(verb) => bundle::run(verb, out).await,
        Command::Rollout(verb) => rollout::run(*verb, out).await,
        Command::Quarantine(verb) => quarantine::run(verb, out).await,
        Command::Audit(verb) => audit::run(*verb, out).await,
        Command::Login(args) => context::login(args, out).await,
        Command::Context(verb) => context::run(verb, out).await,
        Command::Token(verb) => token::run(verb, out).await,
        Command::Doctor(doctor) => doctor::run(&doctor, out).await,
        Command::Health(args) => health::run(args, out).await,
        Command::ExplainError { code } => explain::error(code.as_deref(), out),
    }
}
