//! Whether a robot that says that its task is done was where that is done.
//!
//! 1. Every standing place of a goto that the attempt had to do must have been entered by its robot since it has the attempt, by its own
//!    word: in order, since what it says of places and of attempts comes in one lane. Where it stood already counts.
//! 2. An event that says it is done without that waits for the next heartbeat that counts. If that says the same, the task asks a person,
//!    and the robot gets no work until a person has closed its incident.
//! 3. What cannot be decided is believed: an event was lost, the robot writes in another ring, the map has changed, the store turned out to
//!    be older than the robot, a person cleared the place, its row cannot be read, or an older version began the attempt.
//!
//! Called by `inbox` for events, by `repair` for heartbeats, and by `screen`. Invariant: nothing here frees a place or moves a task forward.

use super::rows::HolderState;
use super::tasks::{News, happen};
use super::view::View;
use super::{Plan, Tx, claims, inbox, incidents, plausible};
use crate::ids::{AttemptId, PlaceId, RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::robot::{FAULT_DISBELIEVED, Fault, FaultClass};
use crate::site::Site;
use crate::task::{Attempt, AttemptPhase, Event};
use crate::time::Now;
use crate::work::{Assignment, AttemptReport, Live, StepKind, WorkState, WorkStep};

/// The standing place where the step ends; none: it is no goto, or nothing is reserved there.
fn goal<'s>(site: &'s Site, step: &WorkStep) -> Option<&'s PlaceId> {
    let StepKind::Goto { waypoint } = &step.kind else { return None };
    let at = site.standing_at(site.find(waypoint)?)?;
    Some(&site.place(at).place_id)
}

/// The robot is or was inside of the place, or a person cleared it of the robot: that is noted if its attempt has a step there.
pub fn note(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId) {
    let Some(a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)) else { return };
    let is_known = a.been.as_ref().is_none_or(|been| been.places.contains(place_id));
    let Some(intake) = a.attempt.subject.task_id().filter(|_| !is_known).and_then(|id| tx.view.intake(id)) else {
        return;
    };
    if !intake.spec.steps.iter().any(|step| goal(&tx.view.site, step) == Some(place_id)) {
        return;
    }
    let mut a = a.clone();
    if let Some(been) = &mut a.been {
        been.places.insert(place_id.clone());
    }
    tx.put(a, "attempt.changed");
}

/// Takes from a heartbeat at which waypoint the robot is.
pub fn note_standing(tx: &mut Tx, live: &Live) {
    let site = tx.view.site.clone();
    let at = live.report.vitals.waypoint.as_ref().and_then(|waypoint| site.find(waypoint));
    if let Some(place) = at.and_then(|at| site.standing_at(at)) {
        note(tx, &live.robot_id, &site.place(place).place_id);
    }
}

/// Something that the robot said is lost: of its attempt nobody can tell any more where it was.
pub fn lost(tx: &mut Tx, robot_id: &RobotId) {
    if let Some(id) = tx.view.held_by(robot_id).cloned() {
        lose(tx, &id);
    }
}

fn lose(tx: &mut Tx, id: &AttemptId) {
    if let Some(a) = tx.view.attempt(id).filter(|a| a.been.is_some()) {
        let unknown = Attempt { been: None, ..a.clone() };
        tx.put(unknown, "attempt.changed");
    }
}

/// The map has changed: where robots were by the one before tells nothing of this one.
pub(super) fn forget(view: &mut View, now: Now, plan: &mut Plan) {
    let noted = view.attempts.values().map(|a| &a.row).filter(|a| a.been.is_some() && may_end(a));
    let noted: Vec<AttemptId> = noted.map(|a| a.attempt.clone()).collect();
    for id in &noted {
        plan.decide(view, now, "fleet", |tx| lose(tx, id));
    }
}

/// Its robot may still report an end that counts.
fn may_end(a: &Attempt) -> bool {
    !a.phase.is_terminal() || a.phase == AttemptPhase::Lost
}

/// A place where the robot had to be for what it reports, and where it was not seen. None: it says nothing of an end that counts, it was at
/// each of them, or that cannot be told.
pub fn unseen(view: &View, now: &Now, robot_id: &RobotId, report: &AttemptReport) -> Option<PlaceId> {
    let id = &report.attempt;
    let task_id = id.subject.task_id().filter(|_| report.state == WorkState::Succeeded)?;
    let a = view.attempt(id).filter(|a| a.robot_id == *robot_id && may_end(a))?;
    let is_newest = view.task(task_id)?.attempt_id().as_ref() == Some(id);
    if !is_newest || plausible::judge(view, id, robot_id, report.state, report.step_index).is_some() {
        return None;
    }
    let been = a.been.as_ref().filter(|_| !view.bugs.success_is_believed())?;
    let ring = &view.sessions.get(robot_id.as_str())?.row.ring;
    if *ring != been.ring || claims::is_ahead(view, robot_id, now) {
        return None;
    }
    let is_unseen = |place: &&PlaceId| !been.places.contains(*place) && is_elsewhere(view, robot_id, place);
    goals(view, a)?.into_iter().find(is_unseen).cloned()
}

