//! Takes robots that fail attempts again and again out of dispatch, until a person says so.
//!
//! These count against a robot:
//! 1. An attempt that failed by its fault.
//! 2. One that it took and then let go by its own word: nobody had asked, no step was done, and it has not come anew
//!    since.
//! 3. One of which it said that the work cannot be done as asked, once another robot has done that work. Until then the
//!    task may be at fault.
//!
//! Called by `transitions` and `facts::inbox`. A robot that restarted, or that a person took over, lets nothing go of its own will.

use super::plausible;
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::RobotControl;
use crate::ids::RobotId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::WorkState;
use crate::robot_events::AttemptReport;
use crate::task::{Phase, TaskState};

/// Notes a failure of the robot; three within the window open its breaker.
pub(in crate::fleet) fn trip(tx: &mut Tx, robot_id: &RobotId) {
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    let mut control = known.unwrap_or_else(|| RobotControl::new(robot_id.clone()));
    let now = tx.now.utc;
    control.failures.retain(|at| now.ms_since(*at) <= limits::BREAKER_WINDOW.as_ms());
    control.failures.push(now);
    if control.failures.len() >= limits::BREAKER_FAILURES && control.breaker.is_none() {
        control.breaker = Some(now);
        let reason = Reason::from(Code::RobotBreakerOpened).with("failures", control.failures.len());
        incidents::open(tx, reason, Some(robot_id), None);
    }
    tx.put_row(control, "robot.failed");
}

/// Counts an attempt that the robot is about to let go, if that is its own will. The task still stands as it did before
/// the report.
pub(in crate::fleet) fn count_let_go(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport) {
    let id = &report.attempt;
    if !matches!(report.state, WorkState::Aborted | WorkState::Suspended | WorkState::Refused)
        || tx.view.held_by(robot_id) != Some(id)
        || plausible::judge(tx.view, id, robot_id, report.state, report.step_index).is_some()
    {
        return;
    }
    let task = id.subject.task_id().and_then(|task_id| tx.view.task(task_id));
    // Held, told to stop, driven by a person, not heard for long: what it lets go then has another cause.
    let is_unasked = task.is_some_and(|task| task.phase == Phase::Running && task.attempt_id().as_ref() == Some(id));
    let session = tx.view.sessions.get(robot_id.as_str()).map(|session| session.row.session_epoch);
    let attempt = tx.view.attempt(id).filter(|a| a.accepted.is_some() && a.uncertain.is_none());
    let is_same = attempt.is_some_and(|a| session == Some(a.offer.session_epoch));
    let given = tx.view.desired_work.get(robot_id.as_str()).and_then(|desired| desired.row.assignment.as_ref());
    let begun = given.filter(|given| given.attempt == *id).map_or(0, |given| given.resume_step);
    if is_unasked && is_same && report.step_index <= begun {
        trip(tx, robot_id);
    }
}

/// The task is done: whoever said of it that it cannot be done as asked was wrong.
pub(in crate::fleet) fn disprove(tx: &mut Tx, task: &TaskState) {
    let said_so = task.failed_robots.intersection(&task.semantic_refusers);
    for robot_id in said_so.filter(|robot_id| task.robot_id.as_ref() != Some(*robot_id)) {
        trip(tx, robot_id);
    }
}
