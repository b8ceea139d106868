//! The projection itself: fleet's tables, what is derived from them, and what only this process knows.
//!
//! Every room of `fleet` reads it. Rows come in by `loading`; `index` keeps what is derived.

use super::memory::{Agenda, Answers, Attached, Lasting, Unexplained, Waiting};
use super::queue::Queue;
use super::refused::Refused;
use super::rows::{
    AreaBudget, CommandKey, Drain, FleetMark, HoldToken, Incident, Place, PlaceHolder, RobotAuthority, RobotControl,
    RobotCounter, RobotHolder, ServiceClock, SiteRow, Timer,
};
use crate::fleet::bugs::Bugs;
use crate::identity::RobotIdentity;
use crate::ids::{AttemptId, RobotId, TaskId};
use crate::maintenance::{DrainRelease, DrainRequest};
use crate::picture::Slot;
use crate::policy::AreaPolicy;
use crate::reason::Reason;
use crate::rows::Seq;
use crate::site::Site;
use crate::site::route::{Blocked, Router};
use crate::stop::record::StopRecord;
use crate::task::{Attempt, Phase, TaskIntake, TaskState};
use crate::time::{Now, Utc};
use crate::unknown_rows::UnknownRows;
use crate::work::{DesiredPolicy, DesiredWork, LaneMark, Session};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, OnceLock};

