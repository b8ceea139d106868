//! What is asked of a run of shifts, and what that makes of each of them.

use super::floor::{Floor, FloorSource, TaskForm};
use super::plan_log::PlannerPace;
use super::run::{EVENT_DRIVEN_MAX, ShiftConfig};
use super::scenario::{Load, Scenario, Workload};
use super::watches::Answers;
use crate::arguments::parse_time;
use crate::figure::Figure;
use anyhow::ensure;
use clap::builder::RangedU64ValueParser;
use midshift_core::limits;
use midshift_proto::fleet::v1::{AssignmentPolicy, PlannerPolicy};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// A planner's policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Policy {
    /// Tasks in the order of the queue, each to the nearest idle robot.
    FifoNearest,
    /// All that wait and all robots at once, by least cost.
    Rolling,
    /// The same, and a task gains nothing by waiting.
    RollingUnaged,
}

impl Policy {
    /// As it is written.
    pub const fn name(self) -> &'static str {
        match self {
            Self::FifoNearest => "fifo-nearest",
            Self::Rolling => "rolling",
            Self::RollingUnaged => "rolling-unaged",
        }
    }

    /// What is put for it; what is absent takes its default.
    fn rules(self, ageing_permille: Option<u32>) -> PlannerPolicy {
        let (policy, ageing_permille) = match self {
            Self::FifoNearest => (AssignmentPolicy::FifoNearest, None),
            Self::Rolling => (AssignmentPolicy::Rolling, ageing_permille),
            Self::RollingUnaged => (AssignmentPolicy::Rolling, Some(0)),
        };
        PlannerPolicy { policy: Some(policy.into()), ageing_permille, ..PlannerPolicy::default() }
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
    /// Hours of virtual time; W6 lasts two at least, and W5 is refused below two.
    #[arg(long, default_value_t = 8.0, value_parser = parse_time)]
    hours: f64,
    /// How robots are chosen.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "fifo-nearest,rolling")]
    pub policy: Vec<Policy>,
    /// What a task gains under `rolling` by each second that it has waited, in thousandths of a second on the way.
    #[arg(long)]
    ageing_permille: Option<u32>,
    /// Runs, each with the next seed; W8 runs once.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..))]
    seeds: u64,
    /// Seed of the first run.
    #[arg(long, default_value_t = 1)]
    from: u64,
    /// What is asked of the fleet.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "w2")]
    pub workload: Vec<Workload>,
    /// Chargers of a grid in W5; without it 14 for 50 robots.
    #[arg(long)]
    chargers: Option<usize>,
    /// State of charge of each robot at the beginning of W5, percent: alike, so that all are low together.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u16).range(1..=100))]
    charge_percent: u16,
    /// Half an hour and two seeds, for a look.
    #[arg(long, conflicts_with_all = ["hours", "seeds"])]
    quick: bool,
    /// Also draw throughput and queue over time into this file.
    #[arg(long)]
    pub svg: Option<PathBuf>,
    /// Milliseconds that a message takes between a robot and the server.
    #[arg(long, default_value_t = 2)]
    link_ms: u64,
    /// Milliseconds that each turn of the planner takes, after which it rests as long.
    #[arg(long, default_value_t = 0)]
    plan_ms: u64,
    /// Milliseconds that news wait with more than 100 robots before they wake the planner; with fewer it plans at each
    /// event. It sweeps each 250 ms and plans then as well, so news never wait longer.
    #[arg(long, default_value_t = SWEEP_MS, value_parser = clap::value_parser!(u64).range(..=SWEEP_MS))]
    news_wait_ms: u64,
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
    pub reference_per_hour: Option<f64>,
}

/// The planner sweeps so often, whatever it is told.
const SWEEP_MS: u64 = limits::SWEEP.as_ms();
/// The saturated rate is measured over at most so long.
const SATURATED: Duration = Duration::from_secs(2 * 3_600);
/// Robots for which a floor has so many chargers in the shift of batteries.
const CHARGERS: (usize, usize) = (50, 14);
/// The shift of batteries says nothing of a shorter time: none of them is low before.
const W5_MIN: Duration = Duration::from_secs(2 * 3_600);
/// What `--quick` runs: hours of virtual time, and seeds.
const QUICK: (f64, u64) = (0.5, 2);

