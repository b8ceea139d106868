//! P7: a whole shift of a site in virtual time, in one process: what a policy gets out of a fleet under a workload.
//!
//! Modules, from the lowest to the highest: `clock`, `task_records`, `plan_log`, `link`, `robot`, `control_plane`, `floor`,
//! `workload`, `progress`, `run`, `measures`. What is real and what is stood in for stands in `run`.

mod clock;
mod control_plane;
mod floor;
mod link;
mod measures;
mod plan_log;
mod progress;
mod robot;
mod run;
mod task_records;
mod workload;

use crate::figure::Figure;
use floor::{Floor, TaskForm};
use run::ShiftConfig;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use workload::{Arrivals, Demand};

/// A planner's policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Policy {
    /// Tasks in the order of the queue, each to the nearest idle robot.
    FifoNearest,
}

impl Policy {
    const fn name(self) -> &'static str {
        match self {
            Self::FifoNearest => "fifo-nearest",
        }
    }
}

/// What to run.
#[derive(Clone, Debug, clap::Args)]
pub struct ShiftArgs {
    /// Grid map of the floor; without it and --site a small one that is built in.
    #[arg(long, conflicts_with = "site")]
    map: Option<PathBuf>,
    /// Site file of the floor.
    #[arg(long)]
    site: Option<PathBuf>,
    /// List of tasks; without it transports are drawn between stations.
    #[arg(long)]
    tasks: Option<PathBuf>,
    /// Robots.
    #[arg(long, default_value_t = 8)]
    robots: usize,
    /// Hours of virtual time.
    #[arg(long, default_value_t = 8.0)]
    hours: f64,
    /// How robots are chosen.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fifo-nearest")]
    policy: Vec<Policy>,
    /// Runs, each with the next seed from 1.
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    /// Milliseconds that a message takes between a robot and the server.
    #[arg(long, default_value_t = 2)]
    link_ms: u64,
    /// Tasks visit their two places and handle nothing there.
    #[arg(long)]
    visits: bool,
    /// Tasks in an hour of a reference, to stand beside the saturated rate.
    #[arg(long)]
    reference_per_hour: Option<f64>,
}

/// Runs every policy under every workload, once for each seed.
pub fn run(args: &ShiftArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let form = if args.visits { TaskForm::Visits } else { TaskForm::Listed };
    let (site, map, tasks) = (args.site.as_deref(), args.map.as_deref(), args.tasks.as_deref());
    let floor = Arc::new(Floor::read(site, map, tasks, args.robots, form)?);
    let mut figures = Vec::new();
    for policy in &args.policy {
        let mut told = Vec::new();
        for seed in 1..=args.seeds {
            let config = ShiftConfig {
                floor: floor.clone(),
                robots: args.robots,
                lasts: Duration::from_secs_f64(args.hours * 3_600.0),
                seed,
                delay: Duration::from_millis(args.link_ms),
                demand: Demand { arrivals: Arrivals::Saturated, urgent_permille: 0 },
            };
            let outcome = run::run(&config)?;
            let hash = outcome.plans.hash;
            say(&format!("{} W2 seed {seed}: plans {hash:016x}, {} items", policy.name(), outcome.plans.items));
            told.push(measures::measures(&outcome));
        }
        figures.extend(measures::figures(&format!("{} W2", policy.name()), &told, args.reference_per_hour));
    }
    Ok(figures)
}
