//! One shift from its first heartbeat to its end: opens everything on a runtime whose time is paused, and watches.
//!
//! Invariant: one thread, one time, one seed; nothing reads the wall but what measures it.

use super::clock::VirtualClock;
use super::control_plane::ControlPlane;
use super::floor::Floor;
use super::lost_robots::LossReport;
use super::operator::Operator;
use super::plan_log::PlannerPace;
use super::robot::{Robot, RobotConfig};
use super::scenario::{BATTERY_RATES, BodyFaults, ChargingRule, Scenario};
use super::task_records::{TaskRecord, TaskRecords};
use super::watches::{Answers, Sample, Totals, WatchConfig, Watched, Watches};
use super::workload::Client;
use anyhow::{Context as _, anyhow, bail};
use midshift_core::site::{Source, WaypointIx};
use midshift_core::time::Clock;
use midshift_proto::fleet::v1::PlannerPolicy;
use midshift_sim::energy::EnergyScale;
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig};
use std::collections::BTreeMap;
use std::ops::Range;
use std::panic::AssertUnwindSafe;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::runtime::{RngSeed, UnhandledPanic};
use tokio::task::JoinSet;

/// The fleet is looked at this often, and the person who looks after broken robots goes round.
const LOOK: Duration = Duration::from_secs(5);
/// Robots are switched on one after the other, so far apart.
const SWITCHED_ON: Duration = Duration::from_millis(13);
/// Work begins once every robot has had so long.
const WORK_BEGINS: Duration = Duration::from_secs(3);

/// Obstacles in a kilometre where bodies are delayed.
const DELAYS_PER_KM: f64 = 4.0 * 0.5;

/// Robots up to which the planner is woken by each event, and asked what it does.
pub const EVENT_DRIVEN_MAX: usize = 100;

/// What one shift is.
#[derive(Clone)]
pub struct ShiftConfig {
    /// Where it is.
    pub floor: Arc<Floor>,
    /// How many robots.
    pub robots: usize,
    /// Decides all that is drawn.
    pub seed: u64,
    /// Time that a message takes between a robot and the server, each way.
    pub delay: Duration,
    /// How often the planner has its turn.
    pub pace: PlannerPace,
    /// Pause between two heartbeats; none: as the server says.
    pub heartbeat: Option<Duration>,
    /// State of charge of each robot at the beginning where batteries empty, permille.
    pub charge_permille: u16,
    /// Turning on the spot takes a body time.
    pub turns: bool,
    /// A person answers tasks in NEEDS_OPERATOR.
    pub answers: Answers,
    /// How robots are chosen.
    pub planner: PlannerPolicy,
    /// What is asked for, how long, and what goes wrong.
    pub scenario: Scenario,
}

impl ShiftConfig {
    fn watched(&self) -> WatchConfig {
        WatchConfig {
            site: self.floor.site.clone(),
            scenario: self.scenario.clone(),
            seed: self.seed,
            answers: self.answers,
            asks_planner: self.robots <= EVENT_DRIVEN_MAX && self.pace.turn.is_zero(),
        }
    }
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
    /// Driven with a load within the measured time, millimetres. Where nothing is carried: the ways between the goals of
    /// the tasks that were done in it.
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

/// Runs one shift.
///
/// # Errors
/// A task that is refused, a fleet that the site has no room for, a store that cannot be read, or a service or a robot
/// that fails.
pub fn run(config: &ShiftConfig) -> anyhow::Result<Outcome> {
    let begun = wall();
    config.floor.check_room(config.robots)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_time()
        .start_paused(true)
        .rng_seed(RngSeed::from_bytes(&config.seed.to_le_bytes()))
        .unhandled_panic(UnhandledPanic::ShutdownRuntime)
        .build()?;
    let played = std::panic::catch_unwind(AssertUnwindSafe(|| runtime.block_on(play(config))));
    // Robots and services run for ever: they are dropped where they are.
    runtime.shutdown_background();
    let outcome = played.map_err(|_| anyhow!("a task of it panicked, as is said above"))??;
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
    plane.put_planner(config.planner.clone()).await?;
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
    let mut watches = Watches::new(config.watched(), fleet.clone(), records.clone(), clock.clone());
    while clock.elapsed_ms() < config.scenario.lasts.as_millis() as u64 {
        tokio::select! {
            biased;
            ended = &mut asking => ended?,
            ended = &mut answering => ended?,
            failed = plane.await_failure() => return Err(failed),
            Some(_) = robots.join_next() => bail!("a robot ended by itself"),
            () = tokio::time::sleep(LOOK) => watches.look_around(&mut plane).await?,
        }
    }
    // Before anything is explained: a question is a turn of the planner.
    let (tasks, end) = (records.tasks(), watches.read_totals(&plane)?);
    let Watched { begin, samples, losses } = watches.end();
    let begin = begin.context("the shift ended before anything was measured")?;
    let verdicts =
        if config.robots <= EVENT_DRIVEN_MAX { explain_robots(&plane, &fleet).await? } else { BTreeMap::new() };
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
        losses,
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
        let explained = plane.explain_robot(robot.robot_id()).await?;
        // Of one that could work, why the first waiting task is not given to it.
        let first = explained.candidates.into_iter().next().and_then(|candidate| candidate.reason);
        let code = explained.verdict.or(first).map(|reason| reason.code).unwrap_or_default();
        *verdicts.entry(code).or_default() += 1;
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

/// The bodies. Batteries empty only in the shift of batteries: others may have no chargers.
fn open_fleet(config: &ShiftConfig, clock: &VirtualClock) -> anyhow::Result<Fleet> {
    let faults = match config.scenario.faults {
        BodyFaults::None => FaultRates::none(),
        BodyFaults::Usual => FaultRates::default(),
        BodyFaults::Delays => FaultRates { obstacle_per_km: DELAYS_PER_KM, ..FaultRates::none() },
    };
    let of_site = FleetConfig::new(config.floor.site.clone(), config.robots, config.seed);
    let drains = config.scenario.charging.is_some();
    let energy = if drains { BATTERY_RATES } else { EnergyScale::default() };
    // One that is not full and never empties would go to a charger for its opportunity, and stand there.
    let battery_permille = Some(if drains { config.charge_permille } else { 1_000 });
    let of_shift = FleetConfig { faults, drains, battery_permille, energy, turns: config.turns, ..of_site };
    Ok(Fleet::open(&of_shift, &clock.now())?)
}
