//! What goes down to a robot (desired state by sections) and what comes up (events): the values behind the link.
//!
//! Robots get desired state, not commands. Each section has the generation of its one writer and never moves backwards.
//! Written by fleet, composed and sent by telemetry, obeyed by the agent.

use crate::authority::Authority;
use crate::ids::{AreaId, AttemptId, DrainId, PlaceId, RobotId, StopId, WaypointId};
use crate::reason::Reason;
pub use crate::robot::WorkState;
use crate::robot::{Fault, HardwareStop, HeldPlace, Lane, Load, Mode, Presence, StopLevel, Vitals};
use crate::rows::{Index, Record, Table, body_is_json, written};
use crate::update::UpdateEvent;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Section `work` of a robot's desired state: whole, newest wins.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DesiredWork {
    /// The robot that is to have it.
    pub robot_id: RobotId,
    /// max(previous + 1, unix ms): rises also across a restore of the store.
    pub generation: u64,
    /// What to do. None: no work; what runs under an attempt not named here is to be stopped and confirmed.
    pub assignment: Option<Assignment>,
    /// Every place it may enter or stay in.
    pub grants: Vec<GrantedPlace>,
    /// Hold tokens of robot or task scope stand: stand still where it is safe and keep the work.
    pub held: bool,
    /// Permission to move again after a hold. Needed once per hold; a buffered one is refused.
    pub resume: Option<Authority>,
    /// Attempts whose end the server has stored: the robot may forget them from its report.
    pub closed: Vec<AttemptId>,
    /// The drain that holds the robot: no work, and its software may change.
    #[serde(default)]
    pub maintenance: Option<DrainId>,
    /// Stops that people resumed for it, as long as it says that it waits for that. One whose reset it has not heard of waits on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub resumed: Vec<StopId>,
    /// A person's word that it carries nothing, while it says that it does and knows that by its memory alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load_word: Option<LoadWord>,
}

/// A person has looked: a load that this heartbeat listed, and that has not changed since, is not on the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadWord {
    /// Session of the heartbeat.
    pub session_epoch: u64,
    /// Its number.
    pub hb: u64,
}

impl Record for DesiredWork {
    const TABLE: Table = Table::DesiredWork;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
    fn index(&self) -> Index {
        Index { order: Some(self.generation as i64), ..Index::default() }
    }
}

/// One attempt as it is given to a robot.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Assignment {
    /// Which attempt.
    pub attempt: AttemptId,
    /// Permission to accept it. Going on with it afterwards lives from the echo of heartbeats.
    pub offer: Authority,
    /// Milliseconds of site time from acceptance until the agent itself ends it (5 % before the server does).
    pub timeout_ms: u64,
    /// All steps of the task.
    pub steps: Vec<WorkStep>,
    /// Where to begin: steps before it are done. A goto if the robot must first drive to where `resume_step` is done.
    pub from_step: u32,
    /// Where to go on after the goto at `from_step`: steps between them are done and must not be done again. Equal to
    /// `from_step` if there is no such goto.
    pub resume_step: u32,
    /// Rises when the server chose another way; `released_index` counts in this route.
    pub route_number: u32,
    /// The whole way through all goto steps that are left.
    pub route: Vec<RoutePoint>,
    /// Index in `route` up to which the robot may drive: always a standing place or the end. None: stay.
    pub released_index: Option<u32>,
    /// Stop at the next point where it is safe and give it back; stays here until the stop is confirmed.
    pub stop: bool,
    /// Stop at the next step boundary without a load and give it back.
    pub suspend: bool,
    /// Millimetres per second for this task. None: the area's.
    pub speed_limit_mm_s: Option<u32>,
}

impl Assignment {
    /// Whether its numbers lie within its steps and its route, in order: what a robot can read.
    pub fn is_lawful(&self) -> bool {
        let (steps, points) = (self.steps.len() as u64, self.route.len() as u64);
        let lies = self.from_step <= self.resume_step && u64::from(self.resume_step) <= steps;
        steps > 0 && lies && self.released_index.is_none_or(|at| u64::from(at) < points)
    }
}

/// One step as the robot does it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorkStep {
    /// What is done in it.
    pub kind: StepKind,
    /// What may happen if nobody knows whether it was done.
    pub effect: Effect,
    /// May be paused inside.
    pub pause_allowed: bool,
    /// May be stopped inside.
    pub cancel_allowed: bool,
    /// Milliseconds of site time for this step; none: only the attempt's timeout.
    pub timeout_ms: Option<u64>,
    /// Go on with the next step if this one fails.
    pub continue_on_fail: bool,
}

