//! The projection itself: fleet's tables, what is derived from them, and what only this process knows.
//!
//! Every room of `fleet` reads it. Rows come in by `loading`; `index` keeps what is derived.

use super::broken_steps::{BrokenSteps, StepMemory};
use super::chosen::Chosen;
use super::memory::{Agenda, AttachedTime, Lasting, Meant, UnansweredOffers, Unexplained, Waiting};
use super::plans::Plans;
use super::queue::{Ended, Queue};
use super::ready::ReadyTasks;
use super::refused::Refused;
use super::rows::{
    AreaBudget, CommandKey, Drain, FleetMark, HoldToken, Incident, Place, PlaceBlock, PlaceHolder, RobotAuthority,
    RobotControl, RobotCounter, RobotHolder, ServiceClock, SiteRow, Timer,
};
use super::same_key::SameKey;
use super::start_estimates::{Outlook, Starts};
use crate::desired_state::{DesiredPolicy, DesiredWork};
use crate::drain_request::{DrainRelease, DrainRequest};
use crate::energy::RobotEnergy;
use crate::fleet::bugs::Bugs;
use crate::identity::RobotIdentity;
use crate::ids::{AttemptId, RobotId, TaskId};
use crate::planner_policy::PlannerPolicy;
use crate::policy::AreaPolicy;
use crate::projection::{Indexed, projection};
use crate::reason::Reason;
use crate::rows::Seq;
use crate::session::{LaneMark, Session};
use crate::site::Site;
use crate::site::route::{Blocked, Router};
use crate::stop::record::StopRecord;
use crate::task::{Attempt, TaskIntake, TaskState};
use crate::time::{Now, Utc};
use crate::unknown_rows::UnknownRows;
use smol_str::format_smolstr;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, OnceLock};

