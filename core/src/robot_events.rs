//! Events of a robot: what comes up from it, as numbered samples of a lane, and as facts in its inbox.

use crate::ids::{AttemptId, PlaceId, RobotId, StopId};
use crate::reason::Reason;
use crate::robot::{Fault, HardwareStop, Lane, Load, Mode, StopLevel, Vitals, WorkState};
use crate::rows::written;
use crate::update::UpdateEvent;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

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
