//! P7: a whole shift of a site in virtual time, in one process: what a policy gets out of a fleet under a workload.
//!
//! Real are the intake of tasks, telemetry with its sessions, fleet's reconciler with its planner and its law of traffic,
//! the agents' cores, and the simulated bodies with their world and its judge. Stood in for are:
//! 1. The store, by its model in memory.
//! 2. The transport: messages pass from hand to hand as values, after a fixed delay (`link`).
//! 3. The shell of an agent: its ledger is durable at once, and it has no bulk connection and no launcher (`robot`).
//! 4. The time: tokio's paused clock. A plan takes as much of it as `--plan-ms` says, by default
//!    none, and the planner rests as long, as it does by its own time; a commit takes none.
//!
//! Left out are the port, identity, stops, roll-outs, and housekeeping: a shift is shorter than what any of it keeps.
//!
//! Modules, from the lowest to the highest: `background_task`, `clock`, `task_records`, `plan_log`, `link`, `robot`,
//! `control_plane`, `floor`, `operator`, `workload`, `scenario`, `progress`, `run`, `measures`, `chart`.

mod background_task;
mod chart;
mod clock;
mod control_plane;
mod floor;
mod link;
mod measures;
mod operator;
mod plan_log;
mod progress;
mod robot;
mod run;
mod scenario;
mod task_records;
mod workload;

use crate::arguments::parse_time;
use crate::figure::Figure;
use chart::Course;
use clap::builder::RangedU64ValueParser;
use floor::{Floor, TaskForm};
use midshift_proto::fleet::v1::AssignmentPolicy;
use plan_log::PlansNoted;
use run::{Answers, Outcome, ShiftConfig};
use scenario::{Scenario, Workload};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// A planner's policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Policy {
    /// Tasks in the order of the queue, each to the nearest idle robot.
    FifoNearest,
    /// All that wait and all robots at once, by least cost.
    Rolling,
}

