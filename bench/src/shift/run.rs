//! One shift from its first heartbeat to its end: opens everything on a runtime whose time is paused, and watches.
//!
//! Invariant: one thread, one time, one seed; nothing reads the wall but what measures it.

use super::background_task::panic_message;
use super::breakers::BreakerWatch;
use super::clock::VirtualClock;
use super::control_plane::ControlPlane;
use super::floor::Floor;
use super::lost_robots::{LossReport, LostRobots};
use super::operator::Operator;
use super::plan_log::{PlannerPace, PlansNoted};
use super::progress::{NoProgress, Planning, ProgressWatch};
use super::robot::{Robot, RobotConfig};
use super::scenario::{BATTERY_RATES, BodyFaults, ChargingRule, Losses, Scenario};
use super::task_records::{TaskCounts, TaskRecord, TaskRecords};
use super::workload::Client;
use anyhow::{Context as _, bail};
use midshift_agent::body::Body as _;
use midshift_core::ids::TaskId;
use midshift_core::site::{Source, WaypointIx};
use midshift_core::time::{Clock, SiteTime};
use midshift_proto::fleet::v1::AssignmentPolicy;
use midshift_sim::energy::EnergyScale;
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig, FleetReport};
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::JoinSet;

/// The fleet is looked at this often, and the person who looks after broken robots goes round.
const LOOK: Duration = Duration::from_secs(5);
/// Robots are switched on one after the other, so far apart.
const SWITCHED_ON: Duration = Duration::from_millis(13);
/// Work begins once every robot has had so long.
const WORK_BEGINS: Duration = Duration::from_secs(3);

/// Obstacles in a kilometre where bodies are delayed.
const DELAYS_PER_KM: f64 = 4.0 * 0.5;

/// Robots that are asked at the end what they do, at most.
const EXPLAINED_MAX: usize = 100;

/// What one shift is.
#[derive(Clone)]
pub struct ShiftConfig {
    /// Where it is.
    pub floor: Arc<Floor>,
    /// How many robots.
    pub robots: usize,
    /// How long it lasts.
    pub lasts: Duration,
    /// Decides all that is drawn.
    pub seed: u64,
    /// Time that a message takes between a robot and the server, each way.
    pub delay: Duration,
    /// How often the planner has its turn.
    pub pace: PlannerPace,
    /// Pause between two heartbeats; none: as the server says.
    pub heartbeat: Option<Duration>,
    /// Turning on the spot takes a body time.
    pub turns: bool,
    /// A person answers tasks in NEEDS_OPERATOR.
    pub answers: Answers,
    /// How robots are chosen.
    pub policy: AssignmentPolicy,
    /// What is asked for, and what goes wrong.
    pub scenario: Scenario,
}

/// Whether a person is at the screen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answers {
    /// Tasks in NEEDS_OPERATOR stay there.
    None,
    /// They are answered after some minutes.
    Given,
}

/// The fleet at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Since the beginning, milliseconds.
    pub at_ms: u64,
    /// Tasks at that moment.
    pub counts: TaskCounts,
    /// Batteries at that moment.
    pub batteries: Batteries,
}

/// The batteries of a fleet at one moment.
#[derive(Clone, Copy, Debug, Default)]
pub struct Batteries {
    /// The lowest of all, permille.
    pub lowest_permille: u16,
    /// Robots into whose battery energy flows.
    pub charging: usize,
}

impl Batteries {
    fn read(fleet: &Fleet, now: SiteTime) -> Self {
        let states: Vec<_> = fleet.robots().iter().map(|robot| robot.state(now)).collect();
        let lowest_permille = states.iter().map(|state| state.battery_permille).min().unwrap_or_default();
        Self { lowest_permille, charging: states.iter().filter(|state| state.charging).count() }
    }
}

/// What was counted from the beginning of a shift up to one moment.
#[derive(Clone)]
pub struct Totals {
    /// That moment, milliseconds since the beginning.
    pub at_ms: u64,
    /// Tasks.
    pub counts: TaskCounts,
    /// What was planned.
    pub plans: PlansNoted,
    /// What the bodies did, and whether they broke a rule.
    pub bodies: FleetReport,
    /// Robots with a task that came on with nothing.
    pub no_progress: NoProgress,
    /// Robots that a person let work again after their breaker had opened.
    pub reinstated: u64,
}

