//! Steps of a task: what is done in each, and what may happen if nobody knows whether it was done.

use crate::ids::WaypointId;
use serde::{Deserialize, Serialize};

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
