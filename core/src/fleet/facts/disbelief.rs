//! What follows when a robot's word cannot be: its attempt becomes UNCERTAIN, or its task asks a person, and the robot is looked at.
//!
//! Called by `inbox` for events and by `repair` for heartbeats; `tasks::plausible` and `tasks::arrivals` judge. Invariant: nothing here frees
//! a place or moves a task forward.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::errand_reports;
use crate::fleet::tasks::transitions::{self, News, apply_event};
use crate::ids::{AttemptId, PlaceId, RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::robot::WorkState;
use crate::robot::{FAULT_DISBELIEVED, Fault, FaultClass};
use crate::robot_events::AttemptReport;
use crate::task::Event;

/// The heartbeat says the same: the task asks a person, and the robot is looked at.
pub fn disbelieve(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport, place_id: &PlaceId) {
    let Some(task_id) = report.attempt.subject.task_id() else { return };
    let Some(step_index) = tx.view.attempt(&report.attempt).map(|a| a.step_index) else { return };
    let message = format!("it was never seen at {place_id}");
    let fault = Some(Fault { code: FAULT_DISBELIEVED, class: FaultClass::Mechanical, message });
    // Of its word counts what it adds, and no step.
    let report = AttemptReport { step_index, fault, ..report.clone() };
    let why = explain_disbelief(tx.view, robot_id, &report, task_id, place_id);
    incidents::open_as(tx, incident_of(robot_id), why.clone(), Some(robot_id), Some(task_id));
    apply_event(tx, task_id, News { event: Event::FailedFinal, why: Some(&why), report: Some(&report) });
    transitions::release(tx, robot_id, &report);
}

fn explain_disbelief(
    view: &FleetProjection,
    robot_id: &RobotId,
    report: &AttemptReport,
    task_id: &TaskId,
    place_id: &PlaceId,
) -> Reason {
    let what = if report.state == WorkState::Succeeded { "" } else { "a part of " };
    let is_canceled = view.task(task_id).is_some_and(transitions::wants_cancel);
    let answer = format!(", then `midshift task resolve {task_id} --as ANSWER --reason TEXT`");
    let answer = if is_canceled { "" } else { &answer };
    let text = format!(
        "{robot_id} said that {what}{task_id} is done and was never seen at {place_id} while it had it. Look there and where \
         the item is{answer}. {robot_id} gets no work until its incident is closed: look at the robot, then \
         `midshift incident close {} --reason TEXT`.",
        incident_of(robot_id)
    );
    let reason = Reason::new(Code::GoalNotEntered, text).with("place_id", place_id);
    reason.with("task_id", task_id).with("robot_id", robot_id)
}

/// One of a robot: it gets no work while it is open.
fn incident_of(robot_id: &RobotId) -> String {
    format!("{}:{robot_id}", Code::GoalNotEntered)
}

/// Checks that a robot was believed, or that a person has looked at it since.
///
/// # Errors
/// If neither; the reason says what the robot said.
pub fn check_believed(view: &FleetProjection, robot_id: &RobotId) -> Result<(), Reason> {
    let incident = view.incidents.get(incident_of(robot_id).as_str()).map(|i| &i.row);
    match incident.filter(|i| i.closed.is_none()) {
        Some(open) => Err(open.reason.clone()),
        None => Ok(()),
    }
}

/// A report of the attempt cannot be: a person is told, and the attempt becomes UNCERTAIN, both once.
pub fn doubt(tx: &mut Tx, robot_id: &RobotId, id: &AttemptId, why: &Reason) {
    let quiet = tx.view.bugs.doubt_is_kept_quiet();
    let is_new = quiet || incidents::open_about(tx, why.clone(), Some(robot_id), "attempt");
    let lives = tx.view.attempt(id).is_some_and(|a| a.uncertain.is_none() && !a.phase.is_terminal());
    if !is_new || !lives || tx.view.held_by(robot_id) != Some(id) {
        return;
    }
    match id.subject.task_id() {
        Some(task_id) => {
            apply_event(tx, task_id, News::from_event(Event::LeaseOver, Some(why)));
        }
        None => errand_reports::mark_uncertain(tx, robot_id, why.clone()),
    }
}
