//! The commands of the program: those that serve or open what a server keeps, and beside them the command line that asks servers.

mod backup;
mod certificate;
mod interrupts;
mod sim;
mod stop;

use crate::robots;
use crate::robots::AgentRun;
use clap::{Parser, Subcommand};
use interrupts::interrupts;
use midshift_agent::core::ExitReason;
use midshift_agent::launcher::{self, ENVIRONMENT, SWITCHED};
use midshift_agent::{environment, launcher_heartbeat};
use midshift_cli::client::Exit;
use midshift_cli::out::{Format, Out, Output};
use midshift_dev::Dev;
use midshift_process::logs;
use midshift_server::NaiveRules;
use midshift_server::serve;
use midshift_server::serve::Serve;
use midshift_server::storage::Database;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

/// What it says of itself. A program that was built for tests has their naive rules in it and says so: none is ever released.
const VERSION: &str = if NaiveRules::ARE_BUILT_IN
    || midshift_agent::bugs::Bugs::ARE_BUILT_IN
    || midshift_bundle::bugs::Bugs::ARE_BUILT_IN
{
    concat!(env!("CARGO_PKG_VERSION"), " with seeded bugs, for tests only")
} else {
    env!("CARGO_PKG_VERSION")
};

/// A control plane for fleets of working robots. Not a safety function.
#[derive(Parser)]
#[command(name = "midshift", version = VERSION, arg_required_else_help = true)]
struct Args {
    /// How results are printed.
    #[arg(short, long, global = true, value_enum, default_value_t = Output::Table)]
    output: Output,
    /// How log lines look (stderr); their level by MIDSHIFT_LOG.
    #[arg(long, global = true, value_enum, default_value_t = logs::Format::Text)]
    log: logs::Format,
    #[command(subcommand)]
    command: Command,
}

impl Args {
    /// What is said once for all goes where it is needed.
    fn spread(mut self) -> Self {
        if let Command::Serve(serve) = &mut self.command {
            serve.log = self.log;
        }
        self
    }
}

#[derive(Subcommand)]
enum Command {
    /// A whole factory in one process, to try things: simulated robots, in memory, loopback. Not for production.
    Dev(Box<Dev>),
    /// Serve a site: everything persistent, in one process or, with --roles, in several.
    Serve(Serve),
    /// Bring a data directory, or a PostgreSQL database, to this version's schema, without serving.
    Migrate {
        /// The data directory.
        #[arg(long, required_unless_present = "store")]
        data: Option<PathBuf>,
        /// The database instead.
        #[command(flatten)]
        database: Database,
    },
    /// Copy everything durable of a server into a folder, while it serves or not.
    Backup(backup::Take),
    /// Make a data directory of a backup, and its database if it has one, or only look whether the backup is good.
    Restore(backup::Restore),
    /// A robot's agent.
    #[command(subcommand)]
    Agent(AgentVerb),
    /// Start a robot's agent and keep it running; go back to the kept set of software when a new one cannot live.
    #[command(disable_help_flag = true)]
    Launcher {
        /// As for the program midshift-launcher: --record FILE [--sets DIR] [--hang SECONDS] [--beacon HOST:PORT --robot-id ID] -- PROGRAM ARGS…
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, required = true)]
        arguments: Vec<String>,
    },
    /// Simulated robots, and faults in them.
    #[command(subcommand)]
    Sim(sim::Verb),
    /// What servers are asked.
    #[command(flatten, next_display_order = 20)]
    Client(midshift_cli::Command),
    // In the help the last two stand among what servers are asked: `stop` behind `robot`, `certificate` before `doctor`.
    /// Stop robots at once: an operational stop request, not a safety function.
    #[command(display_order = 21)]
    Stop(Box<stop::Stop>),
    /// Certificates of programs that are none of ours: the proxy before a site, the database behind it.
    #[command(subcommand, display_order = 35)]
    Certificate(Box<certificate::Verb>),
}

#[derive(Subcommand)]
enum AgentVerb {
    /// Run one agent with a simulated body, as a real robot would run its own.
    Run(AgentRun),
}

