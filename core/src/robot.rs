//! What is known of one robot: the report it sends each second, and the facts others derive from it.
//!
//! Four independent facts, each with one owner: presence ([`crate::presence`], telemetry), mode (the robot), duty (fleet), software (OTA, later).

use crate::ids::{AttemptId, PlaceId, StopId, TaskId, WaypointId};
use crate::update::UpdateReport;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Who drives. Decided by the robot. VDA 5050 words.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// The agent drives.
    #[default]
    Automatic,
    /// A person drives; a live attempt becomes UNCERTAIN.
    Manual,
    /// It is being maintained.
    Service,
}

/// Whether fleet gives it work.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Duty {
    /// It gets work.
    InWork,
    /// A person took it out.
    Cordoned,
    /// The breaker took it out.
    BrokenOff,
    /// Gone for good; no producer until OTA's `robot retire`.
    Retired,
}

/// State of the maker's own safety system, shown and never replaced.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HardwareStop {
    /// Not stopped.
    #[default]
    None,
    /// To be reset at the robot.
    Manual,
    /// Ends by itself.
    AutoAck,
    /// Pressed at a remote device.
    Remote,
}

/// Level of an operational stop as the robot obeys it now. Ordered: the most restrictive wins.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StopLevel {
    /// No stop.
    #[default]
    None,
    /// Drive slowly.
    Slow,
    /// Stand still, powered.
    Halt,
    /// Move into a posture that stays stable, then stand.
    ControlledStopPosture,
}

/// Where the robot is, in the frame of its site's map (x east, y north, right-handed).
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Millimetres to the east.
    pub x_mm: i32,
    /// Millimetres to the north.
    pub y_mm: i32,
    /// Thousandths of a radian, -3142..=3142, counter-clockwise from x.
    pub theta_mrad: i32,
}

impl Pose {
    /// As a frame, metres and radians.
    pub fn isometry(&self) -> nalgebra::Isometry2<f64> {
        let translation = nalgebra::Vector2::new(f64::from(self.x_mm) / 1000.0, f64::from(self.y_mm) / 1000.0);
        nalgebra::Isometry2::new(translation, f64::from(self.theta_mrad) / 1000.0)
    }
    /// From a frame in metres and radians, rounded.
    pub fn from_isometry(frame: &nalgebra::Isometry2<f64>) -> Self {
        let mm = |v: f64| (v * 1000.0).round() as i32;
        Self { x_mm: mm(frame.translation.x), y_mm: mm(frame.translation.y), theta_mrad: mm(frame.rotation.angle()) }
    }
}

/// What class of answer a fault needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultClass {
    /// May be retried (obstacle 1001, gripper missed 1002, network).
    Recoverable,
    /// A person must look (jam, load lost). Never retried.
    Mechanical,
    /// Raised by a stop or protective function. Never retried.
    Stop,
    /// The work cannot be done as asked. Never retried on this robot.
    Semantic,
    /// One of a newer version, by its number on the wire. Never retried.
    #[serde(untagged)]
    Unknown(i32),
}

/// A numbered fault as the robot's maker reports it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Fault {
    /// Maker's number, > 0.
    pub code: u32,
    /// What answer it needs.
    pub class: FaultClass,
    /// Maker's text, at most 200 bytes, shown and never parsed.
    #[serde(default)]
    pub message: String,
}

/// An obstacle stood in the way for too long.
pub const FAULT_OBSTACLE: u32 = 1001;
/// The gripper closed on nothing.
pub const FAULT_GRIPPER_MISSED: u32 = 1002;
/// A mechanical jam.
pub const FAULT_JAM: u32 = 2001;
/// The agent's own clock ended the attempt.
pub const FAULT_TIMEOUT: u32 = 1003;
/// What the robot runs is not what was signed and committed: said by the agent, not by the maker.
pub const FAULT_SOFTWARE: u32 = 9001;
/// The robot said that its work is done and was not where that is done: said by the server, of no robot's own.
pub const FAULT_DISBELIEVED: u32 = 9002;
/// The work names what the body or map does not have.
pub const FAULT_SEMANTIC: u32 = 4001;

/// What the robot carries.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Load {
    /// The task it belongs to; none if a person put it there.
    pub task_id: Option<TaskId>,
    /// The item, as the step named it.
    pub item: String,
}

/// What a robot does with an attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WorkState {
    /// It took it and has not moved yet.
    Accepted,
    /// It refused it.
    Refused,
    /// It drives.
    Navigating,
    /// It acts or waits.
    Executing,
    /// It stands and keeps it.
    Paused,
    /// It is on its way to a stop.
    Stopping,
    /// It has done all steps.
    Succeeded,
    /// Ended by a fault.
    Failed,
    /// Stopped on request, or dropped by a person at the robot.
    Aborted,
    /// Stopped at a step boundary on request; the rest is handed back.
    Suspended,
    /// Restarted inside a step that must not be done twice: nobody knows.
    StepUnknown,
    /// One of a newer version, by its number on the wire: it is not over, and nothing moves forward by it.
    #[serde(untagged)]
    Unknown(i32),
}

impl WorkState {
    /// Whether the robot will do nothing more with it.
    pub const fn is_over(self) -> bool {
        matches!(self, Self::Refused | Self::Succeeded | Self::Failed | Self::Aborted | Self::Suspended)
    }
}

/// An attempt as the robot reports it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportedAttempt {
    /// Which attempt.
    pub attempt: AttemptId,
    /// What it does with it.
    pub state: WorkState,
    /// Steps done so far = index of the step at hand.
    pub step_index: u32,
    /// Rises whenever the work moves on; a number that stands still is a stall.
    pub progress: u64,
    /// Index of the last route point reached.
    pub route_index: u32,
    /// The first irreversible step is done or unknown.
    pub opened: bool,
}

