//! The planner `fifo-nearest`: tasks by class, priority and age; each goes to the nearest eligible idle robot, the least loaded first on a tie.
//!
//! Called once a cycle. An assignment is one item: the robot's mutex, the task, the attempt and its timers; a stale row costs this
//! assignment alone.

use super::Tx;
use super::anchor::anchor;
use super::pool::{Candidate, Pool};
use super::rows::{RobotControl, TimerKind};
use super::tasks::{News, arm, happen};
use super::view::View;
use super::{Board, Pace, Plan, attempts, errands, screen, timers};
use crate::ids::{AttemptId, RobotId, Subject, TaskId};
use crate::limits;
use crate::reason::Code;
use crate::task::spec::Class;
use crate::task::{Event, Phase, TaskIntake, TaskState};
use crate::time::{Now, Utc};
use crate::work::Session;
use std::collections::BTreeSet;

/// Waiting tasks looked at in one cycle at most; the rest keep their order and come next.
pub const TASKS_PER_CYCLE: usize = 4_096;

/// Waiting tasks in the order in which they are served: by class, priority and age.
pub fn queue<'a>(view: &'a View, now: &Now) -> impl Iterator<Item = &'a TaskId> + use<'a> {
    let class = |priority: u8, since: Utc| Class::of(priority, now.utc.ms_since(since) > limits::MAX_WAIT.as_ms());
    let waiting = view.queued.iter().map(|((priority, _), (id, since))| (class(*priority, *since), id));
    let mut waiting: Vec<_> = waiting.collect();
    waiting.sort_by_key(|(class, _)| *class);
    waiting.into_iter().map(|(_, id)| id)
}

/// Gives waiting tasks to idle robots, each assignment an item of its own, and gives back who is still idle: of those that were `heard`
/// if no task waits. While there is nobody to give to, only a sweep looks at every waiting task.
pub fn plan(
    view: &mut View,
    board: &Board,
    now: Now,
    pace: Pace,
    heard: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Vec<Candidate> {
    let wanted = !view.queued.is_empty();
    let mut idle =
        Pool::of(view, board, |r| (wanted || heard.contains(r)) && screen::robot(view, board, r, &now).is_ok());
    let mut errands = Pool::of(view, board, |r| wanted && screen::recallable(view, board, r));
    let mut recalled = errands::stopping(view);
    let later = view.fresh.iter().nth(TASKS_PER_CYCLE).cloned().map(|id| view.fresh.split_off(&id));
    let fresh = std::mem::replace(&mut view.fresh, later.unwrap_or_default());
    let all = pace == Pace::Sweep || !idle.is_empty() || !errands.is_empty();
    let queue: Vec<TaskId> = if all { queue(view, &now).take(TASKS_PER_CYCLE).cloned().collect() } else { Vec::new() };
    for task_id in queue {
        if pace == Pace::Wake && idle.is_empty() && errands.is_empty() {
            break;
        }
        let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
        match screen::task(view, board, task, intake, &now) {
            Err(reason) if reason.code == Code::DependencyFailed => {
                plan.decide(view, now, "fleet", |tx| {
                    happen(tx, &task_id, News::of(Event::ScheduleToStart, Some(&reason)));
                });
                continue;
            }
            Err(reason) => {
                plan.report.wait(reason.code);
                continue;
            }
            Ok(()) => {}
        }
        if let Some(robot_id) = idle.take(view, board, task, intake) {
            let (task, intake) = (task.clone(), intake.clone());
            plan.decide(view, now, "fleet", |tx| offer(tx, &task, &intake, &robot_id, board));
            plan.report.offers += 1;
            continue;
        }
        plan.report.wait(Code::WaitingForRobot);
        if recalled > 0 {
            recalled -= 1;
        } else if let Some(robot_id) = errands.take(view, board, task, intake) {
            plan.decide(view, now, "fleet", |tx| errands::stop(tx, &robot_id));
        }
    }
    for task_id in fresh {
        arm_once(view, now, plan, &task_id);
    }
    idle.rest().collect()
}

fn arm_once(view: &mut View, now: Now, plan: &mut Plan, task_id: &TaskId) {
    let waiting = AttemptId { subject: Subject::Task(task_id.clone()), epoch: 0 };
    if view.task(task_id).is_some_and(|t| t.phase == Phase::Queued)
        && !view.timers.contains_key(&super::rows::Timer::id_of(TimerKind::ScheduleToStart, &waiting))
    {
        plan.decide(view, now, "fleet", |tx| timers::arm_waiting(tx, task_id));
    }
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