/// What came of a shift.
pub struct Outcome {
    /// Robots that there were.
    pub robots: usize,
    /// The floor is a grid.
    pub is_grid: bool,
    /// Up to the beginning of the measured time.
    pub begin: Totals,
    /// Up to its end, which is that of the shift.
    pub end: Totals,
    /// Driven with a load within the measured time; where nothing is carried, the ways that tasks asked for between their
    /// goals which were done in it. Millimetres.
    pub loaded_mm: u64,
    /// Every task of the whole shift.
    pub tasks: Vec<TaskRecord>,
    /// Whether bodies failed.
    pub faults: BodyFaults,
    /// When robots charged; none: batteries did not empty.
    pub charging: Option<ChargingRule>,
    /// Of robots that were lost; none: none were to be.
    pub losses: Option<LossReport>,
    /// Robots at the end by the code of what they do, or of why they do nothing. Empty: too many to ask.
    pub verdicts: BTreeMap<String, usize>,
    /// The fleet over the whole shift.
    pub samples: Vec<Sample>,
    /// When the planner was away.
    pub planner_stop: Option<Range<Duration>>,
    /// Time that the run took by the wall.
    pub wall: Duration,
}

impl Outcome {
    /// Tasks that were open at the end, by where they were and why.
    pub fn open_tasks(&self) -> BTreeMap<(&'static str, &'static str), usize> {
        let mut open = BTreeMap::new();
        for task in self.tasks.iter().filter(|task| !task.phase.is_terminal()) {
            *open.entry((task.phase.as_str(), task.reason.unwrap_or_default())).or_default() += 1;
        }
        open
    }
}

/// A shift is measured after its first part, which fills the floor with work: a tenth of it, at most so long.
const WARM_UP: Duration = Duration::from_secs(600);

/// Runs one shift.
///
/// # Errors
/// A task that is refused, a fleet that the site has no room for, a store that cannot be read, or a service or a robot
/// that fails.
pub fn run(config: &ShiftConfig) -> anyhow::Result<Outcome> {
    let begun = wall();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build()?;
    let outcome = runtime.block_on(play(config))?;
    // Robots and services run for ever: they are dropped where they are.
    runtime.shutdown_background();
    Ok(Outcome { wall: begun.elapsed(), ..outcome })
}

#[expect(clippy::disallowed_methods, reason = "how long a run takes is real time")]
fn wall() -> Instant {
    Instant::now()
}

