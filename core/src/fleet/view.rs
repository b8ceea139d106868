//! Fleet's picture of the rows: built from a snapshot, kept by the feed, and already holding what fleet itself is about to commit.
//!
//! Called by every room of `fleet`. Invariant: a row here is at the revision it has in the store, or one that an item of the
//! running cycle will write. After a conflict the whole view is built again; after a refusal only the rows of what was refused are read again.

use super::queue::{self, Queue};
use super::rows::{
    AreaBudget, CommandKey, Drain, FleetMark, HoldToken, Incident, Place, RobotAuthority, RobotControl, RobotCounter,
    RobotHolder, ServiceClock, SiteRow, Timer,
};
use super::sweep::Agenda;
use super::way;
use crate::identity::RobotIdentity;
use crate::ids::{AttemptId, RobotId, TaskId};
use crate::limits;
use crate::maintenance::{DrainRelease, DrainRequest};
use crate::picture::{Picture, Viewed};
pub use crate::picture::{Rowed, Slot};
use crate::policy::AreaPolicy;
use crate::reason::Reason;
use crate::rows::{BadRow, Key, Part, Revision, Row, Seq, Table, Writer};
use crate::site::Site;
use crate::site::route::{Blocked, Router};
use crate::stop::record::StopRecord;
use crate::task::{Attempt, AttemptPhase, Phase, TaskIntake, TaskState};
use crate::time::{Now, Utc};
use crate::unknown_rows::UnknownRows;
use crate::work::{DesiredPolicy, DesiredWork, LaneMark, Session};
use std::collections::{BTreeMap, BTreeSet};
use std::mem::take;
use std::sync::{Arc, OnceLock};

/// Time in which a robot was heard and that no counter has yet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Attached {
    /// Milliseconds of site time.
    pub ms: u64,
    /// Up to when, site clock.
    pub until: crate::time::SiteTime,
    /// It was heard then.
    pub is_heard: bool,
}

/// What a robot waits for. Volatile: waiting reasons never go through the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// Places it asked for and did not get.
    pub places: Vec<crate::ids::PlaceId>,
    /// Since when.
    pub since: crate::time::SiteTime,
}

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
    pub answers: super::answers::Answers,
    /// What robots say of themselves that only a person ends. Volatile.
    pub lasting: super::lasting::Lasting,
    /// What stands without a reason. Volatile.
    pub unexplained: super::unexplained::Unexplained,
    /// The attempt that a robot lists and no row knows, and since when, link clock. Volatile.
    pub unknown: BTreeMap<RobotId, (AttemptId, crate::time::LinkTime)>,
    /// Places that no route may lead into now: found once, until a place or a stop changes. Read by [`View::closed`]. Volatile.
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
    pub refused: super::refused::Refused,
    /// Rows with a value of a newer version.
    pub unknown_rows: UnknownRows,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: super::bugs::Bugs,
    /// Distances and routes, remembered.
    pub router: Arc<Router>,
}

impl Picture for View {
    const WRITER: Writer = Writer::Fleet;
    fn unknown_rows(&mut self) -> &mut UnknownRows {
        &mut self.unknown_rows
    }
}

macro_rules! viewed {
    ($($record:ty => $slot:ident;)*) => { $(impl Viewed<View> for $record {
        fn slot(view: &mut View) -> &mut Slot<Self> { &mut view.$slot }
    })* };
}

viewed! {
    Timer => timers;
    RobotCounter => counters;
    SiteRow => sites;
    DesiredWork => desired_work;
    DesiredPolicy => desired_policy;
    ServiceClock => clocks;
    FleetMark => marks;
    CommandKey => command_keys;
    DrainRequest => drain_requests;
    DrainRelease => drain_releases;
    AreaBudget => budgets;
    RobotIdentity => enrolled;
    LaneMark => lane_marks;
}

impl Viewed<View> for TaskState {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.tasks
    }
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        let Ok(task_id) = TaskId::parse(id) else { return };
        if let Some(task) = view.tasks.get(id).map(|t| &t.row) {
            view.dirty.extend(task.robot_id.clone());
            view.unasked.remove(&task_id);
            let phase = task.phase;
            if !phase.is_terminal() {
                queue::note_open(view, &task_id);
            } else {
                let deadline = view.intake(&task_id).and_then(|intake| intake.spec.deadline);
                if let Some(at) = deadline {
                    view.deadlines.remove(&(at, task_id.clone()));
                }
                queue::note_end(view, &task_id, phase);
            }
        }
        queue::place(view, &task_id);
    }
}

