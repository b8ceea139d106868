//! Fires deadlines in serving time, and the deadlines of tasks in UTC.
//!
//! Invariant: nothing fires in the first 10 s of serving, so that robots say hello first; a timeout stops a robot and
//! never frees it.

use super::Tx;
use super::rows::{Timer, TimerKind};
use super::tasks::{News, arm, disarm, happen};
use super::view::View;
use super::{Board, errands};
use crate::ids::{AttemptId, Subject, TaskId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot::Presence;
use crate::task::{Event, Phase, Then};
use crate::time::Now;

/// Timers that are due, and tasks whose deadline passed.
pub fn due(view: &View, now: &Now) -> (Vec<Timer>, Vec<TaskId>) {
    if now.link.since(view.started.link) < limits::TIMER_GRACE {
        return (Vec::new(), Vec::new());
    }
    let served = view.serving(now);
    let fired = |t: &Timer| {
        let clock = if t.kind.is_site() { served.site_ms } else { served.link_ms };
        t.fires_at_service_ms.is_some_and(|at| at <= clock)
    };
    let timers = view.timers.values().map(|t| &t.row).filter(|t| fired(t)).cloned().collect();
    let late = |id: &&TaskId| view.intake(id).and_then(|i| i.spec.deadline).is_some_and(|d| d <= now.utc);
    let moves = |p: Phase, then: Option<Then>| {
        p != Phase::NeedsOperator && !matches!(then, Some(Then::Expired | Then::Canceled))
    };
    let tasks = view.tasks.values().map(|t| &t.row).filter(|t| moves(t.phase, t.then)).map(|t| &t.task_id).filter(late);
    (timers, tasks.cloned().collect())
}

/// Fires one timer.
pub fn fire(tx: &mut Tx, timer: &Timer, board: &Board) {
    let Some(task_id) = timer.attempt.subject.task_id().cloned() else {
        errands::fire(tx, timer);
        return;
    };
    let current = tx.view.task(&task_id).and_then(|t| t.attempt_id()).as_ref() == Some(&timer.attempt)
        || timer.attempt.epoch == 0;
    let (event, code) = match timer.kind {
        TimerKind::OfferAck => (Event::OfferAckTimeout, Code::OfferNotAnswered),
        TimerKind::StopConfirm => {
            if waits_for_silent_robot(tx, &task_id, &timer.attempt, board)
                || winds_down(tx, &task_id, &timer.attempt, board)
            {
                arm(tx, TimerKind::StopConfirm, &timer.attempt, limits::STOP_CONFIRM.as_ms());
                return;
            }
            (Event::StopConfirmTimeout, Code::StopNotConfirmed)
        }
        TimerKind::Uncertain => (Event::UncertainTimeout, Code::UncertainTooLong),
        TimerKind::StartToClose => (Event::StartToClose, Code::StartToClose),
        TimerKind::ScheduleToStart => (Event::ScheduleToStart, Code::ScheduleToStart),
        TimerKind::RetryDue => (Event::RetryDue, Code::WaitingInQueue),
    };
    disarm(tx, timer.kind, &timer.attempt);
    if current {
        let why = Reason::from(code);
        happen(tx, &task_id, News::of(event, Some(&why)));
    }
}

/// An offer nobody took, to a robot that is not heard: its authority to begin is over and its memory will tell, so no person is asked
/// before UNCERTAIN has lasted too long.
fn waits_for_silent_robot(tx: &Tx, task_id: &TaskId, attempt: &AttemptId, board: &Board) -> bool {
    let Some(a) = tx.view.attempt(attempt) else { return false };
    let requeue = tx.view.task(task_id).is_some_and(|t| t.then == Some(Then::Requeue));
    requeue && a.accepted.is_none() && super::heard::presence(board, &a.robot_id, &tx.now) != Presence::Online
}

/// A heard robot that was asked to hand its attempt back at a step boundary may take as long as its attempt may last: it ends that itself.
fn winds_down(tx: &Tx, task_id: &TaskId, attempt: &AttemptId, board: &Board) -> bool {
    let suspending = tx.view.task(task_id).is_some_and(|t| t.then == Some(Then::Suspended));
    let Some(a) = tx.view.attempt(attempt).filter(|a| suspending && a.uncertain.is_none()) else { return false };
    super::heard::presence(board, &a.robot_id, &tx.now) == Presence::Online
}

/// The deadline of a task passed.
pub fn deadline(tx: &mut Tx, task_id: &TaskId) {
    let why: Reason = Code::DeadlinePassed.into();
    happen(tx, task_id, News::of(Event::Deadline, Some(&why)));
}

/// Tasks that wait get their schedule_to_start once; a suspended one queues again.
pub fn arm_waiting(tx: &mut Tx, task_id: &TaskId) {
    let Some(task) = tx.view.task(task_id).cloned() else { return };
    let Some(intake) = tx.view.intake(task_id) else { return };
    let waiting = AttemptId { subject: Subject::Task(task_id.clone()), epoch: 0 };
    let spent = tx.now.utc.ms_since(task.queued_since);
    let after_ms = intake.spec.schedule_to_start_ms.saturating_sub(spent);
    arm(tx, TimerKind::ScheduleToStart, &waiting, after_ms);
}