projection! {
    /// What fleet knows.
    pub struct FleetProjection of Fleet;
    new(site: Arc<Site>, started: Now, read: Now);
    whole {
        /// Deadlines that are rows.
        timers: Timer = Timer;
        /// Hold tokens of robots.
        holds: HoldToken = HoldToken Indexed;
        /// Passages and standing places.
        places: Place = PlaceGrant Indexed;
        /// Places into which nobody is let, as people say.
        place_blocks: PlaceBlock = PlaceBlock Indexed;
        /// Robots' mutexes.
        authority: RobotAuthority = RobotAuthority Indexed;
        /// Cordons and breakers.
        control: RobotControl = RobotControl Indexed;
        /// Work done.
        counters: RobotCounter = RobotCounter Indexed;
        /// The site row.
        sites: SiteRow = Site;
        /// Rules of areas.
        policies: AreaPolicy = AreaPolicy Indexed;
        /// Rules of the planner: one row at most.
        planner_policies: PlannerPolicy = PlannerPolicy;
        /// Section `work` of each robot.
        desired_work: DesiredWork = DesiredWork;
        /// Section `policy` of each robot.
        desired_policy: DesiredPolicy = DesiredPolicy;
        /// Serving time.
        clocks: ServiceClock = ServiceClock;
        /// Consumed position.
        marks: FleetMark = FleetMark;
        /// What people should look into.
        incidents: Incident = Incident Indexed;
        /// Drains that have not been released.
        drains: Drain = Drain Indexed;
        /// Drains that the rollout service asks for (ota's).
        drain_requests: DrainRequest = DrainRequest;
        /// Drains that may end (ota's).
        drain_releases: DrainRelease = DrainRelease;
        /// Robots of areas that are out of work.
        budgets: AreaBudget = AreaBudget;
        /// Robots that somebody enrolled or may (identity's).
        enrolled: RobotIdentity = RobotIdentity;
        /// Newest sessions (telemetry's).
        sessions: Session = Session Indexed;
        /// Durable lane numbers (telemetry's).
        lane_marks: LaneMark = LaneMark;
        /// Copies of fleet stops (stop's).
        stops: StopRecord = StopRecord Indexed;
    }
    part {
        /// What was asked for, of tasks that have not ended.
        intakes: TaskIntake = TaskIntake Indexed;
        /// Where tasks are that have not ended.
        tasks: TaskState = TaskState Indexed;
        /// Attempts that are live or still hold a robot, and the last one of each task that has not ended.
        attempts: Attempt = Attempt Indexed;
        /// Used request_ids of the commands that are being carried out: asked by id, and let go with the turn.
        command_keys: CommandKey = CommandKey;
    }
    kept {
        /// Since when a robot waits for a place it cannot have, site clock.
        waits: BTreeMap<RobotId, Waiting> = BTreeMap::new();
        /// How often a robot began to wait for a place.
        place_waits: u64 = 0;
        /// When a robot last had a reason to stand still (held, waiting for a place, not known), site clock: a stall
        /// counts from then.
        excused: BTreeMap<RobotId, crate::time::SiteTime> = BTreeMap::new();
        /// Robots that did not want their last errand, and until when they are left alone, link clock.
        unwilling: BTreeMap<RobotId, crate::time::LinkTime> = BTreeMap::new();
        /// Offers that robots did not answer.
        unanswered_offers: UnansweredOffers = UnansweredOffers::default();
        /// What robots say of themselves that only a person ends.
        lasting: Lasting = Lasting::new();
        /// Robots that ready tasks are meant for once those are free.
        meant: Meant = Meant::default();
        /// Why tasks went to the robots that they went to.
        chosen: Chosen = Chosen::default();
        /// The newest plans, with all that they were decided by.
        plans: Plans = Plans::default();
        /// How soon ready tasks got a robot lately.
        starts: Starts = Starts::default();
        /// Which robots failed a step at a place lately, and which task tries it again.
        steps_failed: StepMemory = StepMemory::default();
        /// Tasks that gave way to an urgent one, and when, site clock.
        gave_way: BTreeMap<TaskId, crate::time::SiteTime> = BTreeMap::new();
        /// What stands without a reason.
        unexplained: Unexplained = Unexplained::default();
        /// The attempt that a robot lists and no row knows, and since when, link clock.
        unknown: BTreeMap<RobotId, (AttemptId, crate::time::LinkTime)> = BTreeMap::new();
        /// Time in which robots were heard since it was last counted.
        attached: BTreeMap<RobotId, AttachedTime> = BTreeMap::new();
        /// Entries of the feed whose items the store refused for good: passed over.
        unusable: BTreeSet<Seq> = BTreeSet::new();
        /// Decisions that the store refuses for good.
        refused: Refused = Refused::default();
        /// Distances and routes, remembered.
        router: Arc<Router> = Arc::new(Router::new(site.clone()));
    }
    anew {
        /// The site, which never changes while fleet runs.
        site: Arc<Site> = site;
        /// Tasks that wait for a robot.
        queue: Queue = Queue::new(read.utc);
        /// Those of them that are ready, by need and goal.
        ready: ReadyTasks = ReadyTasks::default();
        /// Tasks that have not ended, by deadline.
        deadlines: BTreeSet<(Utc, TaskId)> = BTreeSet::new();
        /// What is due by time and not done yet. Volatile.
        agenda: Agenda = Agenda::default();
        /// How tasks ended that a task waits for which has not.
        ended: BTreeMap<TaskId, Ended> = BTreeMap::new();
        /// Steps that no robot is sent to do at one place.
        broken_steps: BrokenSteps = BrokenSteps::default();
        /// Ready tasks with a coalesce key.
        same_key: SameKey = SameKey::default();
        /// How many tasks that have not ended wait for a task.
        dependants: BTreeMap<TaskId, u32> = BTreeMap::new();
        /// Tasks that another one waits for, and that this projection knows nothing of: whoever keeps it asks the store.
        unasked: BTreeSet<TaskId> = BTreeSet::new();
        /// Ended tasks that were let go, and how far the feed had been taken then: it says of them once more what is
        /// known.
        let_go: BTreeMap<TaskId, Seq> = BTreeMap::new();
        /// Drains of each robot.
        drains_of: BTreeMap<RobotId, BTreeSet<String>> = BTreeMap::new();
        /// Those of them that are engaged, by the id of their row: copies of what was reset stay for a quarter.
        engaged: BTreeSet<String> = BTreeSet::new();
        /// A stop was engaged or reset since tokens were last put right.
        stops_changed: bool = false;
        /// What the work of robots costs by what they did; none: nothing was counted of it. Read by [`FleetProjection::energy_of`].
        energy: BTreeMap<RobotId, RobotEnergy> = BTreeMap::new();
        /// Robots that have an attempt.
        at_work: BTreeSet<RobotId> = BTreeSet::new();
        /// Places a robot holds: robot → place ids.
        held_places: BTreeMap<RobotId, BTreeSet<String>> = BTreeMap::new();
        /// Robots whose desired work must be composed again in this cycle.
        dirty: BTreeSet<RobotId> = BTreeSet::new();
        /// Robots whose rules of areas must be composed again in this cycle.
        policy_dirty: BTreeSet<RobotId> = BTreeSet::new();
        /// Last entry of the feed that was taken.
        absorbed: Seq = Seq(0);
        /// Rows were read at this entry: what older entries say of rows is in the projection already, also that a row is
        /// gone.
        read_at: Seq = Seq(0);
        /// Reading of the clocks when fleet started: every lease counts as renewed then, and no timer fires soon after.
        started: Now = started;
        /// Reading of the clocks when the rows were read: serving time goes on from there.
        read: Now = read;
        /// Serving time at that moment.
        served: ServiceClock = ServiceClock::default();
        /// Places that no route may lead into now: found once, until a place or a stop changes. Read by
        /// `routing::closed`. Volatile.
        closed_places: OnceLock<Blocked> = OnceLock::new();
        /// Why each robot gets no work; none: it may. Found at the first explanation of a turn, for all of them.
        /// Volatile.
        screened: OnceLock<BTreeMap<RobotId, Option<Reason>>> = OnceLock::new();
        /// The newest heartbeat of each robot, as (session epoch, number), that was compared with the rows and needs no
        /// second look. Volatile.
        compared: BTreeMap<RobotId, (u64, u64)> = BTreeMap::new();
        /// Number that the store is to go on above, since a robot has applied a generation that it had not given.
        /// Volatile.
        behind: Option<u64> = None;
        /// Rows with a value of a newer version.
        unknown_rows: UnknownRows = UnknownRows::default();
        /// Naive rules for twins of tests; none outside them.
        bugs: Bugs = Bugs::default();
    }
}