impl Viewed<View> for TaskIntake {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.intakes
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        let waits_for = view.intakes.get(id).map(|i| i.row.spec.depends_on.clone()).unwrap_or_default();
        for task_id in waits_for {
            let known = view.tasks.get(task_id.as_str()).map(|t| t.row.phase);
            if let Some(phase) = known.filter(|phase| phase.is_terminal()) {
                view.ended.insert(task_id.clone(), phase);
            } else if known.is_none() && !view.ended.contains_key(&task_id) {
                view.unasked.insert(task_id.clone());
            }
            *view.dependants.entry(task_id).or_default() += 1;
        }
        old.into_iter().for_each(|old| view.waits_no_more(old));
        if let Ok(task_id) = TaskId::parse(id) {
            let deadline = view.intake(&task_id).and_then(|intake| intake.spec.deadline);
            view.deadlines.extend(deadline.map(|at| (at, task_id.clone())));
            queue::place(view, &task_id);
        }
    }
}

impl Viewed<View> for AreaPolicy {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.policies
    }
    /// Whoever put it, this process or another: every robot hears of it.
    fn changed(view: &mut View, _id: &str, _old: Option<&Self>) {
        let robots: Vec<RobotId> = view.sessions.values().map(|s| s.row.robot_id.clone()).collect();
        view.policy_dirty.extend(robots);
    }
}

impl Viewed<View> for Incident {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.incidents
    }
    /// A person has looked: what was put aside is tried again.
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        if let Some(closed) = view.incidents.get(id).map(|i| &i.row).filter(|i| i.closed.is_some()) {
            view.refused.incident_closed(&closed.reason);
        }
    }
}

impl Viewed<View> for StopRecord {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.stops
    }
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        view.closed_places.take();
        view.stops_changed = true;
        match view.stops.get(id).is_some_and(|record| record.row.is_effective()) {
            true => view.engaged.insert(id.to_owned()),
            false => view.engaged.remove(id),
        };
    }
}

impl Viewed<View> for Drain {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.drains
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        match (view.drains.get(id).map(|d| d.row.robot_id.clone()), old) {
            (Some(robot_id), _) => {
                view.drains_of.entry(robot_id).or_default().insert(id.to_owned());
            }
            (None, Some(old)) => {
                if let Some(ids) = view.drains_of.get_mut(&old.robot_id) {
                    ids.remove(id);
                }
            }
            (None, None) => {}
        }
    }
}

impl Viewed<View> for Attempt {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.attempts
    }
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        if let Some(attempt) = view.attempts.get(id) {
            view.dirty.insert(attempt.row.robot_id.clone());
        }
    }
}

impl Viewed<View> for HoldToken {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.holds
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        let robot = view.holds.get(id).map(|h| h.row.robot_id.clone()).or_else(|| old.map(|h| h.robot_id.clone()));
        view.dirty.extend(robot);
    }
}

impl Viewed<View> for RobotAuthority {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.authority
    }
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        view.dirty.extend(view.authority.get(id).map(|a| a.row.robot_id.clone()));
    }
}

impl Viewed<View> for RobotControl {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.control
    }
    /// A person's word about its load goes to the robot, whichever process took it.
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        let word = |control: &Self| control.load_settled.clone();
        let new = view.control.get(id).map(|c| &c.row);
        if new.and_then(word) != old.and_then(word) {
            view.dirty.extend(new.map(|control| control.robot_id.clone()));
        }
    }
}

impl Viewed<View> for Session {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.sessions
    }
    fn changed(view: &mut View, id: &str, _old: Option<&Self>) {
        view.dirty.extend(view.sessions.get(id).map(|s| s.row.robot_id.clone()));
    }
}

