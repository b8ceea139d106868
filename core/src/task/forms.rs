//! Short forms of a transport and what they expand to: goto(from), pick, goto(to), place. Called by the task service, the CLI and task lists.

use super::raw::{RawRetry, RawStep, RawStepKind, RawTask};
use serde_json::{Map, Value};

/// A transport from one waypoint to another, as both JSON forms of the source article and a CSV row say it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Transport {
    /// `type` or `task_type`.
    pub kind: String,
    /// 0..=9; absent: 5.
    pub priority: Option<i64>,
    /// Empty: any.
    pub robot_id: String,
    /// Empty: no pick leg, only the drive to `to_waypoint`.
    pub from_waypoint: String,
    /// The waypoint where it ends.
    pub to_waypoint: String,
    /// Item; empty: the body names what it finds.
    pub item_sku: String,
    /// Required by the rules of a task.
    pub timeout_ms: Option<i64>,
    /// Absent: 0.
    pub max_retry_times: Option<i64>,
    /// Absent: 5 s.
    pub retry_interval_ms: Option<i64>,
    /// How long it may be ready before a robot starts. Absent: no limit.
    pub schedule_to_start_ms: Option<i64>,
    /// Only the robot that had this task. Empty: any.
    pub same_robot_as: String,
    /// Of the tasks with one key only the newest stays. Empty: it stands for itself.
    pub coalesce_key: String,
}

impl Transport {
    /// Expands to the steps it stands for. Rules are checked afterwards, with all others.
    pub fn into_raw(self) -> RawTask {
        let mut params = Map::new();
        if !self.item_sku.is_empty() {
            params.insert("item".to_owned(), Value::from(self.item_sku.as_str()));
        }
        let goto = |name: &str| RawStep { kind: Some(RawStepKind::Goto(name.to_owned())), ..RawStep::default() };
        let act = |name: &str| RawStep {
            kind: Some(RawStepKind::Action(name.to_owned(), params.clone())),
            ..RawStep::default()
        };
        let steps = if self.from_waypoint.is_empty() {
            vec![goto(&self.to_waypoint)]
        } else {
            vec![goto(&self.from_waypoint), act("pick"), goto(&self.to_waypoint), act("place")]
        };
        let retry = (self.max_retry_times.is_some() || self.retry_interval_ms.is_some()).then(|| RawRetry {
            max_retry_times: self.max_retry_times.unwrap_or(0),
            interval_ms: self.retry_interval_ms,
            ..RawRetry::default()
        });
        RawTask {
            kind: self.kind,
            priority: self.priority,
            robot_id: self.robot_id,
            steps,
            timeout_ms: self.timeout_ms,
            schedule_to_start_ms: self.schedule_to_start_ms,
            retry,
            same_robot_as: self.same_robot_as,
            coalesce_key: self.coalesce_key,
            ..RawTask::default()
        }
    }
}
