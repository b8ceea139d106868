//! Figures of midshift beside the raw limits of the same machine in the same run: `cargo run --release -p midshift-bench -- NAME --json FILE`.

mod arguments;
mod child;
mod durable_baseline;
mod edge;
mod engine;
mod figure;
mod fsync;
mod gates;
mod grid_map;
mod link;
mod listen;
mod offer;
mod old_sites;
mod old_store;
mod ota;
mod outcome;
mod plan;
mod process_files;
mod questions;
mod reads;
mod robot;
mod roles;
mod saturation;
mod session_baseline;
mod shift;
mod simulators;
mod soak;
mod start;
mod stop;
mod submit;
mod swarm;
mod task;
mod unary_baseline;
mod usage;
mod watch;
mod worker;

use clap::{Parser, Subcommand};
use outcome::RunOutcome;
use std::future::Future;
use std::path::PathBuf;

/// What can be measured.
#[derive(Clone, Debug, Subcommand)]
enum Name {
    /// One planning cycle of several fleets; and of a server at a site where much is over: its start, a takeover, and answers beside its plans.
    Plan(plan::PlanArgs),
    /// Durable submits, many at once.
    Submit(submit::SubmitArgs),
    /// What a task costs the server from its submit until a robot has done it.
    Task(task::TaskArgs),
    /// From a submit to the offer at an idle robot.
    Offer(offer::OfferArgs),
    /// Many robots on the link once a second, and few at the knee.
    Link(link::LinkArgs),
    /// From the start of a server to its first durable answer, what it takes idle, and until its robots are back after a kill.
    Start(start::StartArgs),
    /// What calls cost that only read, at a site where thousands of tasks are over.
    Reads(reads::ReadsArgs),
    /// A long run of a site at work: whether memory, times and files stay, and nothing is lost.
    Soak(soak::SoakArgs),
    /// How often the gates of a roll-out are right and wrong, simulated from a seed.
    Gates(gates::GatesArgs),
    /// Software of robots: directives, ten thousand robots assigned, the way back; a download at line rate, patches, downloads that are cut off.
    Ota(ota::OtaArgs),
    /// From an engaged stop to its acknowledgement by every robot, with nothing beside, under load, and with everything else broken.
    Stop(stop::StopArgs),
    /// What slow, half-open, broken and flooding peers cost a client that does no harm, and what becomes of them.
    Edge(edge::EdgeArgs),
    /// A whole shift of a site in virtual time: what a policy of the planner gets out of a fleet.
    Shift(shift::ShiftArgs),
    /// Memory of a server with thousands of watches that nobody reads.
    Watch(watch::WatchArgs),
    /// What the other names start: this program in one role.
    #[command(hide = true)]
    Child(roles::ChildArgs),
}

/// Measures one part of midshift. Prints the truth; there are no thresholds.
#[derive(Parser)]
#[command(name = "midshift-bench", version)]
struct Args {
    /// What to measure.
    #[command(subcommand)]
    name: Name,
    /// Also write the figures as a JSON array.
    #[arg(long, global = true)]
    json: Option<PathBuf>,
}

#[expect(clippy::print_stdout, reason = "the table is what this program is for")]
fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let RunOutcome { figures, failed } = match args.name {
        Name::Child(args) => return roles::play(args),
        name => measure(name)?,
    };
    print!("{}", figure::table(&figures));
    if let Some(path) = args.json {
        std::fs::write(path, serde_json::to_string_pretty(&figures)?)?;
    }
    anyhow::ensure!(failed.is_empty(), "not measured: {}", failed.join("; "));
    Ok(())
}

fn measure(name: Name) -> anyhow::Result<RunOutcome> {
    let figures = match name {
        Name::Plan(args) => wait(plan::run(args, &note))?,
        Name::Submit(args) => wait(submit::run(args, &note))?,
        Name::Task(args) => wait(task::run(args, &note))?,
        Name::Offer(args) => wait(offer::run(args, &note))?,
        Name::Link(args) => wait(link::run(args, &note))?,
        Name::Start(args) => wait(start::run(args, &note))?,
        Name::Reads(args) => wait(reads::run(args, &note))?,
        Name::Soak(args) => return wait(async { Ok(soak::run(args, &note).await) }),
        Name::Gates(args) => gates::run(args)?,
        Name::Ota(args) => return wait(async { Ok(ota::run(args, &note).await) }),
        Name::Stop(args) => return wait(async { Ok(stop::run(args, &note).await) }),
        Name::Edge(args) => return wait(async { Ok(edge::run(args, &note).await) }),
        Name::Shift(args) => return Ok(shift::run(&args, &note)),
        Name::Watch(args) => wait(watch::run(args, &note))?,
        Name::Child(_) => anyhow::bail!("a role measures nothing"),
    };
    Ok(RunOutcome { figures, failed: Vec::new() })
}

fn wait<T>(work: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(work)
}

/// Says something beside the figures.
#[expect(clippy::print_stderr, reason = "stdout is the table's")]
fn note(text: &str) {
    eprintln!("{text}");
}
