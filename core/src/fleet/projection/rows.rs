//! Rows that fleet alone writes, apart from tasks and attempts: places, the robot's mutex, control, timers, holds, counters, marks.

use super::command::Command;
use crate::energy::fit::EnergySums;
use crate::ids::{AreaId, AttemptId, DrainId, PlaceId, RobotId, RolloutId, SiteId, StopId, TaskId};
use crate::reason::Reason;
use crate::robot::{Duty, Inventory};
use crate::robot_events::WorkStats;
use crate::rows::{Index, Record, Seq, Table, body_is_json};
use crate::site::PlaceKind;
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// How far a holder is with its grant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HolderState {
    /// It may enter.
    Granted,
    /// It reported that it is inside.
    Inside,
    /// Taken back; counts as granted until the robot says that it did not enter.
    Revoking,
}

/// One robot in or before a place.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlaceHolder {
    /// The robot that was let in or stands there.
    pub robot_id: RobotId,
    /// Unique per robot; 0: it stood there without a grant.
    pub grant_id: u64,
    /// How far.
    pub state: HolderState,
    /// UTC, site clock.
    pub since: Utc,
    /// Only the robot's word says so: we never granted it.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub claimed: bool,
}

/// A passage or a standing place: the one row that is fought over.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The place's id in the site.
    pub place_id: PlaceId,
    /// Robots admitted at once.
    pub capacity: u32,
    /// What the site file says that it is for.
    pub kind: PlaceKind,
    /// Who has it.
    pub holders: Vec<PlaceHolder>,
    /// Set: nobody enters until the robot inside reports or a person clears it.
    pub quarantine: Option<Reason>,
    /// Grants that a person cleared away, the newest last: a robot that still says one of them was not lying.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cleared: Vec<u64>,
}

impl Place {
    /// The row of a place that nobody has ever held.
    pub fn unheld(place: &crate::site::Place) -> Self {
        Self {
            place_id: place.place_id.clone(),
            capacity: place.capacity,
            kind: place.kind(),
            holders: Vec::new(),
            quarantine: None,
            cleared: Vec::new(),
        }
    }

    /// Whether a holder that nobody knows anything of closes all of its seats.
    pub fn is_closed_whole_by(&self, holder: &PlaceHolder) -> bool {
        self.capacity <= 1 || holder.state == HolderState::Inside
    }
    /// The entry of `robot`.
    pub fn holder(&self, robot: &RobotId) -> Option<&PlaceHolder> {
        self.holders.iter().find(|h| h.robot_id == *robot)
    }
}

impl Record for Place {
    const TABLE: Table = Table::PlaceGrant;
    body_is_json!();
    fn id(&self) -> String {
        self.place_id.to_string()
    }
}

/// What a robot is taken by.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RobotHolder {
    /// Nobody has the robot.
    #[default]
    None,
    /// An attempt of a task or errand.
    Attempt(AttemptId),
    /// Maintenance of a drain.
    Maintenance(DrainId),
}

/// The robot's mutex: an assignment and a drain are both an update of this one row.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RobotAuthority {
    /// The robot that it is the mutex of.
    pub robot_id: RobotId,
    /// Who has it.
    pub holder: RobotHolder,
}

impl Record for RobotAuthority {
    const TABLE: Table = Table::RobotAuthority;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// Out of dispatch because a person said so.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Cordon {
    /// Why, in a person's words.
    pub reason: String,
    /// The actor that said so, by name.
    pub actor: String,
    /// UTC, site clock.
    pub since: Utc,
}

/// A person's word that a robot carries nothing, against what it had said by then.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadSettled {
    /// What the person saw.
    pub reason: String,
    /// The person or program that said so, by its token's name.
    pub actor: String,
    /// UTC, site clock.
    pub since: Utc,
    /// Session of the newest heartbeat that the word holds against.
    pub session_epoch: u64,
    /// Its number; the highest there is: of all of that session.
    pub hb: u64,
    /// The robot is told to forget its load, and has not yet: it was heard, knew its load by memory alone, and counts as loaded
    /// until it says otherwise.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_forget_pending: bool,
}