/// Reads the arguments, runs the command, gives the exit code.
pub fn main() -> ExitCode {
    let args = Args::parse().spread();
    if let Command::Launcher { arguments } = args.command {
        // Before anything that a launcher must not need: no runtime, no threads.
        return launcher::main(arguments.into_iter());
    }
    if let Command::Agent(_) = &args.command
        && let Err(error) = launcher_heartbeat::follow_launcher()
    {
        // Nobody would start this agent again, or kill it if it hung.
        let gone = Exit::new(ENVIRONMENT, format!("the launcher that started this agent is not there: {error}"));
        return gone.report(&Out::for_output(args.output));
    }
    if let Command::Stop(stop) = &args.command
        && let Some(arguments) = stop.serves()
    {
        // The same process: whoever has started it goes on with its id, its input and its signals.
        let log = args.log.argument().into_iter();
        let error =
            midshift_server::stop_service::replace_this(&log.chain(arguments.iter().cloned()).collect::<Vec<_>>());
        return Exit::from(error).report(&Out::for_output(args.output));
    }
    let serves = matches!(&args.command, Command::Serve(_) | Command::Agent(_) | Command::Sim(sim::Verb::Run { .. }));
    logs::start(args.log, if serves { "info" } else { "warn" });
    // For as long as the program runs.
    let out: &'static Out = Box::leak(Box::new(Out::for_output(args.output)));
    let makes_page = matches!(&args.command, Command::Client(command) if command.makes_page());
    if out.is_page() && !makes_page {
        return Exit::usage("only `midshift rollout report` makes a page\n  try: -o json").report(out);
    }
    let runtime = match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => return Exit::from(anyhow::anyhow!("starting the runtime: {error}")).report(out),
    };
    let result = runtime.block_on(async {
        tokio::select! {
            result = run(args.command, out) => result,
            () = logs::count_floods(), if serves => unreachable!("it counts for as long as it is let"),
        }
    });
    runtime.shutdown_timeout(Duration::from_secs(2));
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(exit) => exit.report(out),
    }
}

async fn run(command: Command, out: &'static Out) -> Result<(), Exit> {
    match command {
        Command::Dev(args) => develop(*args, out).await,
        Command::Serve(args) => serve_on_workers(args, out).await,
        Command::Migrate { data, database } => migrate(&data.unwrap_or_default(), &database, out).await,
        Command::Backup(args) => backup::back_up(&args, out).await,
        Command::Restore(args) => backup::restore(&args, out).await,
        Command::Agent(AgentVerb::Run(args)) => match robots::agent(args, interrupts()).await {
            Ok(ExitReason::Switched) => Err(Exit::new(SWITCHED, "another set of software is to be started")),
            Ok(ExitReason::Shutdown | ExitReason::FencedTwice) => Ok(()),
            Err(error) if environment::is_to_blame(&*error) => Err(Exit::new(ENVIRONMENT, format!("{error:#}"))),
            Err(error) => Err(error.into()),
        },
        Command::Launcher { .. } => unreachable!("runs before the runtime"),
        Command::Sim(verb) => sim::run(verb, out).await,
        Command::Client(command) => midshift_cli::run(command, out).await,
        Command::Stop(stop) => stop::run(*stop, out).await,
        Command::Certificate(verb) => certificate::run(*verb, interrupts(), out).await,
    }
}

/// On the runtime's own threads: the one that waits for this would be one more to wake for each commit.
async fn serve_on_workers(args: serve::Serve, out: &'static Out) -> Result<(), Exit> {
    let served = tokio::spawn(async move { serve::run(args, interrupts(), &|text| out.line(text)).await });
    match served.await {
        Ok(ended) => Ok(ended?),
        Err(error) => std::panic::resume_unwind(error.into_panic()),
    }
}

async fn develop(args: Dev, out: &Out) -> Result<(), Exit> {
    let bounded = args.run_for.is_some() || args.scenario.is_some();
    let report = midshift_dev::run(args, interrupts(), &|text| out.inform(text)).await?;
    if !bounded {
        return Ok(());
    }
    out.inform(&report.summary());
    match report.objections() {
        objections if objections.is_empty() => Ok(()),
        objections => Err(anyhow::anyhow!("the run is not good: {}", objections.join("; ")).into()),
    }
}

async fn migrate(data: &std::path::Path, database: &Database, out: &Out) -> Result<(), Exit> {
    let files = database.migrate(data).await?;
    let json = |f: &midshift_store::Migrated| serde_json::json!({"file": f.file, "fromVersion": f.from, "toVersion": f.to, "applied": f.applied.len()});
    match out.format {
        Format::Table => files.iter().for_each(|f| {
            out.line(&format!("{}  {} -> {}  {} migrations applied", f.file, f.from, f.to, f.applied.len()));
        }),
        Format::Name => files.iter().for_each(|f| out.line(f.file)),
        Format::Json => out.value(&files.iter().map(json).collect())?,
        Format::Jsonl => files.iter().map(json).try_for_each(|file| out.value(&file))?,
    }
    Ok(())
}

#[cfg(test)]
mod deployed;
#[cfg(test)]
mod metrics_page;
#[cfg(test)]
mod page;
#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_arguments_hang_together() {
        Args::command().debug_assert();
    }

    #[test]
    fn the_help_lists_each_command_beside_those_of_its_kind() {
        let help = Args::command().render_help().to_string();
        let lines = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
        let listed: Vec<&str> =
            lines.filter(|line| !line.starts_with("   ")).filter_map(|line| line.split_whitespace().next()).collect();
        let servers = ["dev", "serve", "migrate", "backup", "restore", "agent", "launcher", "sim"];
        let work = ["task", "robot", "stop", "resume", "zone", "incident", "area", "planner", "map"];
        let software = ["bundle", "rollout", "quarantine"];
        let rights = ["audit", "login", "context", "token", "certificate", "doctor", "health", "explain-error", "help"];
        assert_eq!(listed, [&servers[..], &work, &software, &rights].concat());
    }
}
