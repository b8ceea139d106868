//! The planner `fifo-nearest`: tasks by class, priority and age; each goes to the nearest eligible idle robot, the least loaded first on a tie.
//!
//! Called once a cycle. An assignment is one item: the robot's mutex, the task, the attempt and its timers; a stale row costs this
//! assignment alone.

use super::anchor::anchor;
use super::rows::{RobotControl, TimerKind};
use super::tasks::{News, arm, happen};
use super::tx::Tx;
use super::view::View;
use super::{Board, Plan, attempts, errands, screen, timers, way};
use crate::ids::{AttemptId, RobotId, Subject, TaskId};
use crate::limits;
use crate::reason::Code;
use crate::site::WaypointIx;
use crate::task::spec::Class;
use crate::task::{Event, Phase, TaskIntake, TaskState};
use crate::time::Now;
use std::collections::BTreeMap;

/// Waiting tasks looked at in one cycle at most; the rest keep their order and come next.
pub const TASKS_PER_CYCLE: usize = 4_096;

/// Waiting tasks in the order in which they are served.
pub fn queue(view: &View, now: &Now) -> Vec<TaskId> {
    let waiting = view.tasks.values().map(|t| &t.row).filter(|t| t.phase == Phase::Queued);
    let mut keyed: Vec<_> = waiting
        .filter_map(|t| {
            let priority = view.intake(&t.task_id)?.spec.priority;
            let promoted = now.utc.ms_since(t.queued_since) > limits::MAX_WAIT.as_ms();
            Some((Class::of(priority, promoted), priority, t.number, &t.task_id))
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(.., id)| id.clone()).collect()
}

/// One idle robot.
#[derive(Clone, Copy)]
struct Idle {
    at: WaypointIx,
    tasks: u64,
}

/// Robots that can be given work now.
fn idle(view: &View, board: &Board, now: &Now) -> BTreeMap<RobotId, Idle> {
    let can = board.keys().filter(|r| screen::robot(view, board, r, now).is_ok());
    can.filter_map(|r| {
        let at = way::find(view, board.get(r)?.report.vitals.waypoint.as_ref())?;
        let tasks = view.control.get(r.as_str()).map_or(0, |c| c.row.tasks);
        Some((r.clone(), Idle { at, tasks }))
    })
    .collect()
}

/// Gives waiting tasks to idle robots. Each assignment is an item of its own.
pub fn plan(view: &mut View, board: &Board, now: Now, plan: &mut Plan) {
    let queue = queue(view, &now);
    if queue.is_empty() {
        return;
    }
    let mut idle = idle(view, board, &now);
    let mut recalled = errands::stopping(view);
    for task_id in queue.into_iter().take(TASKS_PER_CYCLE) {
        let Some((task, intake)) = view.task(&task_id).cloned().zip(view.intake(&task_id).cloned()) else { continue };
        match screen::task(view, board, &task, &intake, &now) {
            Err(reason) if reason.code == Code::DependencyFailed => {
                plan.decide(view, now, "fleet", |tx| {
                    happen(tx, &task_id, News::of(Event::ScheduleToStart, Some(&reason)));
                });
                continue;
            }
            Err(reason) => {
                plan.report.wait(reason.code);
                arm_once(view, now, plan, &task_id);
                continue;
            }
            Ok(()) => {}
        }
        match nearest(view, board, &idle, &task, &intake) {
            Some(robot_id) => {
                idle.remove(&robot_id);
                plan.decide(view, now, "fleet", |tx| offer(tx, &task, &intake, &robot_id, board));
                plan.report.offers += 1;
            }
            None => {
                plan.report.wait(Code::WaitingForRobot);
                arm_once(view, now, plan, &task_id);
                if recalled > 0 {
                    recalled -= 1;
                } else if let Some(robot_id) = recall(view, board, &task, &intake) {
                    plan.decide(view, now, "fleet", |tx| errands::stop(tx, &robot_id));
                }
            }
        }
    }
}

fn arm_once(view: &mut View, now: Now, plan: &mut Plan, task_id: &TaskId) {
    let waiting = AttemptId { subject: Subject::Task(task_id.clone()), epoch: 0 };
    if !view.timers.contains_key(&super::rows::Timer::id_of(TimerKind::ScheduleToStart, &waiting)) {
        plan.decide(view, now, "fleet", |tx| timers::arm_waiting(tx, task_id));
    }
}

/// First goal of what is left of the task.
fn first_goal(view: &View, task: &TaskState, intake: &TaskIntake) -> Option<WaypointIx> {
    let from = way::from_step(&intake.spec.steps, task.next_step);
    intake.spec.next_goal(from as usize).and_then(|g| view.site.find(g))
}

/// The nearest idle robot that passes every filter: another than one that failed it, if there is one; then by distance, tasks so far, id.
fn nearest(
    view: &View,
    board: &Board,
    idle: &BTreeMap<RobotId, Idle>,
    task: &TaskState,
    intake: &TaskIntake,
) -> Option<RobotId> {
    let goal = first_goal(view, task, intake);
    let field = goal.map(|g| view.router.field(g));
    let mut by_cost: Vec<_> = idle
        .iter()
        .filter_map(|(id, robot)| {
            let distance = match &field {
                Some(field) => field.distance_mm(robot.at)?,
                None => 0,
            };
            Some((task.failed_robots.contains(id), distance, robot.tasks, id))
        })
        .collect();
    by_cost.sort_unstable();
    by_cost.into_iter().map(|(.., id)| id).find(|id| screen::pair(view, board, id, task, intake).is_ok()).cloned()
}

/// The nearest robot that could be called back from an errand for this task.
fn recall(view: &View, board: &Board, task: &TaskState, intake: &TaskIntake) -> Option<RobotId> {
    let goal = first_goal(view, task, intake)?;
    let field = view.router.field(goal);
    let candidates = board.iter().filter(|(id, _)| screen::recallable(view, board, id));
    let near = candidates.filter_map(|(id, live)| {
        let at = way::find(view, live.report.vitals.waypoint.as_ref())?;
        screen::pair(view, board, id, task, intake).ok()?;
        Some((field.distance_mm(at)?, id))
    });
    near.min().map(|(_, id)| id.clone())
}

/// Writes one offer.
fn offer(tx: &mut Tx, task: &TaskState, intake: &TaskIntake, robot_id: &RobotId, board: &Board) {
    let Some(anchor) = anchor(tx.view, robot_id, board, limits::OFFER_VALID) else { return };
    let attempt = AttemptId { subject: Subject::Task(task.task_id.clone()), epoch: task.epoch + 1 };
    let mut granted = task.clone();
    granted.epoch += 1;
    granted.robot_id = Some(robot_id.clone());
    tx.put(granted, "task.granted");
    let mut record = attempts::fresh_attempt(tx, attempt, robot_id, anchor);
    record.step_index = task.next_step;
    record.opened = task.opened.is_some();
    attempts::take_robot(tx, &record);
    tx.put(record.clone(), "attempt.offered");
    arm(tx, TimerKind::OfferAck, &record.attempt, limits::OFFER_VALID.as_ms());
    happen(tx, &intake.task_id, News::of(Event::PlanOffers, None));
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    let mut control = known.unwrap_or_else(|| RobotControl::new(robot_id.clone()));
    control.tasks += 1;
    tx.put(control, "robot.given");
}