/// What people and the breaker decided about a robot.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RobotControl {
    /// The robot that it was decided about.
    pub robot_id: RobotId,
    /// Out of dispatch by a person.
    pub cordon: Option<Cordon>,
    /// Out of the fleet by a person: nothing waits for it any more.
    #[serde(default)]
    pub retired: Option<Cordon>,
    /// Out of dispatch by the breaker since, UTC, site clock.
    pub breaker: Option<Utc>,
    /// Failed attempts within the breaker's window, UTC, site clock.
    pub failures: Vec<Utc>,
    /// Offers that it heard and did not answer within the breaker's window, UTC, site clock.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unanswered: Vec<Utc>,
    /// Since when it gets no offers because it answers none, UTC, site clock: the newest that it missed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unanswered_since: Option<Utc>,
    /// When it last stood for a place and had done so for a minute, UTC, site clock; written once a minute meanwhile.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub waited_for_place: Option<Utc>,
    /// Attempts that no row knows and that a person told the server to ignore, as long as the robot lists them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub disowned: Vec<AttemptId>,
    /// A person's word about its load. Read by `tasks::load`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load_settled: Option<LoadSettled>,
    /// Errands asked of it so far.
    pub errands: u64,
    /// Tasks given to it so far; breaks ties between equally near robots.
    pub tasks: u64,
    /// Fleet stops that people resumed for it, oldest first, until it is heard to wait for them no more.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub resumed: Vec<StopId>,
    /// Labels that people gave it; they go before what it says itself.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub labels: BTreeMap<String, String>,
}

impl RobotControl {
    /// A robot nobody has said anything about.
    pub fn new(robot_id: RobotId) -> Self {
        Self {
            robot_id,
            cordon: None,
            retired: None,
            breaker: None,
            failures: Vec::new(),
            unanswered: Vec::new(),
            unanswered_since: None,
            waited_for_place: None,
            disowned: Vec::new(),
            load_settled: None,
            errands: 0,
            tasks: 0,
            resumed: Vec::new(),
            labels: BTreeMap::new(),
        }
    }
    /// A label of a robot: what people said, or else what it says itself.
    pub fn label<'a>(control: Option<&'a Self>, inventory: &'a Inventory, key: &str) -> Option<&'a str> {
        let put = control.and_then(|control| control.labels.get(key));
        put.or_else(|| inventory.labels.get(key)).map(String::as_str)
    }
    /// Whether it gets work.
    pub fn duty(&self) -> Duty {
        match (&self.cordon, self.breaker) {
            _ if self.retired.is_some() => Duty::Retired,
            (Some(_), _) => Duty::Cordoned,
            (None, Some(_)) => Duty::BrokenOff,
            (None, None) => Duty::InWork,
        }
    }
}

impl Record for RobotControl {
    const TABLE: Table = Table::RobotControl;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// What a timer is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimerKind {
    /// A robot's answer to an offer. Link clock.
    OfferAck,
    /// A robot's confirmation of a stop. Link clock.
    StopConfirm,
    /// UNCERTAIN for too long. Link clock.
    Uncertain,
    /// From acceptance to completion. Site clock; stands still while held.
    StartToClose,
    /// From admission to acceptance. Site clock.
    ScheduleToStart,
    /// End of a back-off. Site clock.
    RetryDue,
}

impl TimerKind {
    /// Whether it counts on the site clock.
    pub const fn is_site(self) -> bool {
        matches!(self, Self::StartToClose | Self::ScheduleToStart | Self::RetryDue)
    }
    /// Name in ids.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::OfferAck => "offer_ack",
            Self::StopConfirm => "stop_confirm",
            Self::Uncertain => "uncertain",
            Self::StartToClose => "start_to_close",
            Self::ScheduleToStart => "schedule_to_start",
            Self::RetryDue => "retry_due",
        }
    }
}

/// A deadline in serving time: it counts only while fleet serves, and a restart re-arms what is left.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Timer {
    /// What for.
    pub kind: TimerKind,
    /// Which attempt, or which task with epoch 0.
    pub attempt: AttemptId,
    /// Serving time at which it fires, milliseconds of its clock. None: it stands still with `remaining_ms` left.
    pub fires_at_service_ms: Option<u64>,
    /// Left while it stands still.
    pub remaining_ms: u64,
}