/// What a step is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StepKind {
    /// Drive to a waypoint.
    Goto {
        /// The waypoint where the drive ends.
        waypoint: WaypointId,
    },
    /// Do something where it stands.
    Action {
        /// `pick`, `place`, `inspect`, …
        name: String,
        /// Parameters, a JSON object.
        params: serde_json::Map<String, serde_json::Value>,
    },
    /// Stand where it is.
    Wait {
        /// Milliseconds of site time.
        duration_ms: u64,
    },
}

/// What may happen if nobody knows whether a step was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Effect {
    /// Doing it twice does no harm.
    Repeatable,
    /// The body can tell whether it was done.
    CheckFirst,
    /// Must not be done twice.
    AtMostOnce,
}

/// The step an attempt begins with, so that the robot stands where `next_step` is done.
pub fn from_step(steps: &[WorkStep], next_step: u32) -> u32 {
    let mut done = steps.iter().enumerate().take(next_step as usize + 1);
    done.rfind(|(_, s)| matches!(s.kind, StepKind::Goto { .. })).map_or(next_step, |(i, _)| i as u32)
}

/// One waypoint of a route.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RoutePoint {
    /// The waypoint, as the site file names it.
    pub waypoint: WaypointId,
    /// Millimetres to the east, in the site's frame.
    pub x_mm: i32,
    /// Millimetres to the north, in the site's frame.
    pub y_mm: i32,
    /// The goto step that ends here, if one does.
    pub ends_step: Option<u32>,
    /// A standing place the robot must hold before it enters.
    pub standing: Option<PlaceId>,
    /// Passages the lane that leads here crosses; each must be held before it is entered.
    pub passages: Vec<PlaceId>,
    /// Limit of the lane that leads here, millimetres per second. None: none of its own.
    pub speed_limit_mm_s: Option<u32>,
    /// Area of this point, whose policy holds here.
    pub area_id: AreaId,
}

/// Permission to enter one place. Single use: after leaving, another is needed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GrantedPlace {
    /// The place that may be entered.
    pub place_id: PlaceId,
    /// Never used again.
    pub grant_id: u64,
    /// Permission to *enter*; a robot inside stays, whatever this says. None: it is inside already.
    pub entry: Option<Authority>,
}

/// Section `policy`: limits and rules of the areas, whole.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DesiredPolicy {
    /// The robot that is to have it.
    pub robot_id: RobotId,
    /// max(previous + 1, unix ms).
    pub generation: u64,
    /// One entry an area.
    pub areas: Vec<crate::policy::AreaPolicy>,
}

impl Record for DesiredPolicy {
    const TABLE: Table = Table::DesiredPolicy;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// What was driven and spent in one attempt.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkStats {
    /// Millimetres driven, with a load and without.
    pub path_mm: u64,
    /// Of these, with a load.
    pub loaded_path_mm: u64,
    /// Milliseconds of site time from acceptance.
    pub duration_ms: u64,
    /// Milliwatt-hours used, as the robot's body counts them.
    pub energy_mwh: u64,
    /// Tenths of a degree, highest joint temperature seen.
    pub hottest_joint_decidegrees: i32,
}

impl std::ops::AddAssign for WorkStats {
    fn add_assign(&mut self, other: Self) {
        // Robots say these numbers: absurd ones spoil a sum and nothing else.
        self.path_mm = self.path_mm.saturating_add(other.path_mm);
        self.loaded_path_mm = self.loaded_path_mm.saturating_add(other.loaded_path_mm);
        self.duration_ms = self.duration_ms.saturating_add(other.duration_ms);
        self.energy_mwh = self.energy_mwh.saturating_add(other.energy_mwh);
        self.hottest_joint_decidegrees = self.hottest_joint_decidegrees.max(other.hottest_joint_decidegrees);
    }
}

/// News of one attempt from the robot, lane EVENT.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AttemptReport {
    /// Which attempt.
    pub attempt: AttemptId,
    /// What the robot does with it now.
    pub state: WorkState,
    /// Steps done so far = index of the step at hand.
    pub step_index: u32,
    /// The first irreversible step is done or unknown.
    pub opened: bool,
    /// Why it refused.
    pub refusal: Option<Reason>,
    /// Why it failed.
    pub fault: Option<Fault>,
    /// So far in this attempt.
    pub stats: WorkStats,
}

/// What happened to a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlaceNews {
    /// The contour reached in.
    Entered,
    /// The contour is out again: the grant is used up.
    Left,
    /// It will not enter on this grant: revoked, stale or not needed.
    NotEntered,
}

/// What a robot says that it refused when it cannot read section work: it acts as if its authority had ended.
pub const UNREADABLE_WORK: &str = "work";

