//! What became of each task of a shift, and who waits for what: fed by every row of a task that fleet commits.

use midshift_core::ids::{RobotId, TaskId};
use midshift_core::site::WaypointIx;
use midshift_core::task::TaskState;
use midshift_core::task::machine::Phase;
use midshift_core::task::spec::Class;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::sync::Notify;

/// One task. Times are milliseconds since the beginning of the shift.
#[derive(Clone, Debug)]
pub struct TaskRecord {
    /// Class of its priority.
    pub class: Class,
    /// Where it leads, in order.
    pub goals: Vec<WaypointIx>,
    /// When it was submitted.
    pub submitted_ms: u64,
    /// When a robot was named for it for the first time.
    pub assigned_ms: Option<u64>,
    /// When it was done.
    pub done_ms: Option<u64>,
    /// Times that it was given to a robot again although none had failed at it.
    pub reassignments: u32,
    /// Times that it was given to a robot again because an attempt had failed.
    pub retries: u32,
    /// Where it is.
    pub phase: Phase,
    /// Code of why it is there; none: there is nothing to say.
    pub reason: Option<&'static str>,
    epoch: u64,
    /// Failed attempts when it was assigned last.
    failures: u32,
    robot_id: Option<RobotId>,
}

impl TaskRecord {
    /// Whether it ended in another way than done.
    pub fn has_failed(&self) -> bool {
        self.phase.is_terminal() && self.done_ms.is_none()
    }
}

#[derive(Default)]
struct Records {
    tasks: BTreeMap<TaskId, TaskRecord>,
    /// The newest task of each robot that has one.
    busy: BTreeMap<RobotId, TaskId>,
    /// Tasks that wait for a person.
    asking: BTreeSet<TaskId>,
    /// Tasks that a person has answered.
    answers: u64,
    /// Tasks without a robot, and since when, milliseconds since the beginning.
    waiting: BTreeMap<TaskId, u64>,
    open: usize,
    /// Ended in another way than done.
    failed: u64,
    /// Said to be done once more after they had ended.
    ended_twice: u64,
}

/// The records of one shift.
#[derive(Default)]
pub struct TaskRecords {
    records: Mutex<Records>,
    changed: Notify,
}

/// What is counted at one moment.
#[derive(Clone, Copy, Debug, Default)]
pub struct TaskCounts {
    /// Without a robot.
    pub waiting: usize,
    /// Not ended.
    pub open: usize,
    /// Robots that have a task.
    pub busy: usize,
    /// In NEEDS_OPERATOR.
    pub asking: usize,
    /// Answers that a person gave so far.
    pub answers: u64,
    /// Ended in another way than done.
    pub failed: u64,
    /// Said to have ended although they had ended before.
    pub ended_twice: u64,
}

impl TaskRecords {
    fn lock(&self) -> MutexGuard<'_, Records> {
        self.records.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A task is submitted now.
    pub fn add(&self, task_id: TaskId, class: Class, goals: Vec<WaypointIx>, now_ms: u64) {
        let record = TaskRecord {
            class,
            goals,
            submitted_ms: now_ms,
            assigned_ms: None,
            done_ms: None,
            reassignments: 0,
            retries: 0,
            phase: Phase::Queued,
            reason: None,
            epoch: 0,
            failures: 0,
            robot_id: None,
        };
        let mut records = self.lock();
        records.waiting.insert(task_id.clone(), now_ms);
        records.tasks.insert(task_id, record);
        records.open += 1;
    }

    /// A committed row says where a task is.
    pub fn note_state(&self, state: &TaskState, now_ms: u64) {
        let mut records = self.lock();
        let Some(record) = records.tasks.get_mut(&state.task_id) else { return };
        let before = std::mem::replace(&mut record.phase, state.phase);
        record.reason = state.reason.as_ref().map(|reason| reason.code.as_str());
        if state.epoch > record.epoch {
            record.epoch = state.epoch;
            let failures = std::mem::replace(&mut record.failures, state.failures);
            match record.assigned_ms {
                None => record.assigned_ms = Some(now_ms),
                Some(_) if state.failures != failures => record.retries += 1,
                Some(_) => record.reassignments += 1,
            }
        }
        let has_robot = state.phase.has_attempt();
        let robot_id = state.robot_id.clone().filter(|_| has_robot);
        let left = std::mem::replace(&mut record.robot_id, robot_id.clone());
        let ends = state.phase.is_terminal() && !before.is_terminal();
        if ends && state.phase == Phase::Succeeded {
            record.done_ms = Some(now_ms);
        }
        if let Some(left) = left.filter(|left| records.busy.get(left) == Some(&state.task_id)) {
            records.busy.remove(&left);
        }
        records.busy.extend(robot_id.map(|robot_id| (robot_id, state.task_id.clone())));
        match state.phase {
            Phase::NeedsOperator => records.asking.insert(state.task_id.clone()),
            _ => records.asking.remove(&state.task_id),
        };
        records.ended_twice += u64::from(before.is_terminal() && state.phase != before);
        records.failed += u64::from(ends && state.phase != Phase::Succeeded);
        records.open -= usize::from(ends);
        match (is_waiting(before), is_waiting(state.phase)) {
            (true, false) => records.waiting.remove(&state.task_id),
            (false, true) => records.waiting.insert(state.task_id.clone(), now_ms),
            _ => return,
        };
        drop(records);
        self.changed.notify_one();
    }

