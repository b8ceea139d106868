//! What goes down to a robot (desired state by sections) and what comes up (events): the values behind the link.
//!
//! Robots get desired state, not commands. Each section has the generation of its one writer and never moves backwards.
//! Written by fleet, composed and sent by telemetry, obeyed by the agent.

mod sessions;

pub use sessions::{ClockOffset, Condition, LaneMark, LastHeard, Live, PresenceRow, Session, SharedHeartbeat};

use crate::authority::Authority;
use crate::ids::{AreaId, AttemptId, DrainId, PlaceId, RobotId, StopId, WaypointId};
use crate::policy::AreaPolicy;
use crate::reason::Reason;
pub use crate::robot::WorkState;
use crate::robot::{Fault, HardwareStop, Lane, Load, Mode, StopLevel, Vitals};
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
    pub areas: Vec<AreaRules>,
}

/// Rules of one area as a robot obeys them. What no robot obeys stays in [`AreaPolicy`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaRules {
    /// Which area.
    pub area_id: AreaId,
    /// Millimetres per second; the lowest of all layers wins. None: this layer sets none.
    pub speed_limit_mm_s: Option<u32>,
    /// Millimetres kept to people and things; the largest of all layers wins. None: this layer sets none.
    pub avoidance_distance_mm: Option<u32>,
    /// Charging ends here, permille.
    pub charge_stop_permille: u16,
    /// No people walk here, as the site says: a robot bears the silence of the stop service longer.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub without_people: bool,
}

impl From<AreaPolicy> for AreaRules {
    /// Where people may walk: a policy says nothing of that.
    fn from(policy: AreaPolicy) -> Self {
        Self {
            area_id: policy.area_id,
            speed_limit_mm_s: policy.speed_limit_mm_s,
            avoidance_distance_mm: policy.avoidance_distance_mm,
            charge_stop_permille: policy.charge_stop_permille,
            without_people: false,
        }
    }
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