impl Timer {
    /// Its row id.
    pub fn id_of(kind: TimerKind, attempt: &AttemptId) -> String {
        format!("{}:{attempt}", kind.as_str())
    }
}

impl Record for Timer {
    const TABLE: Table = Table::Timer;
    body_is_json!();
    fn id(&self) -> String {
        Self::id_of(self.kind, &self.attempt)
    }
    fn index(&self) -> Index {
        Index { order: self.fires_at_service_ms.map(|v| v as i64), ..Index::default() }
    }
}

/// Why a robot must not move. Tokens of tasks live in the task's own hold set.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HoldToken {
    /// The robot that must not move.
    pub robot_id: RobotId,
    /// `stop:body:<robot>` while the body's own safety system stops it, `stop:<stop_id>` while a fleet stop does; `resume:` and the same until a person
    /// resumes.
    pub token: String,
    /// UTC, site clock.
    pub since: Utc,
}

impl HoldToken {
    /// Its row id.
    pub fn id_of(robot_id: &RobotId, token: &str) -> String {
        format!("robot:{robot_id}:{token}")
    }
}

impl Record for HoldToken {
    const TABLE: Table = Table::HoldToken;
    body_is_json!();
    fn id(&self) -> String {
        Self::id_of(&self.robot_id, &self.token)
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), ..Index::default() }
    }
}

/// A person's word that nobody is let into a place for a while. Robots that were let in before still drive through.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlaceBlock {
    /// The place into which nobody is let.
    pub place_id: PlaceId,
    /// Why, in a person's words.
    pub reason: String,
    /// Who said so.
    pub actor: String,
    /// Since when, UTC, site clock.
    pub since: Utc,
    /// When it ends by itself, UTC, site clock; none: a person ends it.
    pub until: Option<Utc>,
}

impl Record for PlaceBlock {
    const TABLE: Table = Table::PlaceBlock;
    body_is_json!();
    fn id(&self) -> String {
        self.place_id.to_string()
    }
}

/// Work done by one robot on one version of its software.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RobotCounter {
    /// The robot that did the work.
    pub robot_id: RobotId,
    /// Version of base software; empty: not reported.
    pub software: String,
    /// Attempts of tasks that succeeded.
    pub succeeded: u64,
    /// Attempts of tasks that failed, by fault code.
    pub failures: BTreeMap<u32, u64>,
    /// Sums over all attempts, errands included.
    pub stats: WorkStats,
    /// Of these, of errands: a way to a charger costs time and energy for no task.
    #[serde(default)]
    pub errands: WorkStats,
    /// Milliseconds of site time in which it was heard, counted at the end of each attempt.
    pub attached_ms: u64,
    /// When it was counted last, UTC, site clock; 0: before this was noted.
    #[serde(default)]
    pub counted: Utc,
    /// What attempts took, errands of parking included: from it follow the rates of the robot's energy.
    #[serde(default, skip_serializing_if = "EnergySums::is_empty")]
    pub energy_sums: EnergySums,
}

impl Record for RobotCounter {
    const TABLE: Table = Table::RobotCounter;
    body_is_json!();
    fn id(&self) -> String {
        format!("{}@{}", self.robot_id, self.software)
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), order: Some(self.counted.0), ..Index::default() }
    }
}

/// The site this store serves.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SiteRow {
    /// The site, as its file names it.
    pub site_id: SiteId,
    /// Map version, as its file says.
    pub map_version: String,
    /// The site file's text.
    pub text: String,
}

impl Record for SiteRow {
    const TABLE: Table = Table::Site;
    body_is_json!();
    fn id(&self) -> String {
        self.site_id.to_string()
    }
}

/// Serving time of fleet.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ServiceClock {
    /// Milliseconds served on the site clock.
    pub site_ms: u64,
    /// Milliseconds served on the link clock.
    pub link_ms: u64,
}

