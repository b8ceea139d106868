//! The planner `fifo-nearest`: ready tasks in the order of the queue; each goes to the nearest eligible idle robot, the least loaded first on a tie.
//!
//! Called once a cycle. An assignment is one item: the robot's mutex, the task, the attempt and its timers; a stale row costs this
//! assignment alone.

use super::candidates::{Candidate, Pool};
use super::{errands, filters};
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::{RobotControl, TimerKind};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::{News, apply_event, arm};
use crate::fleet::tasks::{attempts, errand_reports};
use crate::fleet::traffic::anchor::anchor;
use crate::ids::{AttemptId, RobotId, Subject};
use crate::limits;
use crate::session::Session;
use crate::task::{Event, TaskIntake, TaskState};
use crate::time::Now;
use std::collections::BTreeSet;

/// Gives ready tasks to idle robots, each assignment an item of its own, and gives back who is still idle: of those that were `heard` if
/// no task is ready, and nobody while the walk along the queue goes on in the next turn.
///
/// A walk offers every ready task to the robots that are idle when it begins. Robots that found nothing walk again once they are heard;
/// until then they are offered only tasks that are new.
pub fn plan(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Vec<Candidate> {
    let wanted = !view.queue.is_empty();
    let can_work = |r: &RobotId| filters::robot(view, board, r, &now).is_ok();
    let can_recall = |r: &RobotId| filters::recallable(view, board, r);
    let (mut idle, mut errands) = if wanted {
        (Pool::on_board(view, board, board.keys(), can_work), Pool::on_board(view, board, board.keys(), can_recall))
    } else {
        let wants_errand = |r: &RobotId| board.get(r).is_some_and(|live| errands::wants_any(view, live)) && can_work(r);
        (Pool::on_board(view, board, heard, wants_errand), Pool::default())
    };
    let present: BTreeSet<RobotId> = idle.robots().chain(errands.robots()).cloned().collect();
    let mut walk = view.queue.walk(&present, heard);
    idle.retain(&walk.robots);
    errands.retain(&walk.robots);
    let mut recalled = errand_reports::count_stopping(view);
    while !(idle.is_empty() && errands.is_empty()) {
        if plan.is_cut() {
            view.queue.pause(walk);
            return Vec::new();
        }
        let Some(task_id) = view.queue.next(&mut walk) else { break };
        let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
        plan.report.looked += 1;
        plan.slice.count_looks(1);
        if filters::task(view, board, task, intake, &now).is_err() {
            continue;
        }
        if let Some(robot_id) = idle.take_nearest(view, board, task, intake, &now, &mut plan.slice) {
            let (task, intake) = (task.clone(), intake.clone());
            plan.decide(view, now, "fleet", |tx| offer(tx, &task, &intake, &robot_id, board));
            plan.report.offers += 1;
            continue;
        }
        if recalled > 0 {
            recalled -= 1;
        } else if let Some(robot_id) = errands.take_nearest(view, board, task, intake, &now, &mut plan.slice) {
            plan.decide(view, now, "fleet", |tx| errand_reports::stop_errand(tx, &robot_id));
        }
    }
    let left = idle.robots().chain(errands.robots()).cloned().collect();
    plan.report.more |= view.queue.end(&walk, left, &present);
    idle.rest().collect()
}

/// Writes one offer.
fn offer(tx: &mut Tx, task: &TaskState, intake: &TaskIntake, robot_id: &RobotId, board: &Board) {
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