/// Standing places that the attempt had to reach. Once it is taken back nobody knows where it began: then the last of them.
fn goals<'v>(view: &'v View, a: &Attempt) -> Option<Vec<&'v PlaceId>> {
    let site: &Site = &view.site;
    let given = view.desired_work.get(a.robot_id.as_str()).and_then(|d| d.row.assignment.as_ref());
    if let Some(given) = given.filter(|given| given.attempt == a.attempt) {
        let begun_at = given.route.first().and_then(|point| point.standing.as_ref());
        let due = given.steps.iter().enumerate().filter(|(step, _)| is_due(given, *step as u32)).map(|(_, step)| step);
        let due = due.filter(|step| !step.continue_on_fail).filter_map(|step| goal(site, step));
        return Some(due.filter(|place| begun_at != Some(*place)).collect());
    }
    let steps = &view.intake(a.attempt.subject.task_id()?)?.spec.steps;
    let last = steps.iter().rfind(|step| matches!(step.kind, StepKind::Goto { .. }))?;
    Some(goal(site, last).filter(|_| !last.continue_on_fail).into_iter().collect())
}

/// The attempt does this step itself.
fn is_due(given: &Assignment, step: u32) -> bool {
    step == given.from_step || step >= given.resume_step
}

/// The row of the place says that the robot is not inside of it now. One that this build cannot read says nothing.
fn is_elsewhere(view: &View, robot_id: &RobotId, place_id: &PlaceId) -> bool {
    let place = view.places.get(place_id.as_str()).map(|place| &place.row);
    place.is_some_and(|place| place.holder(robot_id).is_none_or(|holder| holder.state != HolderState::Inside))
}

/// An event says that the work is done and its robot was not seen there: the next heartbeat tells. What the event adds is taken.
pub fn wait(tx: &mut Tx, report: &AttemptReport) {
    let Some(mut a) = tx.view.attempt(&report.attempt).cloned() else { return };
    a.opened |= report.opened;
    a.stats = report.stats;
    tx.put(a, "attempt.changed");
}

/// The heartbeat says the same: the task asks a person, and the robot is looked at.
pub fn disbelieve(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport, place_id: &PlaceId) {
    let Some(task_id) = report.attempt.subject.task_id() else { return };
    let Some(step_index) = tx.view.attempt(&report.attempt).map(|a| a.step_index) else { return };
    let message = format!("it was never seen at {place_id}");
    let fault = Some(Fault { code: FAULT_DISBELIEVED, class: FaultClass::Mechanical, message });
    // Of its word counts what it adds, and no step.
    let report = AttemptReport { step_index, fault, ..report.clone() };
    let why = told(robot_id, task_id, place_id);
    incidents::open_as(tx, incident_of(robot_id), why.clone(), Some(robot_id), Some(task_id));
    happen(tx, task_id, News { event: Event::FailedFinal, why: Some(&why), report: Some(&report) });
    inbox::release(tx, robot_id, &report);
}

fn told(robot_id: &RobotId, task_id: &TaskId, place_id: &PlaceId) -> Reason {
    let text = format!(
        "{robot_id} said that {task_id} is done and was never seen at {place_id} while it had it. Look there and where the \
         item is, then `midshift task resolve {task_id}`. {robot_id} gets no work until its incident is closed: look at the \
         robot, then `midshift incident close {} --reason TEXT`.",
        incident_of(robot_id)
    );
    let reason = Reason::new(Code::GoalNotEntered, text).with("place_id", place_id);
    reason.with("task_id", task_id).with("robot_id", robot_id)
}

/// One of a robot: it gets no work while it is open.
fn incident_of(robot_id: &RobotId) -> String {
    format!("{}:{robot_id}", Code::GoalNotEntered)
}

/// Keeps work from a robot whose word was not believed and that nobody has looked at.
///
/// # Errors
/// If so; the reason says what it said.
pub fn screen(view: &View, robot_id: &RobotId) -> Result<(), Reason> {
    let incident = view.incidents.get(&incident_of(robot_id)).map(|i| &i.row);
    match incident.filter(|i| i.closed.is_none()) {
        Some(open) => Err(open.reason.clone()),
        None => Ok(()),
    }
}