/// A place the robot holds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HeldPlace {
    /// Which place.
    pub place_id: PlaceId,
    /// The grant it was entered on; 0: none (start-up, by hand).
    pub grant_id: u64,
    /// Its contour reaches into it. False: granted and not yet entered.
    pub inside: bool,
}

/// Which of the lanes of robot samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Lane {
    /// Stop state, collision, over-temperature, battery critical, fault.
    Critical,
    /// What happened.
    Event,
    /// How it was, each 1-3 s.
    Status,
}

impl Lane {
    /// All, most urgent first.
    pub const ALL: [Lane; 3] = [Lane::Critical, Lane::Event, Lane::Status];
    /// Its name.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Critical => "critical",
            Self::Event => "event",
            Self::Status => "status",
        }
    }
}

/// The volatile part of a report: where it is and how it is. Also the body of a STATUS sample.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Vitals {
    /// Where; none until the body knows.
    pub pose: Option<Pose>,
    /// Last waypoint passed or stood on.
    pub waypoint: Option<WaypointId>,
    /// Millimetres per second.
    pub speed_mm_s: u32,
    /// State of charge, 0..=1000.
    pub battery_permille: u16,
    /// Energy flows in.
    pub charging: bool,
    /// Tenths of a degree Celsius.
    pub hottest_joint_decidegrees: i32,
    /// Millimetres driven since the ledger was made.
    pub odometer_mm: u64,
    /// Of these, with a load.
    pub loaded_odometer_mm: u64,
    /// Milliwatt-hours spent since the ledger was made.
    pub energy_mwh: u64,
}

/// The heartbeat, which is the periodic status: everything the robot believes of itself, once a second.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ReportedState {
    /// Number of this heartbeat within its session, from 1.
    pub hb: u64,
    /// Session it belongs to.
    pub session_epoch: u64,
    /// Highest desired generation applied, section work.
    pub applied_work: u64,
    /// Highest desired generation applied, section policy.
    pub applied_policy: u64,
    /// Highest desired generation applied, section update. 0: none.
    #[serde(default)]
    pub applied_update: u64,
    /// Highest number written per lane: what is still to come before differences count.
    pub produced: BTreeMap<Lane, u64>,
    /// Who drives.
    pub mode: Mode,
    /// Where and how.
    pub vitals: Vitals,
    /// What it carries.
    pub load: Option<Load>,
    /// Attempts it has authority or memory of that the server has not seen end.
    pub attempts: Vec<ReportedAttempt>,
    /// Places it stands in or may enter.
    pub places: Vec<HeldPlace>,
    /// The level of stop it obeys, of fleet stops, of silence or of what waits for a resume.
    pub stop_level: StopLevel,
    /// Fleet stops that are effective, as far as it knows, and that it lies inside of.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stops: Vec<StopId>,
    /// Fleet stops and silences that stood it and that nobody has resumed: it does not move before.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub awaiting_resume: Vec<StopId>,
    /// Version of the site's map that its body drives by. Empty: it goes by points alone, or has said it before in its session.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub map_version: String,
    /// Bytes of room for software when it last looked. None: it is not known, or was said before in its session.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub free_bytes: Option<u64>,
    /// Maker's safety system.
    pub hardware_stop: HardwareStop,
    /// Maker's protective field is violated.
    pub field_violation: bool,
    /// A standing fault.
    pub fault: Option<Fault>,
    /// Its newest update, as long as that is of interest.
    #[serde(default)]
    pub update: Option<UpdateReport>,
}

impl ReportedState {
    /// A number that changes with whatever the robot does: only whether it changes counts, so that absurd numbers do no harm.
    pub fn progress(&self) -> u64 {
        let moved = |sum: u64, a: &ReportedAttempt| sum.wrapping_add(a.progress).wrapping_add(u64::from(a.step_index));
        self.attempts.iter().fold(self.vitals.odometer_mm, moved)
    }

    /// What keeps it from work by its own word, in words, the gravest first: a fault, its own stop, a fleet stop, who drives, a missing
    /// resume.
    pub fn conditions(&self) -> Vec<String> {
        let fault = self.fault.as_ref().map(|fault| format!("fault {}", fault.code));
        let own_stop = match self.hardware_stop {
            HardwareStop::None => None,
            HardwareStop::Manual => Some("own stop manual"),
            HardwareStop::AutoAck => Some("own stop auto-ack"),
            HardwareStop::Remote => Some("own stop remote"),
        };
        let stop = match self.stop_level {
            StopLevel::None => None,
            StopLevel::Slow => Some("stop slow"),
            StopLevel::Halt => Some("stop halt"),
            StopLevel::ControlledStopPosture => Some("stop controlled-stop-posture"),
        };
        let mode = match self.mode {
            Mode::Automatic => None,
            Mode::Manual => Some("manual"),
            Mode::Service => Some("service"),
        };
        let waits = (!self.awaiting_resume.is_empty()).then_some("awaits resume");
        let words = [own_stop, stop, mode, waits].into_iter().flatten().map(str::to_owned);
        fault.into_iter().chain(words).collect()
    }
}

/// What a robot says of itself that does not change within a session.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Inventory {
    /// Actions its body can do and other capabilities, lower case.
    pub capabilities: Vec<String>,
    /// Key and value, at most 32.
    pub labels: BTreeMap<String, String>,
    /// Grams it can carry.
    pub payload_g: u32,
    /// Version of its base software, semantic version; empty: not reported.
    pub software: String,
    /// Version of its agent.
    pub agent_version: String,
    /// Maker's model name.
    pub model: String,
    /// It cannot feel what it carries: it knows that by its own memory, and forgets it by a person's word ([`crate::desired_state::LoadWord`]).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub load_by_memory: bool,
}
