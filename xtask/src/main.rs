//! What a developer and CI run: tests, long fault sweeps, golden files, formatting.
//!
//! Invariant: nothing here decides what is right. It installs tools, builds once, calls cargo and counts; every
//! judgement is a test. Called as `cargo xtask VERB` (an alias in `.cargo/config.toml`).

mod apt;
mod buf;
mod clients;
mod cores;
mod deny;
mod dist;
mod docker;
mod e2e;
mod engine;
mod fetch_tools;
mod fixtures;
mod go;
mod images;
mod parts;
mod programs;
mod quick;
mod round;
mod run;
mod slowest;
mod stack;
mod suite;
mod sweep;
mod workspace;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Command line of the task runner.
#[derive(Parser)]
#[command(name = "cargo xtask", about = "Tests and chores of midshift")]
struct Cli {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Subcommand)]
enum Verb {
    /// Run the whole suite, or only the named parts, and print the minutes of each.
    Test(suite::TestArgs),
    /// Long fault sweeps, of which CI runs a sample: programs that are killed at work, simulated shifts, power cuts of updates, kills at each write of a latch,
    /// stops in simulated cuts and kills, stories, and nights.
    Torture {
        /// Sweeps to run; none: all.
        #[arg(value_enum)]
        sweeps: Vec<sweep::Sweep>,
        /// How many seeds each, and how often split; unless told, 20 kills (about two minutes a seed), 2000 simulated shifts (about a quarter
        /// of a second), 5000 drawn updates (about a tenth of a second), 100 runs of stops (some seconds), 500 shifts of each pair of versions, 2 stories
        /// (about ten minutes), and
        /// split and night (about a quarter of an hour) once. Latch and old sites take none.
        #[arg(long)]
        seeds: Option<u64>,
        /// The first seed of kills, simulation, updates, stops, skew, stories and night; unless told, 1. Split and latch draw nothing and take none. A
        /// failing seed alone: `torture kills|simulation|stops|skew|stories|night --from SEED --seeds 1`; one of updates says its own command.
        #[arg(long)]
        from: Option<u64>,
        /// How long a soak lasts on each engine; unless told, 1.5.
        #[arg(long)]
        hours: Option<f64>,
        /// What runs every night: whole stories and whole nights with four seeds each, and old sites.
        #[arg(long, conflicts_with_all = ["sweeps", "seeds", "hours"])]
        nightly: bool,
    },
    /// The stack of a compose file as processes of this machine, without docker.
    #[command(subcommand)]
    Stack(stack::Verb),
    /// What a run of this version leaves, for the tests of later versions.
    #[command(subcommand)]
    Fixtures(fixtures::Verb),
    /// Everything a release consists of: archives of programs and source, images, digests. Nothing is uploaded.
    Dist(dist::Options),
    /// Write the golden files anew from what the code does now. Read the diff before you commit it.
    Golden,
    /// Format everything, then `golden`.
    Tidy,
}

fn main() -> ExitCode {
    let outcome = workspace::Workspace::find().and_then(|workspace| match Cli::parse().verb {
        Verb::Test(asked) => suite::test(&workspace, &asked),
        Verb::Torture { nightly: true, from, .. } => {
            let amount = sweep::Amount { from, seeds: Some(sweep::NIGHTLY_SEEDS), hours: None };
            sweep::torture(&workspace, &sweep::NIGHTLY, amount)
        }
        Verb::Torture { sweeps, seeds, from, hours, .. } => {
            sweep::torture(&workspace, &sweeps, sweep::Amount { from, seeds, hours })
        }
        Verb::Stack(stack::Verb::Test { binary, docker: true, .. }) => {
            docker::test(&workspace, &stack::midshift(&workspace, binary)?)
        }
        Verb::Stack(verb) => stack::run(&workspace, verb),
        Verb::Fixtures(verb) => fixtures::run(&workspace, verb),
        Verb::Dist(options) => dist::dist(&workspace, &options),
        Verb::Golden => sweep::golden(&workspace),
        Verb::Tidy => sweep::tidy(&workspace),
    });
    match outcome {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            run::tell_person(&format!("error: {error:#}"));
            ExitCode::FAILURE
        }
    }
}