impl FleetProjection {
    /// Serving time at `now`.
    pub fn serving(&self, now: &Now) -> ServiceClock {
        ServiceClock {
            site_ms: self.served.site_ms + now.site.since(self.read.site).as_ms(),
            link_ms: self.served.link_ms + now.link.since(self.read.link).as_ms(),
        }
    }

    /// The task's row.
    pub fn task(&self, id: &TaskId) -> Option<&TaskState> {
        self.tasks.get(id.as_str()).map(|t| &t.row)
    }

    /// What was asked for.
    pub fn intake(&self, id: &TaskId) -> Option<&TaskIntake> {
        self.intakes.get(id.as_str()).map(|t| &t.row)
    }

    /// The robot that had the task which this one names in `same_robot_as`. None: it names none, or that has not ended.
    pub fn robot_asked_for(&self, id: &TaskId) -> Option<&RobotId> {
        let named = self.intake(id)?.spec.same_robot_as.as_ref()?;
        self.ended.get(named)?.robot_id.as_ref()
    }

    /// The attempt's row.
    pub fn attempt(&self, id: &AttemptId) -> Option<&Attempt> {
        self.attempts.get(id.to_string().as_str()).map(|a| &a.row)
    }

    /// The attempt that holds the robot.
    pub fn held_by(&self, robot: &RobotId) -> Option<&AttemptId> {
        match self.authority.get(robot.as_str()).map(|a| &a.row.holder) {
            Some(RobotHolder::Attempt(id)) => Some(id),
            _ => None,
        }
    }

