//! Sends no robot to do a step at a place where three robots failed it: an empty shelf, a jammed door. Ten minutes later one task is let
//! through to try.
//!
//! `transitions` tells of failures and of steps that were done; `assignment` asks whether a task leads there. What is broken is an open
//! incident: a person who closes it lets tasks go on at once. A stop that a robot's protection raised says nothing of the place.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::broken_steps::{BrokenStep, StepAt};
use crate::fleet::projection::queue::TASKS_PER_TURN;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::TaskId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::FaultClass;
use crate::step;
use crate::task::{Attempt, Phase, TaskIntake, TaskState};
use crate::time::Utc;
use std::ops::Range;

/// An attempt failed: if it is the third robot that failed this step here, or a try, no other is sent to it for a while.
pub(in crate::fleet) fn note_failure(tx: &mut Tx, a: &Attempt) {
    let Some(task_id) =
        a.attempt.subject.task_id().filter(|_| a.fault.as_ref().is_some_and(|f| f.class != FaultClass::Stop))
    else {
        return;
    };
    let steps = tx.view.intake(task_id).map(|intake| &intake.spec.steps);
    let at = steps.and_then(|steps| StepAt::of_steps(steps).find(|(nth, _)| *nth == a.step_index));
    let Some((_, at)) = at else { return };
    let now = tx.now.utc;
    let window_ms = limits::BREAKER_WINDOW.as_ms();
    let robots = tx.view.steps_failed.note_failure(&at, &a.robot_id, now, window_ms);
    let is_broken = tx.view.broken_steps.get(&at).is_some();
    if !is_broken && robots.len() < limits::BREAKER_FAILURES {
        return;
    }
    tx.view.steps_failed.tries.remove(&at);
    let robots = robots.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    let reason = Reason::from(Code::PlaceBroken).with("waypoint", &at.waypoint).with("step", &at.step);
    let reason = reason.with("robots", robots).with("again_time", now.plus_ms(window_ms).rfc3339());
    incidents::open_as(tx, id_of(&at), reason, None, None);
}

/// A task came on from one step to another: what was done is not broken.
pub(in crate::fleet) fn note_done(tx: &mut Tx, task: &TaskState, intake: &TaskIntake, done: Range<u32>) {
    if tx.view.broken_steps.is_empty() {
        return;
    }
    let by = task.robot_id.as_ref().map_or_else(|| "a robot".to_owned(), |robot_id| format!("robot {robot_id}"));
    let done: Vec<StepAt> =
        StepAt::of_steps(&intake.spec.steps).filter(|(nth, _)| done.contains(nth)).map(|(_, at)| at).collect();
    for at in done {
        let known = tx.view.broken_steps.get(&at).map(|broken| broken.incident_id.clone());
        known.iter().for_each(|id| incidents::close(tx, id, &format!("{by} did it"), "fleet"));
    }
}

/// The first step of what is left of a task that is broken, unless the task is the one to try it.
pub(in crate::fleet) fn first_broken(view: &FleetProjection, task: &TaskState, intake: &TaskIntake) -> Option<Reason> {
    let (at, broken) = broken_of(view, task, intake).find(|(at, _)| !tries(view, at, &task.task_id))?;
    let reason = Reason::from(Code::PlaceBroken).with("waypoint", &at.waypoint).with("step", &at.step);
    Some(reason.with("incident_id", &broken.incident_id).with("again_time", broken.again.rfc3339()))
}

/// Chooses the tasks that try what has been broken for long enough: the first in the queue, and another one where that finds no robot.
pub(in crate::fleet) fn choose_tries(view: &mut FleetProjection, now: Utc) {
    let due: Vec<StepAt> =
        view.broken_steps.iter().filter(|(_, broken)| broken.again <= now).map(|(at, _)| at.clone()).collect();
    for at in due {
        let last = view.steps_failed.tries.get(&at).cloned();
        if last.as_ref().is_some_and(|(task_id, since)| goes_on(view, task_id, *since, now)) {
            continue;
        }
        let leads_there = |task_id: &&TaskId| {
            let rows = view.task(task_id).zip(view.intake(task_id));
            rows.is_some_and(|(task, intake)| broken_of(view, task, intake).any(|(step, _)| step == at))
        };
        let after = last.as_ref().and_then(|(task_id, _)| view.queue.position(task_id)).unwrap_or(0);
        let behind = view.queue.ready().skip(after).take(TASKS_PER_TURN);
        let next = behind.chain(view.queue.ready().take(after.min(TASKS_PER_TURN))).find(leads_there).cloned();
        match next {
            Some(task_id) => {
                view.queue.show_again(&task_id);
                view.steps_failed.tries.insert(at, (task_id, now));
            }
            None => drop(view.steps_failed.tries.remove(&at)),
        }
    }
}

/// The incident of a step.
fn id_of(at: &StepAt) -> String {
    format!("{}:{}:{}", Code::PlaceBroken, at.waypoint, at.step)
}

fn tries(view: &FleetProjection, at: &StepAt, task_id: &TaskId) -> bool {
    view.steps_failed.tries.get(at).is_some_and(|(known, _)| known == task_id)
}

/// Broken steps of what is left of a task.
fn broken_of<'v>(
    view: &'v FleetProjection,
    task: &TaskState,
    intake: &TaskIntake,
) -> impl Iterator<Item = (StepAt, &'v BrokenStep)> {
    let (steps, next) = (&intake.spec.steps, task.next_step);
    let steps = if view.broken_steps.is_empty() { &[] } else { steps.as_slice() };
    let from = step::from_step(steps, next);
    let is_left = |nth: u32| nth == from || nth >= next;
    let left: Vec<StepAt> = StepAt::of_steps(steps).filter(|(nth, _)| is_left(*nth)).map(|(_, at)| at).collect();
    left.into_iter().filter_map(|at| view.broken_steps.get(&at).map(|broken| (at, broken)))
}

/// Whether a try is under way, or may still find a robot.
fn goes_on(view: &FleetProjection, task_id: &TaskId, since: Utc, now: Utc) -> bool {
    if view.queue.rank(task_id).is_some() {
        return now.ms_since(since) < limits::OTHERS_FIRST.as_ms();
    }
    let with_robot = |phase| matches!(phase, Phase::Assigned | Phase::Running | Phase::Held | Phase::Stopping);
    view.task(task_id).is_some_and(|task| with_robot(task.phase))
}