/// Fleet's picture.
pub struct View {
    /// The site, which never changes while fleet runs.
    pub site: Arc<Site>,
    /// What was asked for, of tasks that have not ended.
    pub intakes: Slot<TaskIntake>,
    /// Where tasks are that have not ended.
    pub tasks: Slot<TaskState>,
    /// Tasks that wait for a robot.
    pub queue: Queue,
    /// Tasks that have not ended, by deadline.
    pub deadlines: BTreeSet<(Utc, TaskId)>,
    /// What is due by time and not done yet. Volatile.
    pub agenda: Agenda,
    /// How tasks ended that a task waits for which has not.
    pub ended: BTreeMap<TaskId, Phase>,
    /// How many tasks that have not ended wait for a task.
    pub dependants: BTreeMap<TaskId, u32>,
    /// Tasks that another one waits for, and that this picture knows nothing of: whoever keeps it asks the store.
    pub unasked: BTreeSet<TaskId>,
    /// Ended tasks that were let go, and how far the feed had been taken then: it says of them once more what is known.
    pub let_go: BTreeMap<TaskId, Seq>,
    /// Attempts that are live or still hold a robot, and the last one of each task that has not ended.
    pub attempts: Slot<Attempt>,
    /// Deadlines that are rows.
    pub timers: Slot<Timer>,
    /// Hold tokens of robots.
    pub holds: Slot<HoldToken>,
    /// Passages and standing places.
    pub places: Slot<Place>,
    /// Robots' mutexes.
    pub authority: Slot<RobotAuthority>,
    /// Cordons and breakers.
    pub control: Slot<RobotControl>,
    /// Work done.
    pub counters: Slot<RobotCounter>,
    /// The site row.
    pub sites: Slot<SiteRow>,
    /// Rules of areas.
    pub policies: Slot<AreaPolicy>,
    /// Section `work` of each robot.
    pub desired_work: Slot<DesiredWork>,
    /// Section `policy` of each robot.
    pub desired_policy: Slot<DesiredPolicy>,
    /// Serving time.
    pub clocks: Slot<ServiceClock>,
    /// Consumed position.
    pub marks: Slot<FleetMark>,
    /// What people should look into.
    pub incidents: Slot<Incident>,
    /// Drains that have not been released.
    pub drains: Slot<Drain>,
    /// Drains of each robot.
    pub drains_of: BTreeMap<RobotId, BTreeSet<String>>,
    /// Drains that the rollout service asks for (ota's).
    pub drain_requests: Slot<DrainRequest>,
    /// Drains that may end (ota's).
    pub drain_releases: Slot<DrainRelease>,
    /// Robots of areas that are out of work.
    pub budgets: Slot<AreaBudget>,
    /// Used request_ids of the commands that are being carried out: asked by id, and let go with the turn.
    pub command_keys: Slot<CommandKey>,
    /// Robots that somebody enrolled or may (identity's).
    pub enrolled: Slot<RobotIdentity>,
    /// Newest sessions (telemetry's).
    pub sessions: Slot<Session>,
    /// Durable lane numbers (telemetry's).
    pub lane_marks: Slot<LaneMark>,
    /// Copies of fleet stops (stop's).
    pub stops: Slot<StopRecord>,
    /// Those of them that are engaged, by the id of their row: copies of what was reset stay for a quarter.
    pub engaged: BTreeSet<String>,
    /// A stop was engaged or reset since tokens were last put right.
    pub stops_changed: bool,
    /// Places a robot holds: robot → place ids.
    pub held_places: BTreeMap<RobotId, BTreeSet<String>>,
    /// Robots whose desired work must be composed again in this cycle.
    pub dirty: BTreeSet<RobotId>,
    /// Robots whose rules of areas must be composed again in this cycle.
    pub policy_dirty: BTreeSet<RobotId>,
    /// Last entry of the feed that was taken.
    pub absorbed: Seq,
    /// Rows were read at this entry: what older entries say of rows is in the picture already, also that a row is gone.
    pub read_at: Seq,
    /// Reading of the clocks when fleet started: every lease counts as renewed then, and no timer fires soon after.
    pub started: Now,
    /// Reading of the clocks when the rows were read: serving time goes on from there.
    pub read: Now,
    /// Serving time at that moment.
    pub served: ServiceClock,
    /// Since when a robot waits for a place it cannot have, site clock. Volatile.
    pub waits: BTreeMap<RobotId, Waiting>,
    /// How often a robot began to wait for a place. Volatile.
    pub place_waits: u64,
    /// When a robot last had a reason to stand still (held, waiting for a place, not known), site clock: a stall counts from then. Volatile.
    pub excused: BTreeMap<RobotId, crate::time::SiteTime>,
    /// Robots that did not want their last errand, and until when they are left alone, link clock. Volatile.
    pub unwilling: BTreeMap<RobotId, crate::time::LinkTime>,
    /// Offers that robots did not answer. Volatile.
    pub answers: Answers,
    /// What robots say of themselves that only a person ends. Volatile.
    pub lasting: Lasting,
    /// What stands without a reason. Volatile.
    pub unexplained: Unexplained,
    /// The attempt that a robot lists and no row knows, and since when, link clock. Volatile.
    pub unknown: BTreeMap<RobotId, (AttemptId, crate::time::LinkTime)>,
    /// Places that no route may lead into now: found once, until a place or a stop changes. Read by `routing::closed`. Volatile.
    pub closed_places: OnceLock<Blocked>,
    /// Why each robot gets no work; none: it may. Found at the first explanation of a turn, for all of them. Volatile.
    pub screened: OnceLock<BTreeMap<RobotId, Option<Reason>>>,
    /// Time in which robots were heard since it was last counted. Volatile.
    pub attached: BTreeMap<RobotId, Attached>,
    /// The newest heartbeat of each robot, as (session epoch, number), that was compared with the rows and needs no second look. Volatile.
    pub compared: BTreeMap<RobotId, (u64, u64)>,
    /// Number that the store is to go on above, since a robot has applied a generation that it had not given. Volatile.
    pub behind: Option<u64>,
    /// Entries of the feed whose items the store refused for good: passed over. Volatile.
    pub unusable: BTreeSet<Seq>,
    /// Decisions that the store refuses for good. Volatile.
    pub refused: Refused,
    /// Rows with a value of a newer version.
    pub unknown_rows: UnknownRows,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
    /// Distances and routes, remembered.
    pub router: Arc<Router>,
}