/// One fact from a robot, lanes CRITICAL and EVENT.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RobotEvent {
    /// News of an attempt: accepted, refused, step done, ended.
    Attempt(AttemptReport),
    /// A place was entered, left or given back.
    Place {
        /// The place that it is about.
        place_id: PlaceId,
        /// On which grant; 0: none.
        grant_id: u64,
        /// What happened.
        news: PlaceNews,
    },
    /// A fault began or ended.
    Fault {
        /// The fault, with its code and class.
        fault: Fault,
        /// It is over.
        cleared: bool,
    },
    /// Who drives changed.
    Mode(Mode),
    /// The maker's safety system changed.
    HardwareStop(HardwareStop),
    /// What it carries changed.
    Load(Option<Load>),
    /// It refused a message for its authority.
    StaleAuthority {
        /// What was refused: `offer`, `grant`, `resume`, or [`UNREADABLE_WORK`].
        what: String,
        /// Why, for a person.
        detail: String,
    },
    /// What it obeys of fleet stops and of their silence changed. A start that nobody stopped says nothing.
    FleetStop {
        /// What it obeys now.
        level: StopLevel,
        /// Effective stops that it lies inside of.
        stops: Vec<StopId>,
        /// What waits for a person's resume.
        awaiting_resume: Vec<StopId>,
    },
    /// News of its software.
    Update(UpdateEvent),
    /// The state of charge fell below the critical threshold.
    BatteryCritical {
        /// State of charge, permille.
        battery_permille: u16,
    },
}

/// One numbered sample of a lane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sample {
    /// From 1, +1 each per (ring, lane); survives restarts.
    pub seq: u64,
    /// Robot's wall clock, unix ms UTC. Shown, never used for order.
    pub robot_unix_ms: i64,
    /// What the robot saw or did.
    pub body: SampleBody,
}

/// What a sample carries.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SampleBody {
    /// Lanes CRITICAL and EVENT.
    Event(RobotEvent),
    /// Lane STATUS.
    Status(Vitals),
}

/// A range that will never come, said by the robot: loss is never silent.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gap {
    /// The lane whose numbers are missing.
    pub lane: Lane,
    /// First missing number.
    pub from_seq: u64,
    /// Last missing number.
    pub to_seq: u64,
    /// Why they are lost.
    pub reason: Reason,
}

/// Body of a fact in the robot inbox.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InboxEntry {
    /// Who said it.
    pub robot_id: RobotId,
    /// In which session it arrived.
    pub session_epoch: u64,
    /// Ring it comes from.
    pub ring: String,
    /// Its lane: CRITICAL or EVENT.
    pub lane: Lane,
    /// The sample or gap that came, or a mark of one that could not be read.
    pub what: InboxItem,
    /// The robot's stamp was ahead of ours by more than the known offset and error. Never rewritten.
    #[serde(default)]
    pub stamp_in_future: bool,
}

impl InboxEntry {
    /// As text, for [`InboxEntry::parse`].
    pub fn text(&self) -> Arc<str> {
        written(self)
    }
    /// From [`InboxEntry::text`].
    ///
    /// # Errors
    /// If it is not such a text.
    pub fn parse(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }
}

/// A sample, a gap, or a sample nobody could read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InboxItem {
    /// A sample.
    Sample(Sample),
    /// A gap.
    Gap(Gap),
    /// Skipped, recorded, acknowledged.
    Poison {
        /// Its number.
        seq: u64,
        /// What was wrong.
        detail: String,
    },
}

/// A robot's newest session, written by telemetry at each Hello.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Session {
    /// The robot whose session it is.
    pub robot_id: RobotId,
    /// max(old + 1, unix ms): sessions with less are fenced.
    pub session_epoch: u64,
    /// Proves succession in the next Hello.
    pub secret: crate::identity::SessionSecret,
    /// New for each start of the agent.
    pub boot_id: String,
    /// Random, made when the robot's ring was formatted.
    pub ring: String,
    /// What it said of itself.
    pub inventory: crate::robot::Inventory,
    /// Highest generation of section work the robot had applied.
    pub applied_work: u64,
    /// Highest generation of section update the robot had applied.
    #[serde(default)]
    pub applied_update: u64,
    /// Places it said it holds, at Hello.
    pub places: Vec<HeldPlace>,
    /// Robot clock minus server clock, milliseconds, as the sessions before this one measured it last; none: they did not.
    pub clock_offset_ms: Option<i64>,
    /// What it said it has installed, if the key of the robot's machine signed it; none: it said nothing that is believed.
    #[serde(default)]
    pub installed: Option<crate::update::Installed>,
    /// The key of the robot's machine, taken when it was first seen, 64 hexadecimal digits; none: it never said one.
    #[serde(default)]
    pub device_key: Option<String>,
    /// Another key signed what this session said of its software: it is another machine, or one that lost its memory.
    #[serde(default)]
    pub device_key_changed: bool,
    /// That other key, 64 hexadecimal digits; none: it did not change.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub other_device_key: Option<String>,
    /// When the robot was enrolled, as this session found it, UTC unix ms: what was known of its machine holds for that enrolment. None: it showed no
    /// certificate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub enrolled_unix_ms: Option<i64>,
}

