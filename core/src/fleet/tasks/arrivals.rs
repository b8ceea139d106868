//! Whether a robot that says that its task, or a part of it, is done was where that is done.
//!
//! 1. Every standing place of a goto that the attempt had to do must have been entered by its robot since it has the attempt, by its own
//!    word: in order, since what it says of places and of attempts comes in one lane. Where it stands or stood already counts for the steps
//!    that it has come to, not for later ones.
//! 2. An event that says that the work is over without that waits for the next heartbeat that counts. If that says the same, the task asks a
//!    person, and the robot gets no work until a person has closed its incident. A failure owes the steps that it claims, a success all.
//! 3. While the work goes on, a step that was claimed and not seen is not done for the task, unless a later one must not be done twice.
//! 4. Once a part of its word is lost, or with another ring, a success owes its last goal, and nothing else is asked.
//! 5. What cannot be decided is believed: the map has changed, the store turned out to be older than the robot, a person cleared the place,
//!    its row cannot be read, or an older version began the attempt.
//!
//! Called by `facts::inbox` for events, by `facts::repair` for heartbeats, and by `transitions` for steps. `facts::disbelief` acts on it.
//! Invariant: nothing here frees a place or moves a task forward.

use super::{claims, plausible};
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::rows::HolderState;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, PlaceId, RobotId};
use crate::robot::WorkState;
use crate::robot_events::AttemptReport;
use crate::site::Site;
use crate::step::{Effect, StepKind, WorkStep, from_step};
use crate::task::{Attempt, AttemptPhase};
use crate::time::Now;

/// The standing place where the step ends; none: it is no goto, or nothing is reserved there.
fn goal<'s>(site: &'s Site, step: &WorkStep) -> Option<&'s PlaceId> {
    let StepKind::Goto { waypoint } = &step.kind else { return None };
    let at = site.standing_at(site.find(waypoint)?)?;
    Some(&site.place(at).place_id)
}

/// The robot entered the place, or a person cleared it of the robot: that is noted if its attempt has a step there.
pub fn note(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId) {
    note_until(tx, robot_id, place_id, u32::MAX);
}

/// The robot left the place, in which it stood.
pub fn note_left(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId) {
    let step = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).map(|a| a.step_index);
    note_until(tx, robot_id, place_id, step.unwrap_or_default());
}

/// Takes from a heartbeat at which waypoint the robot is.
pub fn note_standing(tx: &mut Tx, live: &NewestHeartbeat) {
    let site = tx.view.site.clone();
    let at = live.report.vitals.waypoint.as_ref().and_then(|waypoint| site.find(waypoint));
    let Some(place) = at.and_then(|at| site.standing_at(at)) else { return };
    let Some(a) = tx.view.held_by(&live.robot_id).and_then(|id| tx.view.attempt(id)) else { return };
    let listed = live.report.attempts.iter().find(|listed| listed.attempt == a.attempt);
    let step = listed.map_or(0, |listed| listed.step_index).max(a.step_index);
    note_until(tx, &live.robot_id, &site.place(place).place_id, step);
}

/// Notes the place if one of the steps of the robot's attempt up to `last` ends there.
fn note_until(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId, last: u32) {
    let Some(a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)) else { return };
    let is_known = a.visited.as_ref().is_none_or(|visited| visited.places.contains(place_id));
    let Some(intake) = a.attempt.subject.task_id().filter(|_| !is_known).and_then(|id| tx.view.intake(id)) else {
        return;
    };
    let mut steps = (0..=last).zip(&intake.spec.steps);
    if !steps.any(|(_, step)| goal(&tx.view.site, step) == Some(place_id)) {
        return;
    }
    let mut a = a.clone();
    if let Some(visited) = &mut a.visited {
        visited.places.insert(place_id.clone());
    }
    tx.put_row(a, "attempt.changed");
}