async fn play(config: &ShiftConfig) -> anyhow::Result<Outcome> {
    let (floor, clock, records) = (&config.floor, VirtualClock::begin(), Arc::new(TaskRecords::default()));
    let mut plane =
        ControlPlane::open(floor.site.clone(), floor.text.clone(), clock.clone(), records.clone(), config.pace).await?;
    plane.put_planner(config.policy).await?;
    let fleet = Arc::new(open_fleet(config, &clock)?);
    let mut robots = JoinSet::new();
    for (number, body) in (0..).zip(fleet.robots()) {
        let (telemetry, heartbeat) = (plane.telemetry.clone(), config.heartbeat);
        let robot = Robot::new(body.clone(), clock.clone(), telemetry, RobotConfig { delay: config.delay, heartbeat });
        robots.spawn(robot.run(SWITCHED_ON * number));
    }
    if let Some(rule) = config.scenario.charging {
        plane.change_policies(|policy| rule.change_policy(policy)).await?;
    }
    tokio::time::sleep(WORK_BEGINS + SWITCHED_ON * config.robots as u32).await;
    let source = floor.tasks(config.seed)?;
    let client = Client::new(plane.tasks.clone(), source, records.clone(), clock.clone(), config.seed);
    let asking = client.run(config.scenario.demand, config.robots);
    tokio::pin!(asking);
    let operator = Operator::new(plane.tasks.clone(), fleet.clone(), records.clone(), clock.clone(), config.seed);
    let answering = async {
        match config.answers {
            Answers::Given => operator.run().await,
            Answers::None => std::future::pending().await,
        }
    };
    tokio::pin!(answering);
    let mut progress = ProgressWatch::new(fleet.clone(), records.clone());
    let mut lost_robots = LostRobots::new(floor.site.clone(), fleet.clone(), config.lasts, config.seed);
    let (mut breakers, mut samples) = (BreakerWatch::new(config.seed), Vec::new());
    let lasts_ms = config.lasts.as_millis() as u64;
    let warm_up_ms = (config.lasts / 10).min(WARM_UP).as_millis() as u64;
    let read_totals = |plane: &ControlPlane, progress: &ProgressWatch, breakers: &BreakerWatch| {
        let bodies = fleet.report(clock.now().site)?;
        let (at_ms, counts, plans) = (clock.elapsed_ms(), records.counts(), plane.plan_log.plans());
        let (no_progress, reinstated) = (progress.no_progress(), breakers.reinstated());
        anyhow::Ok(Totals { at_ms, counts, plans, bodies, no_progress, reinstated })
    };
    let mut begin = None;
    while clock.elapsed_ms() < lasts_ms {
        tokio::select! {
            biased;
            ended = &mut asking => ended?,
            ended = &mut answering => ended?,
            failed = plane.await_failure() => return Err(failed),
            Some(ended) = robots.join_next() => {
                bail!("a robot ended: {}", ended.err().map_or_else(|| "by itself".to_owned(), panic_message));
            }
            () = tokio::time::sleep(LOOK) => {
                let now = clock.now().site;
                let batteries = config.scenario.charging.map(|_| Batteries::read(&fleet, now)).unwrap_or_default();
                samples.push(Sample { at_ms: clock.elapsed_ms(), counts: records.counts(), batteries });
                let is_away = plane.is_planner_away();
                progress.look_at_robots(now, if is_away { Planning::Stopped } else { Planning::Goes });
                if config.scenario.faults != BodyFaults::None {
                    fleet.person_round(now, &|task_id: &TaskId| records.is_worked_on(task_id));
                }
                if config.scenario.faults != BodyFaults::None && config.answers == Answers::Given {
                    breakers.look_at_robots(&plane, clock.elapsed_ms()).await?;
                }
                if config.scenario.losses == Losses::Two {
                    lost_robots.look_at_robots(&plane, now).await?;
                }
                if let Some(stop) = &config.scenario.planner_stop {
                    let is_away = stop.contains(&Duration::from_millis(clock.elapsed_ms()));
                    if is_away { plane.stop_planner().await? } else { plane.start_planner() }
                }
                if begin.is_none() && clock.elapsed_ms() >= warm_up_ms {
                    begin = Some(read_totals(&plane, &progress, &breakers)?);
                }
            }
        }
    }
    let (tasks, end) = (records.tasks(), read_totals(&plane, &progress, &breakers)?);
    let begin = begin.context("the shift ended before anything was measured")?;
    let verdicts = if config.robots <= EXPLAINED_MAX { explain_robots(&plane, &fleet).await? } else { BTreeMap::new() };
    let carried_mm = end.bodies.loaded_path_mm - begin.bodies.loaded_path_mm;
    Ok(Outcome {
        robots: config.robots,
        is_grid: floor.site.source() == Source::Grid,
        loaded_mm: if end.bodies.loaded_path_mm > 0 { carried_mm } else { sum_ways(floor, &tasks, begin.at_ms) },
        begin,
        end,
        tasks,
        faults: config.scenario.faults,
        charging: config.scenario.charging,
        losses: (config.scenario.losses == Losses::Two).then(|| lost_robots.report()),
        verdicts,
        samples,
        planner_stop: config.scenario.planner_stop.clone(),
        wall: Duration::ZERO,
    })
}

/// What each robot does, or why it does nothing, counted.
async fn explain_robots(plane: &ControlPlane, fleet: &Fleet) -> anyhow::Result<BTreeMap<String, usize>> {
    let mut verdicts = BTreeMap::new();
    for robot in fleet.robots().iter().filter(|_| !plane.is_planner_away()) {
        *verdicts.entry(plane.explain_robot(robot.robot_id()).await?).or_default() += 1;
    }
    Ok(verdicts)
}

/// The ways of tasks that were done since, from the first goal of each to its last. Those to one goal stand beside each
/// other, so that the way there is looked for once.
fn sum_ways(floor: &Floor, tasks: &[TaskRecord], since_ms: u64) -> u64 {
    let is_done = |task: &&TaskRecord| task.done_ms.is_some_and(|at| at >= since_ms);
    let mut done: Vec<&[WaypointIx]> = tasks.iter().filter(is_done).map(|task| &*task.goals).collect();
    done.sort_by_key(|goals| goals.last().copied());
    done.into_iter().map(|goals| floor.way_mm(goals)).sum()
}

/// The bodies. Batteries empty only in the shift of batteries: no other floor has chargers for them.
fn open_fleet(config: &ShiftConfig, clock: &VirtualClock) -> anyhow::Result<Fleet> {
    let faults = match config.scenario.faults {
        BodyFaults::None => FaultRates::none(),
        BodyFaults::Usual => FaultRates::default(),
        BodyFaults::Delays => FaultRates { obstacle_per_km: DELAYS_PER_KM, ..FaultRates::none() },
    };
    let of_site = FleetConfig::new(config.floor.site.clone(), config.robots, config.seed);
    let drains = config.scenario.charging.is_some();
    let energy = if drains { BATTERY_RATES } else { EnergyScale::default() };
    Ok(Fleet::open(&FleetConfig { faults, drains, energy, turns: config.turns, ..of_site }, &clock.now())?)
}
