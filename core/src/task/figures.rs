//! What a task came to, for the figures of a shift: the same words in the metrics of fleet and in the report of `midshift dev`.

use super::spec::Class;
use super::{Phase, TaskIntake, TaskState};
use crate::ids::TaskId;
use crate::time::Utc;

/// What a task came to that has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TaskFigures {
    /// Which task.
    pub task_id: TaskId,
    /// How it ended.
    pub phase: Phase,
    /// By its priority, without what waiting brought it.
    pub class: Class,
    /// Its type.
    pub kind: String,
    /// Milliseconds of site time from when nothing but a robot was missing until the first robot took it. None: none did.
    pub wait_ms: Option<u64>,
    /// See [`completion_ms`].
    pub completion_ms: Option<u64>,
    /// How often it was given to a robot.
    pub attempts: u64,
}

impl TaskFigures {
    /// By its rows.
    pub fn of_rows(task: &TaskState, intake: &TaskIntake) -> Self {
        Self {
            task_id: task.task_id.clone(),
            phase: task.phase,
            class: Class::from_priority(task.priority(intake), 0),
            kind: intake.spec.kind.clone(),
            wait_ms: task.started.zip(task.ready_since).map(|(started, ready)| started.ms_since(ready)),
            completion_ms: completion_ms(task.phase, intake.created, task.ended),
            attempts: task.epoch,
        }
    }
}

/// Milliseconds of site time from admission to success. None: it did not succeed.
pub fn completion_ms(phase: Phase, created: Utc, ended: Option<Utc>) -> Option<u64> {
    ended.filter(|_| phase == Phase::Succeeded).map(|ended| ended.ms_since(created))
}