impl Policy {
    const fn name(self) -> &'static str {
        match self {
            Self::FifoNearest => "fifo-nearest",
            Self::Rolling => "rolling",
        }
    }

    const fn rules(self) -> AssignmentPolicy {
        match self {
            Self::FifoNearest => AssignmentPolicy::FifoNearest,
            Self::Rolling => AssignmentPolicy::Rolling,
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
    /// How many robots work.
    #[arg(long, default_value_t = 8, value_parser = RangedU64ValueParser::<usize>::new().range(1..))]
    robots: usize,
    /// Hours of virtual time.
    #[arg(long, default_value_t = 8.0, value_parser = parse_time)]
    hours: f64,
    /// How robots are chosen.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fifo-nearest,rolling")]
    policy: Vec<Policy>,
    /// Runs, each with the next seed from 1.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,
    /// What is asked of the fleet.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "w2")]
    workload: Vec<Workload>,
    /// Half an hour and two seeds.
    #[arg(long, conflicts_with_all = ["hours", "seeds"])]
    quick: bool,
    /// Also draw throughput and queue over time into this file.
    #[arg(long)]
    svg: Option<PathBuf>,
    /// Milliseconds that a message takes between a robot and the server.
    #[arg(long, default_value_t = 2)]
    link_ms: u64,
    /// Milliseconds that each turn of the planner takes, after which it rests as long.
    #[arg(long, default_value_t = 0)]
    plan_ms: u64,
    /// Milliseconds between two heartbeats, at least 100; without it as the server says.
    #[arg(long, value_parser = clap::value_parser!(u64).range(100..))]
    heartbeat_ms: Option<u64>,
    /// Tasks visit their two places and handle nothing there.
    #[arg(long)]
    visits: bool,
    /// Nobody answers tasks in NEEDS_OPERATOR.
    #[arg(long)]
    no_operator: bool,
    /// Bodies face their way at once, and do not turn on the spot.
    #[arg(long)]
    no_turns: bool,
    /// Tasks in an hour of a reference, to stand beside the saturated rate.
    #[arg(long)]
    reference_per_hour: Option<f64>,
}

/// The saturated rate is measured over at most so long.
const SATURATED: Duration = Duration::from_secs(2 * 3_600);
/// What `--quick` runs: hours of virtual time, and seeds.
const QUICK: (f64, u64) = (0.5, 2);

impl ShiftArgs {
    fn lasts(&self) -> Duration {
        Duration::from_secs_f64(if self.quick { QUICK.0 } else { self.hours } * 3_600.0)
    }

    fn seeds(&self) -> u64 {
        if self.quick { QUICK.1 } else { self.seeds }
    }

    fn config(&self, floor: &Arc<Floor>, seed: u64, policy: Policy, scenario: Scenario) -> ShiftConfig {
        ShiftConfig {
            floor: floor.clone(),
            robots: self.robots,
            lasts: self.lasts(),
            seed,
            delay: Duration::from_millis(self.link_ms),
            turn: Duration::from_millis(self.plan_ms),
            heartbeat: self.heartbeat_ms.map(Duration::from_millis),
            turns: !self.no_turns,
            answers: if self.no_operator { Answers::None } else { Answers::Given },
            policy: policy.rules(),
            scenario,
        }
    }
}

/// Runs every policy under every workload, once for each seed.
pub fn run(args: &ShiftArgs, say: &dyn Fn(&str)) -> anyhow::Result<Vec<Figure>> {
    let form = if args.visits { TaskForm::Visits } else { TaskForm::Listed };
    let (site, map, tasks) = (args.site.as_deref(), args.map.as_deref(), args.tasks.as_deref());
    let floor = Arc::new(Floor::read(site, map, tasks, args.robots, form)?);
    let seeds: Vec<u64> = (1..=args.seeds()).collect();
    let saturated = saturated_rates(args, &floor, &seeds)?;
    let (mut figures, mut courses) = (Vec::new(), Vec::new());
    for policy in &args.policy {
        for workload in &args.workload {
            for nth in 0..workload.scenarios(0.0, args.lasts()).len() {
                let mut outcomes = Vec::new();
                for (seed, per_hour) in seeds.iter().zip(&saturated) {
                    let scenario = workload.scenarios(*per_hour, args.lasts()).swap_remove(nth);
                    let title = format!("{} {}", policy.name(), scenario.name);
                    let outcome = run::run(&args.config(&floor, *seed, *policy, scenario))?;
                    say(&describe_end(&title, *seed, &outcome));
                    outcomes.push((title, outcome));
                }
                let title = outcomes.first().map(|(title, _)| title.clone()).unwrap_or_default();
                let outcomes: Vec<Outcome> = outcomes.into_iter().map(|(_, outcome)| outcome).collect();
                let told: Vec<_> = outcomes.iter().map(measures::measures).collect();
                let reference = args.reference_per_hour.filter(|_| *workload == Workload::W2);
                figures.extend(measures::figures(&title, &told, reference));
                courses.push(Course::new(title, &outcomes));
            }
        }
    }
    if let Some(path) = &args.svg {
        std::fs::write(path, chart::draw(&courses))?;
    }
    Ok(figures)
}

/// What was planned, and what was left at the end.
fn describe_end(title: &str, seed: u64, outcome: &Outcome) -> String {
    let open = outcome.open_tasks().into_iter().map(|((phase, why), n)| format!("{n} {phase} {why}"));
    let open: Vec<String> = open.map(|line| line.trim_end().to_owned()).collect();
    let open = if open.is_empty() { "none".to_owned() } else { open.join(", ") };
    let PlansNoted { hash, items, .. } = outcome.plans;
    format!("{title}, seed {seed}: plans {hash:016x}, {items} items; open tasks: {open}")
}

/// Tasks in an hour of `fifo-nearest` with always enough of them, by seed: what loads are multiples of. None needs it: zeros.
fn saturated_rates(args: &ShiftArgs, floor: &Arc<Floor>, seeds: &[u64]) -> anyhow::Result<Vec<f64>> {
    if !args.workload.iter().any(|workload| workload.needs_saturated_rate()) {
        return Ok(vec![0.0; seeds.len()]);
    }
    let rate = |seed: &u64| {
        let scenario = Workload::W2.scenarios(0.0, args.lasts()).swap_remove(0);
        let mut config = args.config(floor, *seed, Policy::FifoNearest, scenario);
        config.lasts = config.lasts.min(SATURATED);
        Ok(measures::tasks_per_hour(&run::run(&config)?))
    };
    seeds.iter().map(rate).collect()
}