impl Record for ServiceClock {
    const TABLE: Table = Table::ServiceClock;
    body_is_json!();
    fn id(&self) -> String {
        "fleet".to_owned()
    }
}

/// How far fleet has consumed the feed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FleetMark {
    /// Every entry up to here has had its effect.
    pub seq: Seq,
}

impl Record for FleetMark {
    const TABLE: Table = Table::FleetMark;
    body_is_json!();
    fn id(&self) -> String {
        "fleet".to_owned()
    }
}

/// Something a person should look into.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Incident {
    /// Unique: code, subject and opening time.
    pub id: String,
    /// What is wrong, with its facts.
    pub reason: Reason,
    /// About which robot.
    pub robot_id: Option<RobotId>,
    /// About which task.
    pub task_id: Option<TaskId>,
    /// About which area.
    pub area_id: Option<AreaId>,
    /// UTC, site clock.
    pub opened_unix_ms: Utc,
    /// A person has looked into it.
    #[serde(default)]
    pub closed: Option<IncidentClosure>,
}

/// The closure of an incident: by whom, why and when.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct IncidentClosure {
    /// Who closed it, by name; `fleet`: it was over by itself.
    pub actor: String,
    /// What was found.
    pub reason: String,
    /// UTC, site clock.
    pub at: Utc,
}

impl Record for Incident {
    const TABLE: Table = Table::Incident;
    body_is_json!();
    fn id(&self) -> String {
        self.id.clone()
    }
    fn index(&self) -> Index {
        let parent = self.robot_id.as_ref().map(|r| r.as_str().into());
        Index { state: Some(i64::from(self.closed.is_none())), parent, order: Some(self.opened_unix_ms.0) }
    }
}

/// How far a drain is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DrainState {
    /// The robot works on: the area's budget lets nobody more out.
    Waiting,
    /// The robot gets no new work; what it has ends or waits, then it parks.
    Draining,
    /// The drain holds the robot.
    Held,
    /// The robot could not be had in time; it works on.
    Refused,
}

/// One taking of a robot out of work.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Drain {
    /// Never used again.
    pub drain_id: DrainId,
    /// The robot that is taken out of work.
    pub robot_id: RobotId,
    /// How far.
    pub state: DrainState,
    /// What for.
    pub reason: String,
    /// Who asked.
    pub actor: String,
    /// Milliseconds of site time from `since` until it is refused.
    pub within_ms: u64,
    /// UTC, site clock.
    pub since: Utc,
    /// Why it waits or was refused.
    pub why: Option<Reason>,
    /// The area that it takes the robot from, once it does.
    #[serde(default)]
    pub area_id: Option<AreaId>,
    /// The roll-out that asked for it.
    #[serde(default)]
    pub rollout_id: Option<RolloutId>,
    /// It does not wait for the area's budget.
    #[serde(default)]
    pub urgent: bool,
    /// The robot goes back from what was aborted: only drains that are on count against it.
    #[serde(default)]
    pub is_way_back: bool,
}

impl Drain {
    /// A person asked for it, and a person ends it.
    pub fn is_of_person(&self) -> bool {
        self.drain_id.as_str().starts_with("op:")
    }
    /// It takes the robot out of work now, or has.
    pub const fn is_on(&self) -> bool {
        matches!(self.state, DrainState::Draining | DrainState::Held)
    }
}

/// Robots of one area that are out of work: a row, so that two planners cannot both spend the last place.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaBudget {
    /// Which area.
    pub area_id: AreaId,
    /// Out of work for a drain, a cordon or the breaker; one that is out for several reasons stands here once.
    pub off_work: BTreeSet<RobotId>,
    /// As many may be.
    pub off_work_max: u32,
}

impl Record for AreaBudget {
    const TABLE: Table = Table::AreaBudget;
    body_is_json!();
    fn id(&self) -> String {
        self.area_id.to_string()
    }
}

impl Record for Drain {
    const TABLE: Table = Table::Drain;
    body_is_json!();
    fn id(&self) -> String {
        self.drain_id.to_string()
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), order: Some(self.since.0), ..Index::default() }
    }
}

/// A used request_id of a command.
pub type CommandKey = crate::idempotency::CommandKey<Command>;
