//! Moves errands by what their robots report: accepted, broken off, not heard, over.
//!
//! Invariant: an errand's end has no consequence but a free robot. Errands are given in `assignment::errands`.

use super::attempts;
use super::transitions::{disarm, end_attempt};
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::{Timer, TimerKind};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::limits;
use crate::reason::Reason;
use crate::robot::WorkState;
use crate::robot_events::AttemptReport;
use crate::task::state::{Errand, Uncertain};
use crate::task::{Attempt, AttemptPhase};

/// Counts errands that are on their way to a stop.
pub fn count_stopping(view: &FleetProjection) -> usize {
    view.attempts.values().filter(|a| a.row.errand.is_some() && a.row.phase == AttemptPhase::Stopping).count()
}

/// Applies the robot's report of its errand.
pub fn apply_report(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport) {
    if tx.view.held_by(robot_id) != Some(&report.attempt) {
        return;
    }
    let Some(mut a) = tx.view.attempt(&report.attempt).cloned() else { return };
    attempts::note_step(&mut a, report.step_index);
    a.stats = report.stats;
    a.fault = report.fault.clone().or(a.fault);
    a.refusal = report.refusal.clone().or(a.refusal);
    if a.accepted.is_none() && report.state != WorkState::Refused {
        a.accepted = Some(tx.now.utc);
        disarm(tx, TimerKind::OfferAck, &a.attempt);
    }
    if a.uncertain.take().is_some() {
        disarm(tx, TimerKind::Uncertain, &a.attempt);
    }
    let live = match report.state {
        WorkState::Accepted => AttemptPhase::Accepted,
        WorkState::Navigating => AttemptPhase::Navigating,
        WorkState::Executing => AttemptPhase::Executing,
        WorkState::Paused | WorkState::Stopping | WorkState::StepUnknown | WorkState::Unknown(_) => {
            AttemptPhase::Paused
        }
        // Refused after it was accepted: the robot has lost its memory of it.
        WorkState::Refused if a.accepted.is_some() => AttemptPhase::Aborted,
        WorkState::Refused => AttemptPhase::Refused,
        WorkState::Succeeded => AttemptPhase::Succeeded,
        WorkState::Failed => AttemptPhase::Failed,
        WorkState::Aborted if a.phase == AttemptPhase::Stopping && is_docked(&a) => AttemptPhase::Docked,
        WorkState::Aborted | WorkState::Suspended => AttemptPhase::Aborted,
    };
    if live.is_terminal() {
        // One that is over as soon as it is given would be given without end.
        let is_brief = tx.now.ms_since(a.offered) < limits::ERRAND_PAUSE.as_ms();
        if (live != AttemptPhase::Succeeded || is_brief) && a.phase != AttemptPhase::Stopping {
            let until = tx.now.link + limits::ERRAND_PAUSE;
            tx.view.unwilling.insert(robot_id.clone(), until);
        }
        a.phase = live;
        end_attempt(tx, &mut a);
    } else if a.phase.transitions().contains(&live) {
        a.phase = live;
    }
    tx.put_row(a, "errand.changed");
}

/// The robot has come to the charger that it was sent to.
pub(in crate::fleet) fn is_docked(a: &Attempt) -> bool {
    a.errand == Some(Errand::Charge) && a.step_index >= attempts::AT_GOAL
}

/// Asks the robot to break its errand off.
pub fn stop_errand(tx: &mut Tx, robot_id: &RobotId) {
    let Some(mut a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned() else { return };
    if a.errand.is_none() || a.phase.is_terminal() || a.phase == AttemptPhase::Stopping {
        return;
    }
    a.phase = AttemptPhase::Stopping;
    disarm(tx, TimerKind::OfferAck, &a.attempt);
    tx.put_row(a, "errand.stopping");
}

/// Handles a timer of an errand: an unanswered offer is taken back; everything else waits for the robot's report.
pub fn fire_timer(tx: &mut Tx, timer: &Timer) {
    disarm(tx, timer.kind, &timer.attempt);
    if timer.kind == TimerKind::OfferAck
        && let Some(robot_id) = tx.view.attempt(&timer.attempt).map(|a| a.robot_id.clone())
    {
        stop_errand(tx, &robot_id);
    }
}

/// Marks the errand of a robot as uncertain, that was not heard for longer than its authority or is in manual mode.
pub fn mark_uncertain(tx: &mut Tx, robot_id: &RobotId, cause: Reason) {
    let Some(mut a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned() else { return };
    a.uncertain = Some(Uncertain { since: tx.now.utc, cause });
    tx.put_row(a, "errand.uncertain");
}

/// Notes that a robot is heard again and still lists its errand.
pub fn note_heard(tx: &mut Tx, robot_id: &RobotId) {
    let Some(mut a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned() else { return };
    a.uncertain = None;
    if a.accepted.is_none() {
        a.accepted = Some(tx.now.utc);
        a.phase = AttemptPhase::Accepted;
        disarm(tx, TimerKind::OfferAck, &a.attempt);
    }
    tx.put_row(a, "errand.seen");
}