    /// Robots that have an attempt, with it, by id.
    pub fn robots_at_work(&self) -> impl Iterator<Item = (&RobotId, &AttemptId)> {
        self.at_work.iter().filter_map(|robot_id| Some((robot_id, self.held_by(robot_id)?)))
    }

    /// Drains of the robot, in whatever state.
    pub fn all_drains_of(&self, robot: &RobotId) -> impl Iterator<Item = &Drain> {
        let ids = self.drains_of.get(robot).into_iter().flatten();
        ids.filter_map(|id| self.drains.get(id.as_str())).map(|d| &d.row)
    }

    /// The drain that the robot is in: the oldest that takes it out of work.
    pub fn drain_of(&self, robot: &RobotId) -> Option<&Drain> {
        self.all_drains_of(robot).filter(|d| d.is_on()).min_by_key(|d| (d.since, d.drain_id.clone()))
    }

    /// Hold tokens of the robot.
    pub fn robot_holds(&self, robot: &RobotId) -> impl Iterator<Item = &HoldToken> {
        let from = format_smolstr!("robot:{robot}:");
        self.holds.range(from.clone()..).take_while(move |(id, _)| id.starts_with(&*from)).map(|(_, h)| &h.row)
    }

    /// What the robot's work costs, as far as its attempts say; else as the model says.
    pub fn energy_of(&self, robot: &RobotId) -> &RobotEnergy {
        self.energy.get(robot).unwrap_or(&RobotEnergy::MODEL)
    }

    /// What a ready task has before it until it gets a robot. A robot that should be free by now says nothing of it. None: it is not ready.
    pub fn start_outlook(&self, task_id: &TaskId, now: Utc) -> Option<Outlook> {
        let (position, rank) = self.queue.position(task_id).zip(self.queue.rank(task_id))?;
        let meant = self.meant.get(task_id).filter(|meant| self.held_by(&meant.robot_id).is_some());
        let meant_free = meant.map(|meant| meant.free).filter(|free| *free > now);
        Some(Outlook { position, since: rank.since, meant_free })
    }

    /// Work done by the robot, by version of its software.
    pub fn counters_of(&self, robot: &RobotId) -> impl Iterator<Item = &RobotCounter> {
        let from = format_smolstr!("{robot}@");
        self.counters.range(from.clone()..).take_while(move |(id, _)| id.starts_with(&*from)).map(|(_, c)| &c.row)
    }

    /// Rules of the planner. Also the default while their row is one of a newer version: robots get work, and a person
    /// is told of the row.
    pub fn planner(&self) -> PlannerPolicy {
        let site_id = self.site.site_id();
        let put = self.planner_policies.get(site_id.as_str()).map(|p| p.row.clone());
        put.unwrap_or_else(|| PlannerPolicy::default_of(site_id.clone()))
    }

    /// Rules of an area, as they are composed for robots and shown to people.
    pub fn policy(&self, area: &crate::ids::AreaId) -> AreaPolicy {
        let known = self.site.find_area(area).map(|at| self.site.area(at));
        match (known, self.policies.get(area.as_str()).map(|p| p.row.clone())) {
            (Some(known), Some(put)) => known.near_people(put),
            (Some(known), None) => known.policy(),
            (None, Some(put)) => put,
            (None, None) => AreaPolicy::default_of(area.clone()),
        }
    }
}

/// Places that a robot holds, with its entry in each.
pub fn held<'a>(view: &'a FleetProjection, robot_id: &RobotId) -> impl Iterator<Item = (&'a Place, &'a PlaceHolder)> {
    let robot_id = robot_id.clone();
    let ids = view.held_places.get(&robot_id).into_iter().flatten();
    ids.filter_map(move |id| {
        let place = &view.places.get(id.as_str())?.row;
        Some((place, place.holder(&robot_id)?))
    })
}
