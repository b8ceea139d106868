//! A task that passed every rule. Built only by `raw::RawTask::check`; immutable once admitted.

use crate::ids::{RobotId, TaskId};
use crate::step::WorkStep;
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Priority of a task that says none.
pub const DEFAULT_PRIORITY: u8 = 5;
/// The least urgent priority; 0 is the most urgent.
pub const LEAST_PRIORITY: u8 = 9;

/// What the caller wants.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TaskSpec {
    /// Open set: patrol, transport, pick, …
    #[serde(rename = "type")]
    pub kind: String,
    /// 0 most urgent ..= 9.
    pub priority: u8,
    /// Only this robot.
    pub robot_id: Option<RobotId>,
    /// Which robots may do it.
    pub selector: Selector,
    /// 1..=64 steps, in order.
    pub steps: Vec<WorkStep>,
    /// start_to_close of one attempt, milliseconds of site time.
    pub timeout_ms: u64,
    /// How long it may be ready before a robot starts, milliseconds of site time. None: as long as it takes.
    pub schedule_to_start_ms: Option<u64>,
    /// Without progress, milliseconds of site time.
    pub stall_ms: u64,
    /// Not before, UTC.
    pub not_before: Option<Utc>,
    /// Worthless after, UTC.
    pub deadline: Option<Utc>,
    /// How often and when it is tried again.
    pub retry: Retry,
    /// May be suspended at a step boundary for charging or more urgent work.
    pub preemptible: bool,
    /// Tasks that must have SUCCEEDED first.
    pub depends_on: Vec<TaskId>,
    /// Only the robot that has this task when it ends, which is waited for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub same_robot_as: Option<TaskId>,
    /// Of the ready tasks with one key and the same areas the newest alone stays. Empty: it stands for itself.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub coalesce_key: String,
    /// Millimetres per second for this task.
    pub speed_limit_mm_s: Option<u32>,
    /// Free labels.
    pub labels: BTreeMap<String, String>,
    /// Who asked, as the caller says.
    pub requester: String,
    /// Work order of the WMS or MES.
    pub external_ref: String,
    /// W3C traceparent.
    pub trace_context: String,
}

/// Which robots may do a task. All must hold.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Selector {
    /// Equal to the robot's labels.
    pub labels: BTreeMap<String, String>,
    /// Among the robot's capabilities.
    pub capabilities: Vec<String>,
    /// Least version of base software.
    pub minimum_software: Option<String>,
    /// Grams that the robot must be able to carry.
    pub payload_g: u32,
}

/// When and how often a failed attempt is tried again. Only recoverable codes are.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Retry {
    /// Attempts after the first.
    pub max_retry_times: u32,
    /// Before the first retry, milliseconds of site time.
    pub interval_ms: u64,
    /// Multiplies the interval each time.
    pub factor: f64,
    /// Largest interval, milliseconds of site time.
    pub max_interval_ms: u64,
    /// Share of the interval drawn at random, 0..=1.
    pub jitter: f64,
    /// Never the robot that failed.
    pub exclude_failed_robot: bool,
}

impl Default for Retry {
    fn default() -> Self {
        Self {
            max_retry_times: 0,
            interval_ms: 5_000,
            factor: 2.0,
            max_interval_ms: 300_000,
            jitter: 0.2,
            exclude_failed_robot: false,
        }
    }
}

impl Retry {
    /// Back-off before retry `number` (1 = first), with `draw` in 0..1 from the caller's generator. Milliseconds of site time.
    pub fn back_off_ms(&self, number: u32, draw: f64) -> u64 {
        let exponent = i32::try_from(number.saturating_sub(1)).unwrap_or(i32::MAX);
        let base = (self.interval_ms as f64 * self.factor.powi(exponent)).min(self.max_interval_ms as f64);
        (base * (1.0 - self.jitter * draw.clamp(0.0, 1.0))) as u64
    }
}

/// Urgent, normal, background.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// 0 and 1.
    Urgent,
    /// 2 to 6.
    Normal,
    /// 7 to 9.
    Background,
}

impl Class {
    /// As people read it.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Urgent => "urgent",
            Self::Normal => "normal",
            Self::Background => "background",
        }
    }
    /// The class of a priority, so many classes up.
    pub fn from_priority(priority: u8, promotions: u64) -> Self {
        let own = match priority {
            0..=1 => Self::Urgent,
            2..=6 => Self::Normal,
            _ => Self::Background,
        };
        match (own, promotions) {
            (_, 0) => own,
            (Self::Background, 1) => Self::Normal,
            _ => Self::Urgent,
        }
    }
}

impl TaskSpec {
    /// Tasks whose end is waited for, each once.
    pub fn waits_for(&self) -> impl Iterator<Item = &TaskId> {
        let same_robot_as = self.same_robot_as.iter().filter(|id| !self.depends_on.contains(id));
        self.depends_on.iter().chain(same_robot_as)
    }

    /// Names of all actions, each once.
    pub fn actions(&self) -> std::collections::BTreeSet<&str> {
        self.steps
            .iter()
            .filter_map(|s| match &s.kind {
                crate::step::StepKind::Action { name, .. } => Some(name.as_str()),
                _ => None,
            })
            .collect()
    }
    /// Goal of the first goto at or after `step`.
    pub fn next_goal(&self, step: usize) -> Option<&crate::ids::WaypointId> {
        self.goals(step).next()
    }
    /// Goals of every goto at or after `step`, in order.
    pub fn goals(&self, step: usize) -> impl Iterator<Item = &crate::ids::WaypointId> {
        self.steps.iter().skip(step).filter_map(|s| match &s.kind {
            crate::step::StepKind::Goto { waypoint } => Some(waypoint),
            _ => None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn back_off_grows_by_its_factor_up_to_its_limit_and_jitter_only_shortens() {
        let retry = Retry { interval_ms: 10_000, max_interval_ms: 30_000, ..Retry::default() };
        assert_eq!([1, 2, 3, 9].map(|n| retry.back_off_ms(n, 0.0)), [10_000, 20_000, 30_000, 30_000]);
        assert_eq!(retry.back_off_ms(1, 1.0), 8_000);
    }

    #[test]
    fn each_promotion_lifts_by_one_class_up_to_urgent() {
        assert_eq!([0, 1, 2].map(|n| Class::from_priority(5, n)), [Class::Normal, Class::Urgent, Class::Urgent]);
        assert_eq!([0, 1, 2].map(|n| Class::from_priority(9, n)), [Class::Background, Class::Normal, Class::Urgent]);
    }
}
