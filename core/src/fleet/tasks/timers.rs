//! Fires deadlines in serving time, and the deadlines of tasks in UTC.
//!
//! Invariant: nothing fires in the first 10 s of serving, so that robots say hello first; a timeout stops a robot and
//! never frees it.

use super::errand_reports;
use super::transitions::{News, apply_event, arm, disarm};
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::{Timer, TimerKind};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{AttemptId, Subject, TaskId};
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::task::{AfterStopping, Event, Phase};
use crate::time::Now;

/// Timers that are due, and tasks whose deadline passed.
pub fn due(view: &FleetProjection, now: &Now) -> (Vec<Timer>, Vec<TaskId>) {
    if now.link.since(view.started.link) < limits::TIMER_GRACE {
        return (Vec::new(), Vec::new());
    }
    let served = view.serving(now);
    let fired = |t: &Timer| {
        let clock = if t.kind.is_site() { served.site_ms } else { served.link_ms };
        t.fires_at_service_ms.is_some_and(|at| at <= clock)
    };
    let timers = view.timers.values().map(|t| &t.row).filter(|t| fired(t)).cloned().collect();
    let passed = view.deadlines.iter().take_while(|(at, _)| *at <= now.utc).map(|(_, task_id)| task_id);
    (timers, passed.filter(|task_id| is_late(view, task_id, now)).cloned().collect())
}

/// Whether the deadline of a task has passed and has not had its effect. In NEEDS_OPERATOR a person decides.
pub(in crate::fleet) fn is_late(view: &FleetProjection, task_id: &TaskId, now: &Now) -> bool {
    let Some((task, intake)) = view.task(task_id).zip(view.intake(task_id)) else { return false };
    let ends = task.phase.is_terminal() || matches!(task.then, Some(AfterStopping::Expired | AfterStopping::Canceled));
    let passed = task.deadline(intake).is_some_and(|deadline| deadline <= now.utc);
    passed && !ends && task.phase != Phase::NeedsOperator
}

/// Fires one timer.
pub fn fire(tx: &mut Tx, timer: &Timer, board: &Board) {
    let Some(task_id) = timer.attempt.subject.task_id().cloned() else {
        errand_reports::fire_timer(tx, timer);
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
        apply_event(tx, &task_id, News::from_event(event, Some(&why)));
    }
}

/// An offer nobody took, to a robot that is not heard: its authority to begin is over and its memory will tell, so no person is asked
/// before UNCERTAIN has lasted too long.
fn waits_for_silent_robot(tx: &Tx, task_id: &TaskId, attempt: &AttemptId, board: &Board) -> bool {
    let Some(a) = tx.view.attempt(attempt) else { return false };
    let requeue = tx.view.task(task_id).is_some_and(|t| t.then == Some(AfterStopping::Requeue));
    requeue && a.accepted.is_none() && liveness::presence(board, &a.robot_id, &tx.now) != Presence::Online
}

/// A heard robot that was asked to hand its attempt back at a step boundary may take as long as its attempt may last: it ends that itself.
fn winds_down(tx: &Tx, task_id: &TaskId, attempt: &AttemptId, board: &Board) -> bool {
    let suspending = tx.view.task(task_id).is_some_and(|t| t.then == Some(AfterStopping::Suspended));
    let Some(a) = tx.view.attempt(attempt).filter(|a| suspending && a.uncertain.is_none()) else { return false };
    liveness::presence(board, &a.robot_id, &tx.now) == Presence::Online
}

/// The deadline of a task passed.
pub fn deadline(tx: &mut Tx, task_id: &TaskId) {
    let why: Reason = Code::DeadlinePassed.into();
    apply_event(tx, task_id, News::from_event(Event::Deadline, Some(&why)));
}

/// The schedule_to_start of a task counts while it is ready, from when it began to wait, and stands still while it is not.
pub(in crate::fleet) fn count_readiness(tx: &mut Tx, task_id: &TaskId) {
    let Some(task) = tx.view.task(task_id).filter(|task| task.phase == Phase::Queued) else { return };
    let Some(limit_ms) = tx.view.intake(task_id).and_then(|i| i.spec.schedule_to_start_ms) else { return };
    let since = task.ready_since.map_or(tx.now.utc, |since| since.max(task.queued_since));
    let waiting = AttemptId { subject: Subject::Task(task_id.clone()), epoch: 0 };
    let known = tx.view.timers.get(Timer::id_of(TimerKind::ScheduleToStart, &waiting).as_str()).map(|t| t.row.clone());
    let served = tx.view.serving(&tx.now).site_ms;
    let is_ready = tx.view.queue.rank(task_id).is_some();
    match (is_ready, known) {
        (true, None) => {
            let spent = tx.now.ms_since(since);
            arm(tx, TimerKind::ScheduleToStart, &waiting, limit_ms.saturating_sub(spent));
        }
        (true, Some(mut timer)) if timer.fires_at_service_ms.is_none() => {
            timer.fires_at_service_ms = Some(served + timer.remaining_ms);
            tx.put_row(timer, "timer.changed");
        }
        (false, Some(mut timer)) => {
            let Some(at) = timer.fires_at_service_ms.take() else { return };
            timer.remaining_ms = at.saturating_sub(served);
            tx.put_row(timer, "timer.changed");
        }
        _ => {}
    }
}
