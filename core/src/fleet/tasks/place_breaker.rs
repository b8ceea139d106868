//! Sends no robot to do an action at a place where three robots failed it: an empty shelf, a jammed door. Ten minutes later one task is let
//! through as a probe.
//!
//! `transitions` tells of failures and of steps that were done; the queue holds back whom a broken step bars. Which step is broken says an
//! open incident: a person who closes it lets tasks go on at once.
//!
//! What does not count: a way (a robot that fails on it is somewhere else), a stop of the robot's own, what the task itself can never do or
//! has no time for, the robot's software, and what the server did not believe.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::broken_steps::StepAt;
use crate::fleet::projection::index::put_in_queue;
use crate::fleet::projection::rows::Incident;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::TaskId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::{FAULT_DISBELIEVED, FAULT_SOFTWARE, FAULT_TIMEOUT, Fault, FaultClass};
use crate::task::{Attempt, Phase, TaskIntake, TaskState};
use crate::time::Utc;
use std::collections::BTreeSet;
use std::ops::Range;

/// Robots that an incident names.
const NAMED_MAX: usize = 8;

/// An attempt failed: if this is the third robot that failed the step here, or a probe, no other is sent to it for a while.
pub(in crate::fleet) fn note_failure(tx: &mut Tx, a: &Attempt) {
    let Some(task_id) = a.attempt.subject.task_id().filter(|_| a.fault.as_ref().is_some_and(is_of_place)) else {
        return;
    };
    let steps = tx.view.intake(task_id).map(|intake| &intake.spec.steps);
    let failed = steps.and_then(|steps| StepAt::of_steps(steps).find(|(nth, _)| Some(*nth) == a.reported));
    let Some((_, at)) = failed else { return };
    let (now, window_ms) = (tx.now.utc, limits::BREAKER_WINDOW.as_ms());
    let robots = tx.view.steps_failed.note_failure(&at, &a.robot_id, now, window_ms);
    let is_broken = tx.view.broken_steps.get(&at).is_some();
    if !is_broken && robots.len() < limits::BREAKER_FAILURES {
        return;
    }
    tx.view.steps_failed.probes.remove(&at);
    let id = format!("{}:{}:{}", Code::PlaceBroken, at.waypoint, at.action);
    let known = tx.view.incidents.get(id.as_str()).map(|i| i.row.clone()).filter(|i| i.closed.is_none());
    let named = known.as_ref().and_then(|known| known.reason.metadata.get("robots")).into_iter();
    let named = named.flat_map(|named| named.split(", ").map(str::to_owned));
    let robots: BTreeSet<String> = named.chain(robots.iter().map(ToString::to_string)).collect();
    let robots: Vec<String> = robots.into_iter().take(NAMED_MAX).collect();
    let reason = Reason::from(Code::PlaceBroken).with("waypoint", &at.waypoint).with("action", &at.action);
    let reason = reason.with("robots", robots.join(", ")).with("again_time", now.plus_ms(window_ms).rfc3339());
    match known {
        Some(known) => tx.put_row(Incident { reason, ..known }, "incident.changed"),
        None => incidents::open_as(tx, id, reason, None, None),
    }
}

/// Whether the place may be at fault.
fn is_of_place(fault: &Fault) -> bool {
    let is_class = !matches!(fault.class, FaultClass::Stop | FaultClass::Semantic);
    is_class && ![FAULT_TIMEOUT, FAULT_SOFTWARE, FAULT_DISBELIEVED].contains(&fault.code)
}

/// A task came on from one step to another: what was done there can be done.
pub(in crate::fleet) fn note_done(tx: &mut Tx, task: &TaskState, intake: &TaskIntake, done: Range<u32>) {
    if tx.view.broken_steps.is_empty() && tx.view.steps_failed.is_empty() {
        return;
    }
    let by = task.robot_id.as_ref().map_or_else(|| "a robot".to_owned(), |robot_id| format!("robot {robot_id}"));
    for (_, at) in StepAt::of_steps(&intake.spec.steps).filter(|(nth, _)| done.contains(nth)) {
        tx.view.steps_failed.forget_failures(&at, tx.now.utc);
        let known = tx.view.broken_steps.get(&at).map(|broken| broken.incident_id.clone());
        known.iter().for_each(|id| incidents::close(tx, id, &format!("{by} did it"), "fleet"));
    }
}

/// Chooses the tasks that are let through to what has been broken for long enough: the first in the queue, and the next where that finds no
/// robot or takes too long.
pub(in crate::fleet) fn choose_probes(view: &mut FleetProjection, now: Utc) {
    let due = view.broken_steps.iter().filter(|(_, broken)| broken.again <= now);
    for at in due.map(|(at, _)| at.clone()).collect::<Vec<_>>() {
        let last = view.steps_failed.probes.get(&at).cloned();
        if last.as_ref().is_some_and(|(task_id, since)| goes_on(view, task_id, *since, now)) {
            continue;
        }
        let last = last.map(|(task_id, _)| task_id);
        let rank = last.as_ref().and_then(|task_id| view.queue.rank(task_id)).cloned();
        let next = view.queue.next_barred(&at, rank.as_ref()).cloned();
        match &next {
            Some(task_id) => drop(view.steps_failed.probes.insert(at, (task_id.clone(), now))),
            None => drop(view.steps_failed.probes.remove(&at)),
        }
        last.iter().chain(&next).for_each(|task_id| put_in_queue(view, task_id));
    }
}

/// Whether a probe may still find a robot, or has one that has not had it for too long.
fn goes_on(view: &FleetProjection, task_id: &TaskId, since: Utc, now: Utc) -> bool {
    let waited_ms = now.ms_since(since);
    if view.queue.rank(task_id).is_some() {
        return waited_ms < limits::OTHERS_FIRST.as_ms();
    }
    let has_robot = |phase| matches!(phase, Phase::Assigned | Phase::Running | Phase::Stopping);
    view.task(task_id).is_some_and(|task| has_robot(task.phase)) && waited_ms < limits::BREAKER_WINDOW.as_ms()
}
