//! What an assignment writes: the robot's mutex, the task, the attempt and its timer, as one item.
//!
//! Called by the planners. Invariant: a stale row costs this assignment alone.

use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::{RobotControl, TimerKind};
use crate::fleet::tasks::attempts;
use crate::fleet::tasks::transitions::{News, apply_event, arm};
use crate::fleet::traffic::anchor::anchor;
use crate::ids::{AttemptId, RobotId, Subject};
use crate::limits;
use crate::session::Session;
use crate::task::{Event, TaskIntake, TaskState};

/// Writes one offer.
pub(super) fn offer(tx: &mut Tx, task: &TaskState, intake: &TaskIntake, robot_id: &RobotId, board: &Board) {
    let Some(anchor) = anchor(tx.view, robot_id, board, limits::OFFER_VALID) else { return };
    tx.rely::<Session>(robot_id.as_str());
    // Whoever had it before and never said that it ended may have been heard elsewhere a moment ago.
    if let Some(before) = task.robot_id.as_ref().filter(|before| tx.view.held_by(before) == task.attempt_id().as_ref())
    {
        tx.rely_on_silence(before);
    }
    let attempt = AttemptId { subject: Subject::Task(task.task_id.clone()), epoch: task.epoch + 1 };
    let mut granted = task.clone();
    granted.epoch += 1;
    granted.robot_id = Some(robot_id.clone());
    tx.put_row(granted, "task.granted");
    let mut record = attempts::fresh_attempt(tx, attempt, robot_id, anchor);
    record.step_index = task.next_step;
    if let Some(visited) = &mut record.visited {
        visited.resume_step = task.next_step;
    }
    record.is_opened = task.opened_robot_id.is_some();
    attempts::take_robot(tx, &record);
    tx.put_row(record.clone(), "attempt.offered");
    arm(tx, TimerKind::OfferAck, &record.attempt, limits::OFFER_VALID.as_ms());
    apply_event(tx, &intake.task_id, News::from_event(Event::PlanOffers, None));
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    let mut control = known.unwrap_or_else(|| RobotControl::new(robot_id.clone()));
    control.tasks += 1;
    tx.put_row(control, "robot.given");
}