impl ShiftArgs {
    /// How long a shift lasts that says nothing else.
    pub fn lasts(&self) -> Duration {
        Duration::from_secs_f64(if self.quick { QUICK.0 } else { self.hours } * 3_600.0)
    }

    /// Seeds of its runs.
    pub fn seeds(&self) -> Range<u64> {
        self.from..self.from.saturating_add(if self.quick { QUICK.1 } else { self.seeds })
    }

    /// Where it takes place.
    pub fn source(&self) -> FloorSource<'_> {
        FloorSource {
            site: self.site.as_deref(),
            map: self.map.as_deref(),
            tasks: self.tasks.as_deref(),
            robots: self.robots,
            form: if self.visits { TaskForm::Visits } else { TaskForm::Listed },
        }
    }

    /// What loads are multiples of.
    pub fn load(&self, saturated_per_hour: f64) -> Load {
        Load { saturated_per_hour, robots: self.robots }
    }

    /// The floor of a workload: the plain one, or one with chargers.
    ///
    /// # Errors
    /// It has no room for the robots or the chargers, or the workload says nothing there.
    pub fn floor_of(&self, workload: Workload, plain: &Arc<Floor>) -> anyhow::Result<Arc<Floor>> {
        match workload {
            Workload::W5 => {
                let in_proportion = (self.robots * CHARGERS.1).div_ceil(CHARGERS.0);
                let floor = plain.with_chargers(self.source(), self.chargers.unwrap_or(in_proportion))?;
                ensure!(floor.site.chargers().next().is_some(), "there is no charger");
                ensure!(self.lasts() >= W5_MIN, "it says nothing in less than {} h", W5_MIN.as_secs() / 3_600);
                Ok(Arc::new(floor))
            }
            Workload::W7 if self.site.is_none() => Ok(Arc::new(Floor::demo(self.source())?)),
            _ => Ok(plain.clone()),
        }
    }

    /// One shift.
    pub fn config(&self, floor: &Arc<Floor>, seed: u64, policy: Policy, scenario: Scenario) -> ShiftConfig {
        let robots = scenario.robots.unwrap_or(self.robots);
        let pause = Duration::from_millis(self.news_wait_ms);
        ShiftConfig {
            floor: floor.clone(),
            robots,
            seed,
            delay: Duration::from_millis(self.link_ms),
            pace: PlannerPace {
                turn: Duration::from_millis(self.plan_ms),
                pause: if robots > EVENT_DRIVEN_MAX { pause } else { Duration::ZERO },
            },
            heartbeat: self.heartbeat_ms.map(Duration::from_millis),
            charge_permille: 10 * self.charge_percent,
            turns: !self.no_turns,
            answers: if self.no_operator { Answers::None } else { Answers::Given },
            planner: policy.rules(self.ageing_permille),
            scenario,
        }
    }

    /// The shift by which the saturated rate is measured.
    pub fn saturated(&self, floor: &Arc<Floor>, seed: u64) -> ShiftConfig {
        let scenario = Workload::W2.scenarios(self.load(0.0), self.lasts().min(SATURATED)).swap_remove(0);
        self.config(floor, seed, Policy::FifoNearest, scenario)
    }

    /// What was asked for, as figures beside the others.
    pub fn settings(&self) -> Vec<Figure> {
        let file = self.map.as_deref().or(self.site.as_deref()).and_then(|path| path.file_name());
        let floor = file.map_or_else(|| "the built-in grid".into(), |name| name.to_string_lossy());
        let values = [
            ("hours", "h", self.lasts().as_secs_f64() / 3_600.0),
            ("robots", "1", self.robots as f64),
            ("seeds", "1", self.seeds().count() as f64),
            ("link, one way", "ms", self.link_ms as f64),
            ("turn of the planner", "ms", self.plan_ms as f64),
        ];
        let figure = |(what, unit, value)| Figure::new("P7", format!("asked, {floor}: {what}"), unit, &[value], None);
        values.into_iter().map(figure).collect()
    }
}
