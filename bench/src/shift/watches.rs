//! What is looked at in a shift every few seconds: tasks, batteries, robots that stand, idle, are lost or out of work,
//! and whether the planner is to be away.

use super::assignment_gaps::{AssignmentGaps, AssignmentWatch};
use super::breakers::BreakerWatch;
use super::clock::VirtualClock;
use super::control_plane::ControlPlane;
use super::lost_robots::{LossReport, LostRobots};
use super::plan_log::PlansNoted;
use super::progress::{NoProgress, Planning, ProgressWatch};
use super::scenario::{BodyFaults, Losses, Scenario};
use super::task_records::{TaskCounts, TaskRecords};
use midshift_agent::body::Body as _;
use midshift_core::ids::TaskId;
use midshift_core::site::Site;
use midshift_core::time::{Clock, SiteTime};
use midshift_sim::fleet::{Fleet, FleetReport};
use std::sync::Arc;
use std::time::Duration;

/// A shift is measured after its first part, which fills the floor with work: a tenth of it, at most so long.
const WARM_UP: Duration = Duration::from_secs(600);

/// What is watched for.
#[derive(Clone)]
pub struct WatchConfig {
    /// The site that is watched.
    pub site: Arc<Site>,
    /// What goes wrong.
    pub scenario: Scenario,
    /// Decides all that is drawn.
    pub seed: u64,
    /// Whether a person lets robots work again.
    pub answers: Answers,
    /// The planner is asked what it does with tasks that wait.
    pub asks_planner: bool,
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
    /// Tasks until then.
    pub counts: TaskCounts,
    /// What was planned.
    pub plans: PlansNoted,
    /// What the bodies did, and whether they broke a rule.
    pub bodies: FleetReport,
    /// Robots with a task that came on with nothing.
    pub no_progress: NoProgress,
    /// Work that was not given; none: the fleet is too large to be asked, or a question takes time.
    pub gaps: Option<AssignmentGaps>,
    /// Robots that a person let work again after their breaker had opened.
    pub reinstated: u64,
}

/// What was seen of a shift.
pub struct Watched {
    /// Up to the beginning of the measured time; none: the shift ended before.
    pub begin: Option<Totals>,
    /// The fleet over the whole shift.
    pub samples: Vec<Sample>,
    /// Of robots that were lost; none: none were to be.
    pub losses: Option<LossReport>,
}

/// All that watches one shift.
pub struct Watches {
    config: WatchConfig,
    fleet: Arc<Fleet>,
    records: Arc<TaskRecords>,
    clock: Arc<VirtualClock>,
    progress: ProgressWatch,
    assignments: Option<AssignmentWatch>,
    breakers: BreakerWatch,
    lost_robots: LostRobots,
    samples: Vec<Sample>,
    begin: Option<Totals>,
}

impl Watches {
    /// Nothing was seen yet.
    pub fn new(config: WatchConfig, fleet: Arc<Fleet>, records: Arc<TaskRecords>, clock: Arc<VirtualClock>) -> Self {
        let lasts = config.scenario.lasts;
        Self {
            progress: ProgressWatch::new(fleet.clone(), records.clone()),
            assignments: config.asks_planner.then(|| AssignmentWatch::new(fleet.clone(), records.clone())),
            breakers: BreakerWatch::new(config.seed),
            lost_robots: LostRobots::new(config.site.clone(), fleet.clone(), lasts, config.seed),
            samples: Vec::new(),
            begin: None,
            config,
            fleet,
            records,
            clock,
        }
    }

    /// Looks at everything once.
    ///
    /// # Errors
    /// The planner fails, or a journal cannot be read.
    pub async fn look_around(&mut self, plane: &mut ControlPlane) -> anyhow::Result<()> {
        let (now, now_ms, scenario) = (self.clock.now().site, self.clock.elapsed_ms(), &self.config.scenario);
        let batteries = scenario.charging.map(|_| Batteries::read(&self.fleet, now)).unwrap_or_default();
        self.samples.push(Sample { at_ms: now_ms, counts: self.records.counts(), batteries });
        let is_away = plane.is_planner_away();
        self.progress.look_at_robots(now, if is_away { Planning::Stopped } else { Planning::Goes });
        if scenario.faults != BodyFaults::None || scenario.charging.is_some() {
            self.fleet.person_round(now, &|task_id: &TaskId| self.records.is_worked_on(task_id));
            if self.config.answers == Answers::Given {
                self.breakers.look_at_robots(plane, now_ms).await?;
            }
        }
        if let Some(assignments) = &mut self.assignments {
            assignments.look_for_gaps(plane, now_ms).await?;
        }
        if scenario.losses == Losses::Two {
            self.lost_robots.look_at_robots(plane, now).await?;
        }
        if let Some(stop) = &scenario.planner_stop {
            let is_away = stop.contains(&Duration::from_millis(now_ms));
            if is_away { plane.stop_planner().await? } else { plane.start_planner() }
        }
        let warm_up = (scenario.lasts / 10).min(WARM_UP);
        if self.begin.is_none() && now_ms >= warm_up.as_millis() as u64 {
            self.begin = Some(self.read_totals(plane)?);
        }
        Ok(())
    }

    /// What is counted up to now.
    ///
    /// # Errors
    /// A journal that cannot be read.
    pub fn read_totals(&self, plane: &ControlPlane) -> anyhow::Result<Totals> {
        Ok(Totals {
            at_ms: self.clock.elapsed_ms(),
            counts: self.records.counts(),
            plans: plane.plan_log.plans(),
            bodies: self.fleet.report(self.clock.now().site)?,
            no_progress: self.progress.no_progress(),
            gaps: self.assignments.as_ref().map(AssignmentWatch::gaps),
            reinstated: self.breakers.reinstated(),
        })
    }

    /// What was seen.
    pub fn end(self) -> Watched {
        let losses = (self.config.scenario.losses == Losses::Two).then(|| self.lost_robots.report());
        Watched { begin: self.begin, samples: self.samples, losses }
    }
}