    /// Resolves when a task found a robot, lost it, or ended.
    pub async fn changed(&self) {
        self.changed.notified().await;
    }

    /// What is counted now.
    pub fn counts(&self) -> TaskCounts {
        let records = self.lock();
        TaskCounts {
            waiting: records.waiting.len(),
            open: records.open,
            busy: records.busy.len(),
            asking: records.asking.len(),
            answers: records.answers,
            failed: records.failed,
            ended_twice: records.ended_twice,
        }
    }

    /// Robots that have a task.
    pub fn busy_robots(&self) -> BTreeSet<RobotId> {
        self.lock().busy.keys().cloned().collect()
    }

    /// Tasks without a robot, and since when, milliseconds since the beginning.
    pub fn waiting_tasks(&self) -> BTreeMap<TaskId, u64> {
        self.lock().waiting.clone()
    }

    /// Tasks that wait for a person.
    pub fn tasks_that_ask(&self) -> BTreeSet<TaskId> {
        self.lock().asking.clone()
    }

    /// A person has answered one of them.
    pub fn note_answer(&self) {
        self.lock().answers += 1;
    }

    /// Whether a task has not ended, and waits for no person.
    pub fn is_worked_on(&self, task_id: &TaskId) -> bool {
        let over = |phase: Phase| phase.is_terminal() || phase == Phase::NeedsOperator;
        self.lock().tasks.get(task_id).is_some_and(|task| !over(task.phase))
    }

    /// When each of these tasks got its first robot, if any, milliseconds since the beginning, beside what stands for it.
    pub fn assigned<'t, T>(&self, of: &'t BTreeMap<TaskId, T>) -> Vec<(&'t T, Option<u64>)> {
        let records = self.lock();
        let assigned = |task_id| records.tasks.get(task_id).and_then(|task| task.assigned_ms);
        of.iter().map(|(task_id, what)| (what, assigned(task_id))).collect()
    }

    /// Every task, in the order of its id.
    pub fn tasks(&self) -> Vec<TaskRecord> {
        self.lock().tasks.values().cloned().collect()
    }
}

fn is_waiting(phase: Phase) -> bool {
    matches!(phase, Phase::Queued | Phase::RetryWait | Phase::Suspended)
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::time::Utc;

    fn state(records: &TaskRecords, phase: Phase, epoch: u64, now_ms: u64) {
        let task_id = TaskId::parse("TASK-1").expect("a valid id");
        let robot_id = RobotId::parse("rbt-01").ok().filter(|_| epoch > 0);
        let row = serde_json::json!({
            "task_id": task_id, "number": 1, "phase": phase, "reason": null, "then": null, "holds": [], "epoch": epoch,
            "robot_id": robot_id, "opened_robot_id": null, "next_step": 0, "failures": 0, "refusals_in_row": 0,
            "failed_robots": [], "semantic_refusers": [], "queued_since": Utc(0), "ready_since": null,
            "retry_at": null, "cancel_requested": null, "started": null, "ended": null, "changed": Utc(0),
            "stats": midshift_core::robot_events::WorkStats::default(),
        });
        records.note_state(&serde_json::from_value(row).expect("a row"), now_ms);
    }

    #[test]
    fn a_task_that_loses_its_robot_waits_again_and_is_done_once() {
        let records = TaskRecords::default();
        records.add(TaskId::parse("TASK-1").expect("a valid id"), Class::Normal, Vec::new(), 10);
        assert_eq!((records.counts().waiting, records.counts().open), (1, 1));
        state(&records, Phase::Assigned, 1, 20);
        assert_eq!((records.counts().waiting, records.busy_robots().len()), (0, 1));
        state(&records, Phase::Queued, 1, 30);
        assert_eq!((records.counts().waiting, records.busy_robots().len()), (1, 0));
        state(&records, Phase::Running, 2, 40);
        state(&records, Phase::Succeeded, 2, 90);
        let task = records.tasks().pop().expect("one task");
        assert_eq!((task.reassignments, task.retries), (1, 0), "no attempt had failed");
        assert_eq!((task.assigned_ms, task.done_ms, task.has_failed()), (Some(20), Some(90), false));
        let counts = records.counts();
        assert_eq!((counts.waiting, counts.open, counts.failed, counts.ended_twice), (0, 0, 0, 0));
        state(&records, Phase::Failed, 2, 95);
        assert_eq!(records.counts().ended_twice, 1, "an end after the end is seen");
    }
}