impl Session {
    /// One whose robot has said nothing but what it is.
    pub fn new(robot_id: RobotId, session_epoch: u64, inventory: crate::robot::Inventory) -> Self {
        Self {
            robot_id,
            session_epoch,
            secret: Default::default(),
            boot_id: String::new(),
            ring: String::new(),
            inventory,
            applied_work: 0,
            applied_update: 0,
            places: Vec::new(),
            clock_offset_ms: None,
            installed: None,
            device_key: None,
            device_key_changed: false,
            other_device_key: None,
            enrolled_unix_ms: None,
        }
    }
    /// The generation of section work that the server goes on from: none beyond what any server could have given.
    pub fn followed_work(&self) -> u64 {
        followed(self.applied_work)
    }
    /// The same of section update.
    pub fn followed_update(&self) -> u64 {
        followed(self.applied_update)
    }
}

/// What a robot says it has applied, as far as it is believed: whoever followed the largest number could never be answered with it again.
fn followed(said: u64) -> u64 {
    if said > crate::limits::GENERATION_FOLLOWED_MAX { 0 } else { said }
}

impl Record for Session {
    const TABLE: Table = Table::Session;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// Presence of a robot as telemetry sees it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PresenceRow {
    /// The robot whose presence it is.
    pub robot_id: RobotId,
    /// Heard or not.
    pub presence: Presence,
    /// UTC of the wall, since when.
    pub since_unix_ms: i64,
    /// What kept it from work by its own word when it was heard last, the gravest first: [`crate::robot::ReportedState::conditions`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub conditions: Vec<Condition>,
    /// What it said when this row was written; none: it was never heard since rows keep that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub last_heard: Option<LastHeard>,
}

/// One thing that keeps a robot from work by its own word.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Condition {
    /// In words.
    pub what: String,
    /// UTC of the wall, receipt of the first heartbeat that said so.
    pub since_unix_ms: i64,
}

/// What is kept of a heartbeat, for people, until the robot is heard again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastHeard {
    /// UTC of the wall, its receipt.
    pub at_unix_ms: i64,
    /// State of charge.
    pub battery_permille: u16,
    /// Where it was. None: it did not know.
    pub waypoint: Option<WaypointId>,
}

impl PresenceRow {
    /// Of a robot that this store knows nothing else of.
    pub fn new(robot_id: RobotId, presence: Presence, since_unix_ms: i64) -> Self {
        Self { robot_id, presence, since_unix_ms, conditions: Vec::new(), last_heard: None }
    }
    /// The row of a robot after this one, at `wall`. `live`: its newest heartbeat; none: this server has not heard it.
    pub fn next(&self, presence: Presence, live: Option<&Live>, wall: crate::time::Utc) -> Self {
        let Some(live) = live else {
            let since_unix_ms = self.unheard_since_unix_ms();
            return Self { presence, since_unix_ms, ..self.clone() };
        };
        let since_unix_ms = if presence == self.presence { self.since_unix_ms } else { wall.0 };
        Self {
            robot_id: self.robot_id.clone(),
            presence,
            since_unix_ms,
            conditions: self.conditions_of(live),
            last_heard: Some(LastHeard {
                at_unix_ms: live.received_unix_ms,
                battery_permille: live.report.vitals.battery_permille,
                waypoint: live.report.vitals.waypoint.clone(),
            }),
        }
    }
    /// What keeps the robot from work by its newest heartbeat, since when as far as this row knows.
    pub fn conditions_of(&self, live: &Live) -> Vec<Condition> {
        let since =
            |what: &str| self.conditions.iter().find(|known| known.what == what).map(|known| known.since_unix_ms);
        let words = live.report.conditions().into_iter();
        words.map(|what| Condition { since_unix_ms: since(&what).unwrap_or(live.received_unix_ms), what }).collect()
    }
    /// Since when nobody has heard the robot, where nobody who runs now has: at the earliest since it was noted last that it was heard.
    pub fn unheard_since_unix_ms(&self) -> i64 {
        let heard = self.last_heard.as_ref().filter(|_| self.presence != Presence::Offline);
        heard.map_or(self.since_unix_ms, |heard| heard.at_unix_ms)
    }
}