impl Viewed<View> for Place {
    fn slot(view: &mut View) -> &mut Slot<Self> {
        &mut view.places
    }
    fn changed(view: &mut View, id: &str, old: Option<&Self>) {
        view.closed_places.take();
        for robot in old.into_iter().flat_map(|p| &p.holders).map(|h| &h.robot_id) {
            view.dirty.insert(robot.clone());
            if let Some(places) = view.held_places.get_mut(robot) {
                places.remove(id);
            }
        }
        let now: Vec<RobotId> =
            view.places.get(id).into_iter().flat_map(|p| &p.row.holders).map(|h| h.robot_id.clone()).collect();
        for robot in now {
            view.held_places.entry(robot.clone()).or_default().insert(id.to_owned());
            view.dirty.insert(robot);
        }
    }
}

/// What the picture begins with: all that is alive. [`named`] says what is read with it.
pub fn alive() -> Vec<Part> {
    let tasks = Phase::ALL.into_iter().filter(|p| !p.is_terminal()).map(Phase::number);
    let attempts = AttemptPhase::ALL.into_iter().filter(|p| !p.is_terminal()).map(AttemptPhase::number);
    let in_states =
        [Part::InStates(Table::TaskState, tasks.collect()), Part::InStates(Table::Attempt, attempts.collect())];
    WHOLE.iter().map(|table| Part::Whole(*table)).chain(in_states).collect()
}

/// What rows of the picture name: of a task that has not ended what was asked for, its newest attempt, and the tasks that it waits for; of
/// a robot the attempt that holds it.
pub fn named(rows: &[Row]) -> Vec<Key> {
    let mut keys = Vec::new();
    for row in rows {
        match row.key.table {
            Table::TaskState => {
                let Ok(task) = row.decode::<TaskState>() else { continue };
                if !task.phase.is_terminal() {
                    keys.push(Key { table: Table::TaskIntake, id: row.key.id.clone() });
                    keys.extend(task.attempt_id().map(|id| Key::new(Table::Attempt, id.to_string())));
                }
            }
            Table::TaskIntake => {
                let Ok(intake) = row.decode::<TaskIntake>() else { continue };
                keys.extend(intake.spec.depends_on.iter().map(|id| Key::new(Table::TaskState, id.as_str())));
            }
            Table::RobotAuthority => {
                let holder = row.decode::<RobotAuthority>().map(|a| a.holder);
                if let Ok(RobotHolder::Attempt(id)) = holder {
                    keys.push(Key::new(Table::Attempt, id.to_string()));
                }
            }
            _ => {}
        }
    }
    keys
}

