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
//! `control_plane`, `chargers`, `floor`, `operator`, `breakers`, `lost_robots`, `workload`, `scenario`, `progress`,
//! `run`, `measures`, `chart`.

mod background_task;
mod breakers;
mod chargers;
mod chart;
mod clock;
mod control_plane;
mod floor;
mod link;
mod lost_robots;
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
use floor::{Floor, FloorSource, TaskForm};
use midshift_proto::fleet::v1::AssignmentPolicy;
use plan_log::{PlannerPace, PlansNoted};
use run::{Answers, Outcome, ShiftConfig};
use scenario::{Load, Scenario, Workload};
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
    /// Runs, each with the next seed from 1; W8 runs once.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,
    /// What is asked of the fleet.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "w2")]
    workload: Vec<Workload>,
    /// Chargers of a grid in W5; without it 14 for 50 robots.
    #[arg(long)]
    chargers: Option<usize>,
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
    /// Milliseconds between two wakes of the planner with more than 100 robots; with fewer it plans at each event.
    #[arg(long, default_value_t = 5_000)]
    plan_pause_ms: u64,
    /// Milliseconds between two heartbeats, at least 100; without it as the server says.
    #[arg(long, value_parser = clap::value_parser!(u64).range(100..))]
    heartbeat_ms: Option<u64>,
    /// Tasks visit their two places and handle nothing there.
    #[arg(long)]
    visits: bool,
    /// Nobody answers tasks in NEEDS_OPERATOR, nor lets robots work again whose breaker is open.
    #[arg(long)]
    no_operator: bool,
    /// Bodies face their way at once, and do not turn on the spot.
    #[arg(long)]
    no_turns: bool,
    /// Tasks in an hour of a reference, to stand beside the saturated rate.
    #[arg(long)]
    reference_per_hour: Option<f64>,
}

/// Robots up to which the planner is woken by each event.
const EVENT_DRIVEN_MAX: usize = 100;
/// The saturated rate is measured over at most so long.
const SATURATED: Duration = Duration::from_secs(2 * 3_600);
/// Robots for which a floor has so many chargers in the shift of batteries.
const CHARGERS: (usize, usize) = (50, 14);
/// What `--quick` runs: hours of virtual time, and seeds.
const QUICK: (f64, u64) = (0.5, 2);

impl ShiftArgs {
    fn lasts(&self) -> Duration {
        Duration::from_secs_f64(if self.quick { QUICK.0 } else { self.hours } * 3_600.0)
    }

    fn seeds(&self) -> u64 {
        if self.quick { QUICK.1 } else { self.seeds }
    }

    fn source(&self) -> FloorSource<'_> {
        FloorSource {
            site: self.site.as_deref(),
            map: self.map.as_deref(),
            tasks: self.tasks.as_deref(),
            robots: self.robots,
            form: if self.visits { TaskForm::Visits } else { TaskForm::Listed },
        }
    }

    fn load(&self, saturated_per_hour: f64) -> Load {
        Load { saturated_per_hour, robots: self.robots }
    }

    /// The floor of a workload: the plain one, or one with chargers.
    fn floor_of(&self, workload: Workload, plain: &Arc<Floor>) -> anyhow::Result<Arc<Floor>> {
        match workload {
            Workload::W5 => {}
            Workload::W7 if self.site.is_none() => return Ok(Arc::new(Floor::demo(self.source())?)),
            _ => return Ok(plain.clone()),
        }
        let in_proportion = (self.robots * CHARGERS.1).div_ceil(CHARGERS.0);
        Ok(Arc::new(plain.with_chargers(self.source(), self.chargers.unwrap_or(in_proportion))?))
    }

    fn config(&self, floor: &Arc<Floor>, seed: u64, policy: Policy, scenario: Scenario) -> ShiftConfig {
        let robots = scenario.robots.unwrap_or(self.robots).min(floor.seats());
        let pause = Duration::from_millis(self.plan_pause_ms);
        ShiftConfig {
            floor: floor.clone(),
            robots,
            lasts: self.lasts(),
            seed,
            delay: Duration::from_millis(self.link_ms),
            pace: PlannerPace {
                turn: Duration::from_millis(self.plan_ms),
                pause: if robots > EVENT_DRIVEN_MAX { pause } else { Duration::ZERO },
            },
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
    let floor = Arc::new(Floor::read(args.source())?);
    let seeds: Vec<u64> = (1..=args.seeds()).collect();
    let saturated = saturated_rates(args, &floor, &seeds)?;
    let (mut figures, mut courses) = (Vec::new(), Vec::new());
    for policy in &args.policy {
        for workload in &args.workload {
            let floor = args.floor_of(*workload, &floor)?;
            for nth in 0..workload.scenarios(args.load(0.0), args.lasts()).len() {
                let mut outcomes = Vec::new();
                for (seed, per_hour) in seeds.iter().zip(&saturated).take(workload.seeds_max()) {
                    let scenario = workload.scenarios(args.load(*per_hour), args.lasts()).swap_remove(nth);
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
                figures.extend(measures::backlog_figures(&title, &outcomes));
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
    let list = |counts: Vec<String>| if counts.is_empty() { "none".to_owned() } else { counts.join(", ") };
    let open =
        outcome.open_tasks().into_iter().map(|((phase, why), n)| format!("{n} {phase} {why}").trim_end().to_owned());
    let robots = outcome.verdicts.iter().map(|(code, n)| format!("{n} {code}").trim_end().to_owned());
    let PlansNoted { hash, items, .. } = outcome.end.plans;
    let (open, robots) = (list(open.collect()), list(robots.collect()));
    format!("{title}, seed {seed}: plans {hash:016x}, {items} items; open tasks: {open}; robots: {robots}")
}

/// Tasks in an hour of `fifo-nearest` with always enough of them, by seed: what loads are multiples of. None needs it: zeros.
fn saturated_rates(args: &ShiftArgs, floor: &Arc<Floor>, seeds: &[u64]) -> anyhow::Result<Vec<f64>> {
    if !args.workload.iter().any(|workload| workload.needs_saturated_rate()) {
        return Ok(vec![0.0; seeds.len()]);
    }
    let rate = |seed: &u64| {
        let scenario = Workload::W2.scenarios(args.load(0.0), args.lasts()).swap_remove(0);
        let mut config = args.config(floor, *seed, Policy::FifoNearest, scenario);
        config.lasts = config.lasts.min(SATURATED);
        Ok(measures::tasks_per_hour(&run::run(&config)?))
    };
    seeds.iter().map(rate).collect()
}
