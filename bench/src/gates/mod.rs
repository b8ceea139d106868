//! Operating characteristics of the gates of a roll-out: how often each is right and wrong, simulated from a seed, beside what the design
//! says, or beside the same number worked out exactly over all outcomes.
//!
//! Invariant: the verdicts are those of `midshift_core::gates`, which a server uses; only the robots and their luck are made up here.

mod luck;
mod robots;
mod tasks;

use crate::figure::Figure;

/// What is simulated.
#[derive(Clone, Debug, clap::Args)]
pub struct GatesArgs {
    /// Decides all that is drawn.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Roll-outs of each kind.
    #[arg(long, default_value_t = 20_000, value_parser = clap::value_parser!(u32).range(100..=1_000_000))]
    runs: u32,
}

/// Robots by count, then tasks by evidence.
pub fn run(args: GatesArgs) -> anyhow::Result<Vec<Figure>> {
    let runs = args.runs as usize;
    let mut figures = robots::computed();
    figures.extend(robots::naive(args.seed, runs));
    figures.extend(robots::sequential(args.seed, runs));
    figures.extend(robots::first_failure(args.seed, runs));
    figures.extend(tasks::figures(args.seed, runs)?);
    Ok(figures)
}