impl View {
    /// An empty picture of `site`.
    pub fn new(site: Arc<Site>, started: Now, read: Now) -> Self {
        Self {
            router: Arc::new(Router::new(site.clone())),
            site,
            intakes: Slot::new(),
            tasks: Slot::new(),
            queue: Queue::new(read.utc),
            deadlines: BTreeSet::new(),
            agenda: Agenda::default(),
            ended: BTreeMap::new(),
            dependants: BTreeMap::new(),
            unasked: BTreeSet::new(),
            let_go: BTreeMap::new(),
            attempts: Slot::new(),
            timers: Slot::new(),
            holds: Slot::new(),
            places: Slot::new(),
            authority: Slot::new(),
            control: Slot::new(),
            counters: Slot::new(),
            sites: Slot::new(),
            policies: Slot::new(),
            desired_work: Slot::new(),
            desired_policy: Slot::new(),
            clocks: Slot::new(),
            marks: Slot::new(),
            incidents: Slot::new(),
            command_keys: Slot::new(),
            drains: Slot::new(),
            drains_of: BTreeMap::new(),
            drain_requests: Slot::new(),
            drain_releases: Slot::new(),
            budgets: Slot::new(),
            enrolled: Slot::new(),
            sessions: Slot::new(),
            lane_marks: Slot::new(),
            stops: Slot::new(),
            engaged: BTreeSet::new(),
            stops_changed: false,
            held_places: BTreeMap::new(),
            dirty: BTreeSet::new(),
            policy_dirty: BTreeSet::new(),
            absorbed: Seq(0),
            read_at: Seq(0),
            started,
            read,
            served: ServiceClock::default(),
            waits: BTreeMap::new(),
            excused: BTreeMap::new(),
            unwilling: BTreeMap::new(),
            answers: Answers::default(),
            unknown: BTreeMap::new(),
            lasting: Lasting::new(),
            unexplained: Unexplained::default(),
            attached: BTreeMap::new(),
            closed_places: OnceLock::new(),
            screened: OnceLock::new(),
            place_waits: 0,
            compared: BTreeMap::new(),
            behind: None,
            unusable: BTreeSet::new(),
            refused: Refused::default(),
            unknown_rows: UnknownRows::default(),
            bugs: Bugs::default(),
        }
    }

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

    /// The attempt's row.
    pub fn attempt(&self, id: &AttemptId) -> Option<&Attempt> {
        self.attempts.get(&id.to_string()).map(|a| &a.row)
    }

    /// The attempt that holds the robot.
    pub fn held_by(&self, robot: &RobotId) -> Option<&AttemptId> {
        match self.authority.get(robot.as_str()).map(|a| &a.row.holder) {
            Some(RobotHolder::Attempt(id)) => Some(id),
            _ => None,
        }
    }

    /// Drains of the robot, in whatever state.
    pub fn all_drains_of(&self, robot: &RobotId) -> impl Iterator<Item = &Drain> {
        let ids = self.drains_of.get(robot).into_iter().flatten();
        ids.filter_map(|id| self.drains.get(id)).map(|d| &d.row)
    }

    /// The drain that the robot is in: the oldest that takes it out of work.
    pub fn drain_of(&self, robot: &RobotId) -> Option<&Drain> {
        self.all_drains_of(robot).filter(|d| d.is_on()).min_by_key(|d| (d.since, d.drain_id.clone()))
    }

    /// Hold tokens of the robot.
    pub fn robot_holds(&self, robot: &RobotId) -> impl Iterator<Item = &HoldToken> {
        let from = format!("robot:{robot}:");
        self.holds.range(from.clone()..).take_while(move |(id, _)| id.starts_with(&from)).map(|(_, h)| &h.row)
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
pub fn held<'a>(view: &'a View, robot_id: &RobotId) -> impl Iterator<Item = (&'a Place, &'a PlaceHolder)> {
    let robot_id = robot_id.clone();
    let ids = view.held_places.get(&robot_id).into_iter().flatten();
    ids.filter_map(move |id| {
        let place = &view.places.get(id)?.row;
        Some((place, place.holder(&robot_id)?))
    })
}