impl Record for PresenceRow {
    const TABLE: Table = Table::Presence;
    body_is_json!();
    fn id(&self) -> String {
        self.robot_id.to_string()
    }
}

/// Highest durable numbers of one ring; guards each append to the inbox, so nothing is stored twice.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LaneMark {
    /// Whose ring.
    pub robot_id: RobotId,
    /// The ring.
    pub ring: String,
    /// Highest CRITICAL number stored.
    pub critical: u64,
    /// Highest EVENT number stored.
    pub event: u64,
    /// When it was written last, UTC of the wall, unix ms; 0: before this was noted.
    #[serde(default)]
    pub at_unix_ms: i64,
}

impl LaneMark {
    /// Of a ring of which nothing is stored.
    pub fn fresh(robot_id: RobotId, ring: &str) -> Self {
        Self { robot_id, ring: ring.to_owned(), critical: 0, event: 0, at_unix_ms: 0 }
    }
}

impl Record for LaneMark {
    const TABLE: Table = Table::LaneMark;
    body_is_json!();
    fn id(&self) -> String {
        format!("{}/{}", self.robot_id, self.ring)
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), order: Some(self.at_unix_ms), ..Index::default() }
    }
}

/// The newest heartbeat of a robot with what the server knows about it: the volatile face, never a row.
#[derive(Clone, Debug, PartialEq)]
pub struct Live {
    /// The robot that sent it.
    pub robot_id: RobotId,
    /// What it said.
    pub report: crate::robot::ReportedState,
    /// When the server had processed it.
    pub processed_at: crate::time::LinkTime,
    /// The same moment on the site clock.
    pub processed_site: crate::time::SiteTime,
    /// UTC of the wall at receipt.
    pub received_unix_ms: i64,
    /// When its progress number last changed, site clock.
    pub progress_at: crate::time::SiteTime,
    /// Robot clock minus server clock, milliseconds, and its error.
    pub clock_offset_ms: Option<(i64, u64)>,
}

impl Live {
    /// The area in which the robot is: that of the waypoint it was at last. None: not known.
    pub fn area<'s>(&self, site: &'s crate::site::Site) -> Option<&'s AreaId> {
        site.area_at(self.report.vitals.waypoint.as_ref())
    }
}

/// A heartbeat as its gateway tells other processes: without the clocks of one of them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Told {
    /// What the robot said.
    pub report: crate::robot::ReportedState,
    /// UTC of the gateway's wall at receipt, milliseconds.
    pub received_unix_ms: i64,
    /// As [`Live::clock_offset_ms`].
    pub clock_offset_ms: Option<(i64, u64)>,
}

impl Told {
    /// As text, for [`Told::parse`].
    pub fn text(&self) -> Arc<str> {
        written(self)
    }
    /// From [`Told::text`].
    ///
    /// # Errors
    /// If it is not such a text.
    pub fn parse(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }
    /// As this process knows it from `now` on, where it knew `before` of the robot; none if that is not older.
    pub fn into_live(self, robot_id: &RobotId, before: Option<&Live>, now: crate::time::Now) -> Option<Live> {
        let order = |report: &crate::robot::ReportedState| (report.session_epoch, report.hb);
        if before.is_some_and(|before| order(&before.report) >= order(&self.report)) {
            return None;
        }
        let progressed = before.is_none_or(|before| before.report.progress() != self.report.progress());
        let progress_at = before.filter(|_| !progressed).map_or(now.site, |before| before.progress_at);
        let Self { report, received_unix_ms, clock_offset_ms } = self;
        let (robot_id, processed_at, processed_site) = (robot_id.clone(), now.link, now.site);
        Some(Live { robot_id, report, processed_at, processed_site, received_unix_ms, progress_at, clock_offset_ms })
    }
}

impl From<&Live> for Told {
    fn from(live: &Live) -> Self {
        let (received_unix_ms, clock_offset_ms) = (live.received_unix_ms, live.clock_offset_ms);
        Self { report: live.report.clone(), received_unix_ms, clock_offset_ms }
    }
}

impl Live {
    /// Everything that the robot had written down when it sent this is stored, if its ring stands at `mark`.
    pub fn is_consumed(&self, mark: Option<&LaneMark>) -> bool {
        let done = |lane: Lane, have: u64| self.report.produced.get(&lane).is_none_or(|p| *p <= have);
        done(Lane::Event, mark.map_or(0, |m| m.event)) && done(Lane::Critical, mark.map_or(0, |m| m.critical))
    }
}