/// Something that the robot said is lost: of its attempt nobody can tell any more where it was until now.
pub fn lost(tx: &mut Tx, robot_id: &RobotId) {
    let Some(mut a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned() else { return };
    if let Some(visited) = a.visited.as_mut().filter(|visited| !visited.is_incomplete) {
        visited.is_incomplete = true;
        tx.put_row(a, "attempt.changed");
    }
}

fn lose(tx: &mut Tx, id: &AttemptId) {
    if let Some(a) = tx.view.attempt(id).filter(|a| a.visited.is_some()) {
        let unknown = Attempt { visited: None, ..a.clone() };
        tx.put_row(unknown, "attempt.changed");
    }
}

/// The map has changed: where robots were by the one before tells nothing of this one.
pub(in crate::fleet) fn forget(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let noted = view.attempts.values().map(|a| &a.row).filter(|a| a.visited.is_some() && may_end(a));
    let noted: Vec<AttemptId> = noted.map(|a| a.attempt.clone()).collect();
    for id in &noted {
        plan.decide(view, now, "fleet", |tx| lose(tx, id));
    }
}

/// Its robot may still report an end that counts.
fn may_end(a: &Attempt) -> bool {
    !a.phase.is_terminal() || a.phase == AttemptPhase::Lost
}

/// A place where the robot had to be for what it reports, and where it was not seen. None: its work is not over, it was at each of them, or
/// that cannot be told.
pub fn unseen(view: &FleetProjection, now: &Now, robot_id: &RobotId, report: &AttemptReport) -> Option<PlaceId> {
    let id = &report.attempt;
    let task_id = id.subject.task_id().filter(|_| report.state.is_over())?;
    let a = view.attempt(id).filter(|a| a.robot_id == *robot_id && may_end(a))?;
    if report.state == WorkState::Refused && a.accepted.is_none() {
        return None; // It never began.
    }
    let is_newest = view.task(task_id)?.attempt_id().as_ref() == Some(id);
    if !is_newest || plausible::judge(view, id, robot_id, report.state, report.step_index).is_some() {
        return None;
    }
    let is_success = report.state == WorkState::Succeeded;
    unproven(view, now, a, report.step_index, is_success).map(|(_, place_id)| place_id)
}

/// How far the attempt is for its task, if its robot says that so many steps are done: a step that must not be done twice counts as done,
/// wherever its robot was, and so does what came before it.
pub(in crate::fleet) fn proven(
    view: &FleetProjection,
    now: &Now,
    a: &Attempt,
    steps: &[WorkStep],
    claimed: u32,
) -> u32 {
    let Some((unseen, _)) = unproven(view, now, a, claimed, false) else { return claimed };
    let irreversible = steps.iter().take(claimed as usize).rposition(|step| step.effect == Effect::AtMostOnce);
    unseen.max(irreversible.map_or(0, |step| step as u32 + 1))
}

/// The first drive of the attempt among the first `claimed` steps that ends where its robot was not seen.
fn unproven(view: &FleetProjection, now: &Now, a: &Attempt, claimed: u32, is_success: bool) -> Option<(u32, PlaceId)> {
    let visited = a.visited.as_ref().filter(|_| !view.bugs.success_is_believed())?;
    let steps = &view.intake(a.attempt.subject.task_id()?)?.spec.steps;
    let begun = (is_success || claimed > visited.resume_step).then(|| from_step(steps, visited.resume_step));
    let is_due = |step: u32| (visited.resume_step..claimed).contains(&step) || begun == Some(step);
    let drives = (0..).zip(steps).filter(|(step, what)| is_due(*step) && matches!(what.kind, StepKind::Goto { .. }));
    let mut drives: Vec<(u32, &WorkStep)> = drives.collect();
    let first = drives.first().map(|(step, _)| *step);
    let ring = &view.sessions.get(a.robot_id.as_str())?.row.ring;
    if visited.is_incomplete || *ring != visited.ring {
        let kept = if is_success { 1 } else { 0 };
        drives.drain(..drives.len().saturating_sub(kept));
    }
    let given = view.desired_work.get(a.robot_id.as_str()).and_then(|d| d.row.assignment.as_ref());
    let given = given.filter(|given| given.attempt == a.attempt);
    let began_at = given.and_then(|given| given.route.first()?.standing.as_ref());
    let is_unseen = |step: u32, place: &PlaceId| {
        let stood_there = Some(step) == first && began_at == Some(place);
        !stood_there && !visited.places.contains(place) && is_elsewhere(view, &a.robot_id, place)
    };
    let owed = drives.into_iter().filter(|(_, what)| !what.continue_on_fail);
    let mut goals = owed.filter_map(|(step, what)| Some((step, goal(&view.site, what)?)));
    let unseen = goals.find(|(step, place)| is_unseen(*step, place));
    unseen.filter(|_| !claims::is_ahead(view, &a.robot_id, now)).map(|(step, place)| (step, place.clone()))
}

/// The row of the place says that the robot is not inside of it now. One that this build cannot read says nothing.
fn is_elsewhere(view: &FleetProjection, robot_id: &RobotId, place_id: &PlaceId) -> bool {
    let place = view.places.get(place_id.as_str()).map(|place| &place.row);
    place.is_some_and(|place| place.holder(robot_id).is_none_or(|holder| holder.state != HolderState::Inside))
}

/// An event says that the work is over and its robot was not seen there: the next heartbeat tells. What the event adds is taken.
pub fn wait(tx: &mut Tx, report: &AttemptReport) {
    let Some(mut a) = tx.view.attempt(&report.attempt).cloned() else { return };
    a.is_opened |= report.opened;
    a.stats = report.stats;
    a.fault = report.fault.clone().or(a.fault);
    tx.put_row(a, "attempt.changed");
}
