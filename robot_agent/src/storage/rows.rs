//! Rows of the ledger: the newest session, the holder of the robot, places, and what is remembered of a task.
//!
//! Invariant: their JSON lies on the disks of robots. A field may be added with a default, never renamed.

use midshift_core::identity::SessionSecret;
use midshift_core::ids::{AttemptId, PlaceId};
use midshift_core::robot_events::AttemptReport;
use midshift_core::step::StepKind;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The newest session, which proves the next one's succession.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SessionMemory {
    /// Its epoch.
    pub session_epoch: u64,
    /// Its secret.
    pub secret: SessionSecret,
    /// The store it was with.
    pub store_id: String,
}

/// Highest generations applied.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Applied {
    /// Section work.
    pub work: u64,
    /// Section policy.
    pub policy: u64,
    /// Section update.
    #[serde(default)]
    pub update: u64,
}

/// A step that must not be done twice, from before it began until its end was written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intent {
    /// Which step.
    pub step: u32,
    /// What it is.
    pub kind: StepKind,
}

/// The holder: the one attempt that this robot executes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Holder {
    /// The attempt that is executed.
    pub attempt: AttemptId,
    /// Steps done = index of the step at hand.
    pub step: u32,
    /// The first irreversible step is done or unknown.
    pub opened: bool,
    /// A step under way that must not be done twice.
    pub intent: Option<Intent>,
    /// Nobody knows whether that step was done.
    pub unknown: bool,
    /// Milliseconds of site time spent so far, without holds.
    pub elapsed_ms: u64,
    /// Milliseconds of site time since acceptance, with holds.
    pub duration_ms: u64,
    /// Millimetres the body had driven at acceptance.
    pub base_odometer_mm: u64,
    /// Of these, with a load.
    pub base_loaded_mm: u64,
    /// Milliwatt-hours the body had spent at acceptance.
    pub base_energy_mwh: u64,
    /// Tenths of a degree, highest seen.
    pub hottest_joint_decidegrees: i32,
}

/// Places the robot is in, may be in after a crash, and grants that are used up.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlacesRow {
    /// Its contour reaches in, with the grant it entered on (0: none).
    pub inside: BTreeMap<PlaceId, u64>,
    /// It was told to drive into these: after a crash they count as entered.
    pub committed: BTreeMap<PlaceId, u64>,
    /// Grants used up or given back that may still stand in the last desired state.
    pub used: BTreeSet<u64>,
}

/// What is remembered of one subject.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SubjectRow {
    /// Highest epoch seen.
    pub epoch: u64,
    /// Robot's wall clock at the last change, unix milliseconds.
    pub at_unix_ms: i64,
    /// How its last attempt here ended.
    pub report: Option<Arc<AttemptReport>>,
}