/// Tables that hold only what is alive, or that are bounded by count.
const WHOLE: &[Table] = &[
    Table::Timer,
    Table::HoldToken,
    Table::PlaceGrant,
    Table::RobotAuthority,
    Table::RobotControl,
    Table::RobotCounter,
    Table::Site,
    Table::AreaPolicy,
    Table::DesiredWork,
    Table::DesiredPolicy,
    Table::ServiceClock,
    Table::FleetMark,
    Table::Incident,
    Table::Drain,
    Table::DrainRequest,
    Table::DrainRelease,
    Table::AreaBudget,
    Table::RobotIdentity,
    Table::Session,
    Table::LaneMark,
    Table::StopRecord,
];

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
            answers: super::answers::Answers::default(),
            unknown: BTreeMap::new(),
            lasting: super::lasting::Lasting::new(),
            unexplained: super::unexplained::Unexplained::default(),
            attached: BTreeMap::new(),
            closed_places: OnceLock::new(),
            screened: OnceLock::new(),
            place_waits: 0,
            compared: BTreeMap::new(),
            behind: None,
            unusable: BTreeSet::new(),
            refused: super::refused::Refused::default(),
            unknown_rows: UnknownRows::default(),
            bugs: super::bugs::Bugs::default(),
        }
    }

    /// Takes what was read at `seq` by [`alive`] and [`named`].
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn load(&mut self, rows: &[Row], seq: Seq) -> Result<(), BadRow> {
        for row in rows {
            self.absorb(&row.key, row.revision, Some(row))?;
        }
        self.read_at = seq;
        self.absorbed = self.marks.get("fleet").map_or(Seq(0), |m| m.row.seq);
        self.served = self.clocks.get("fleet").map(|c| c.row).unwrap_or_default();
        // Whatever a task waits for was asked with it.
        self.unasked.clear();
        self.forget_ended();
        self.let_go.clear();
        Ok(())
    }

    /// Takes over what only this process knows from the picture before it, ahead of the rows. What is not named here begins anew with each
    /// reading.
    pub fn carry_over(&mut self, before: &mut Self) {
        self.router = before.router.clone();
        self.place_waits = before.place_waits;
        self.waits = take(&mut before.waits);
        self.attached = take(&mut before.attached);
        self.excused = take(&mut before.excused);
        self.unwilling = take(&mut before.unwilling);
        self.answers = take(&mut before.answers);
        self.unknown = take(&mut before.unknown);
        self.lasting = take(&mut before.lasting);
        self.unexplained = take(&mut before.unexplained);
        self.unusable = take(&mut before.unusable);
        self.refused = take(&mut before.refused);
    }

    /// What is over and wanted all the same, and nobody has asked the store for: at most [`limits::ASKED_AT_ONCE`].
    pub fn wanted(&self) -> Vec<Key> {
        let ids = self.unasked.iter().take(limits::ASKED_AT_ONCE);
        ids.map(|id| Key::new(Table::TaskState, id.as_str())).collect()
    }

    /// Takes what the store has of `keys`, which were asked by id. What it does not have, or what has not ended, is told by the feed.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn tell(&mut self, keys: &[Key], rows: &[Row]) -> Result<(), BadRow> {
        for key in keys.iter().filter(|key| key.table == Table::TaskState) {
            if let Ok(id) = TaskId::parse(&key.id) {
                self.unasked.remove(&id);
            }
        }
        for row in rows {
            match row.key.table {
                Table::CommandKey => {
                    crate::picture::take::<Self, CommandKey>(self, &row.key.id, row.revision, Some(row))?;
                }
                Table::TaskState => {
                    match row.decode::<TaskState>() {
                        Ok(task) if task.phase.is_terminal() => queue::note_end(self, &task.task_id, task.phase),
                        Err(error) if !error.is_unknown() => return Err(error),
                        // It has not ended, as far as anybody here knows.
                        _ => {}
                    }
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// A task is over, or gone: nothing is asked any more of those that it waited for alone.
    fn waits_no_more(&mut self, intake: &TaskIntake) {
        for task_id in &intake.spec.depends_on {
            let Some(left) = self.dependants.get_mut(task_id) else { continue };
            *left -= 1;
            if *left == 0 {
                self.dependants.remove(task_id);
                self.ended.remove(task_id);
                self.unasked.remove(task_id);
            }
        }
    }

    /// Takes one row as the store has it; none: deleted. What this picture already has is passed over.
    pub fn absorb(&mut self, key: &Key, revision: Revision, row: Option<&Row>) -> Result<(), BadRow> {
        match key.table {
            Table::TaskIntake => self.take::<TaskIntake>(key, revision, row),
            Table::TaskState => self.take::<TaskState>(key, revision, row),
            Table::Attempt => self.take::<Attempt>(key, revision, row),
            Table::Timer => self.take::<Timer>(key, revision, row),
            Table::HoldToken => self.take::<HoldToken>(key, revision, row),
            Table::PlaceGrant => self.take::<Place>(key, revision, row),
            Table::RobotAuthority => self.take::<RobotAuthority>(key, revision, row),
            Table::RobotControl => self.take::<RobotControl>(key, revision, row),
            Table::RobotCounter => self.take::<RobotCounter>(key, revision, row),
            Table::Site => self.take::<SiteRow>(key, revision, row),
            Table::AreaPolicy => self.take::<AreaPolicy>(key, revision, row),
            Table::DesiredWork => self.take::<DesiredWork>(key, revision, row),
            Table::DesiredPolicy => self.take::<DesiredPolicy>(key, revision, row),
            Table::ServiceClock => self.take::<ServiceClock>(key, revision, row),
            Table::FleetMark => self.take::<FleetMark>(key, revision, row),
            Table::Incident => self.take::<Incident>(key, revision, row),
            Table::Drain => self.take::<Drain>(key, revision, row),
            Table::CommandKey => self.take::<CommandKey>(key, revision, row),
            Table::RobotIdentity => self.take::<RobotIdentity>(key, revision, row),
            Table::Session => self.take::<Session>(key, revision, row),
            Table::LaneMark => self.take::<LaneMark>(key, revision, row),
            Table::StopRecord => self.take::<StopRecord>(key, revision, row),
            Table::DrainRequest => self.take::<DrainRequest>(key, revision, row),
            Table::DrainRelease => self.take::<DrainRelease>(key, revision, row),
            Table::AreaBudget => self.take::<AreaBudget>(key, revision, row),
            _ => Ok(()),
        }
    }

    /// Puts a row as the store has it over what this picture had made of it. None: there is no such row.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn put_right(&mut self, key: &Key, row: Option<&Row>) -> Result<(), BadRow> {
        if let (Table::TaskState, Ok(task_id)) = (key.table, TaskId::parse(&key.id)) {
            self.let_go.remove(&task_id);
            queue::note_open(self, &task_id);
        }
        self.absorb(key, Revision(u64::MAX), None)?;
        row.map_or(Ok(()), |row| self.absorb(key, row.revision, Some(row)))
    }

    fn take<R: Viewed<View>>(&mut self, key: &Key, revision: Revision, row: Option<&Row>) -> Result<(), BadRow> {
        if let (Table::TaskState, None, Ok(task_id)) = (key.table, row, TaskId::parse(&key.id)) {
            self.ended.remove(&task_id);
        }
        if R::slot(self).get(&*key.id).is_none() && self.is_past(key) {
            return Ok(());
        }
        crate::picture::take::<Self, R>(self, &key.id, revision, row)
    }

    /// A row that this picture has let go on purpose, or asks for by id alone.
    fn is_past(&self, key: &Key) -> bool {
        match key.table {
            Table::TaskIntake | Table::TaskState => {
                TaskId::parse(&key.id).is_ok_and(|id| self.let_go.contains_key(&id))
            }
            Table::CommandKey => true,
            _ => false,
        }
    }

    /// Lets go of tasks that have ended and of attempts that neither hold a robot nor are the newest of a live task.
    pub fn forget_ended(&mut self) {
        // What is let go is committed after this, and comes by the feed before the feed is taken further than that.
        let absorbed = self.absorbed;
        self.let_go.retain(|_, at| *at >= absorbed);
        let ended: Vec<TaskId> =
            self.tasks.values().filter(|t| t.row.phase.is_terminal()).map(|t| t.row.task_id.clone()).collect();
        for id in ended {
            self.tasks.remove(id.as_str());
            if let Some(intake) = self.intakes.remove(id.as_str()) {
                self.waits_no_more(&intake.row);
            }
            self.let_go.insert(id, absorbed);
        }
        self.command_keys.clear();
        let tasks = &self.tasks;
        let authority = &self.authority;
        self.attempts.retain(|_, a| {
            let a = &a.row;
            let holds = authority
                .get(a.robot_id.as_str())
                .is_some_and(|r| matches!(&r.row.holder, RobotHolder::Attempt(id) if *id == a.attempt));
            let newest = a
                .attempt
                .subject
                .task_id()
                .is_some_and(|t| tasks.get(t.as_str()).is_some_and(|t| t.row.epoch == a.attempt.epoch));
            holds || newest || !a.phase.is_terminal()
        });
    }

    /// Forgets what a planner would have to look at: whoever plans next begins with a picture of its own.
    pub fn rest(&mut self) {
        self.forget_ended();
        self.dirty.clear();
        self.policy_dirty.clear();
        self.queue.rest();
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
    /// Places that no route may lead into now.
    pub fn closed(&self) -> &Blocked {
        self.closed_places.get_or_init(|| way::closed(self))
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
pub fn held<'a>(
    view: &'a View,
    robot_id: &RobotId,
) -> impl Iterator<Item = (&'a super::rows::Place, &'a super::rows::PlaceHolder)> {
    let robot_id = robot_id.clone();
    let ids = view.held_places.get(&robot_id).into_iter().flatten();
    ids.filter_map(move |id| {
        let place = &view.places.get(id)?.row;
        Some((place, place.holder(&robot_id)?))
    })
}
