//! Compares what each heartbeat says with what the rows say, and repairs the difference both ways.
//!
//! Invariant: repair never overtakes events. A difference counts only if the robot has applied the newest desired work and every
//! EVENT and CRITICAL number it had produced has been consumed. The end of a lease frees authority, never a load or a place.

use super::Tx;
use super::heard::{is_fresh, is_settled, lease_stands, presence};
use super::tasks::{News, happen};
use super::view::View;
use super::{Board, Tally, errands, inbox, places, tasks};
use crate::ids::{RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::robot::{HardwareStop, Mode, Presence};
use crate::task::{Attempt, AttemptPhase, Event, Phase};
use crate::time::Now;
use crate::work::{AttemptReport, Live, PlaceNews, WorkState};

/// Counts the time in which the robot is heard.
fn attached(view: &mut View, robot_id: &RobotId, board: &Board, now: &Now) {
    let heard = presence(board, robot_id, now) == Presence::Online;
    let time = view.attached.entry(robot_id.clone()).or_insert(super::view::Attached { ms: 0, until: now.site });
    if heard {
        time.ms += now.site.since(time.until).as_ms();
    }
    time.until = now.site;
}

/// Whether there is something to compare: a newer heartbeat, one that could not count yet, or none for too long.
pub fn is_due(view: &View, robot_id: &RobotId, board: &Board, now: &Now) -> bool {
    let online = presence(board, robot_id, now) == Presence::Online;
    let newest = board.get(robot_id).map(|l| (l.report.session_epoch, l.report.hb));
    !online || newest.is_none() || view.compared.get(robot_id) != newest.as_ref()
}

/// Repairs one robot.
pub fn robot(tx: &mut Tx, robot_id: &RobotId, board: &Board, tally: &mut Tally) {
    let now = tx.now;
    attached(tx.view, robot_id, board, &now);
    tasks::count_hours(tx, robot_id);
    if !lease_stands(tx.view, board, robot_id, &tx.now) {
        lease_over(tx, robot_id, tally);
        return;
    }
    let Some(live) = board.get(robot_id).cloned() else { return };
    stalled(tx, robot_id, &live);
    if !is_settled(tx.view, &live) || !is_fresh(tx.view, &live) {
        tally.pending += 1;
        return;
    }
    tx.view.compared.insert(robot_id.clone(), (live.report.session_epoch, live.report.hb));
    inbox::hardware_stop(tx, robot_id, live.report.hardware_stop);
    places::repair(tx, robot_id, &live);
    attempt(tx, robot_id, &live, tally);
    recharge(tx, robot_id, &live);
    forget_reported(tx, robot_id, &live);
}

/// Whether the task may wait for another robot from its next step boundary on: it runs, lets others go first, and is not opened.
pub fn may_suspend(view: &View, task_id: &TaskId, live: &Live) -> bool {
    let Some(task) = view.task(task_id).filter(|t| t.phase == Phase::Running && t.opened.is_none()) else {
        return false;
    };
    let opened = task.attempt_id().and_then(|id| view.attempt(&id)).is_none_or(|a| a.opened);
    let preemptible = view.intake(task_id).is_some_and(|i| i.spec.preemptible);
    !opened && preemptible && live.report.load.is_none()
}

/// A robot at work must charge: a preemptible task that it has not opened waits, at a step boundary.
fn recharge(tx: &mut Tx, robot_id: &RobotId, live: &Live) {
    let Some(task_id) = tx.view.held_by(robot_id).and_then(|id| id.subject.task_id()).cloned() else { return };
    let vitals = &live.report.vitals;
    if !may_suspend(tx.view, &task_id, live) || tx.view.site.chargers().next().is_none() {
        return;
    }
    let Some(here) = super::way::find(tx.view, vitals.waypoint.as_ref()) else { return };
    let least = tx.view.policy(&tx.view.site.area_of(here).area_id).charge_mandatory_permille;
    if vitals.battery_permille < least {
        let why = Reason::from(Code::BatterySuspend)
            .with("robot_id", robot_id)
            .with("battery_permille", vitals.battery_permille)
            .with("mandatory_permille", least);
        happen(tx, &task_id, News::of(Event::Suspend, Some(&why)));
    }
}

fn lease_over(tx: &mut Tx, robot_id: &RobotId, tally: &mut Tally) {
    if tx.view.bugs.timeout_frees_place() {
        for id in super::tasks::places_of(tx, robot_id) {
            let holder = tx.view.places.get(&id).and_then(|p| p.row.holder(robot_id).cloned());
            if let (Some(holder), Ok(place_id)) = (holder, crate::ids::PlaceId::parse(&id)) {
                inbox::place(tx, robot_id, &place_id, holder.grant_id, PlaceNews::Left);
            }
        }
    }
    let Some(id) = tx.view.held_by(robot_id).cloned() else { return };
    let Some(a) = tx.view.attempt(&id) else { return };
    if a.uncertain.is_some() || a.phase.is_terminal() {
        return;
    }
    if tx.view.bugs.silence_frees_task() {
        let stats = a.stats;
        let gone = AttemptReport {
            attempt: id,
            state: WorkState::Aborted,
            step_index: a.step_index,
            opened: a.opened,
            refusal: None,
            fault: None,
            stats,
        };
        return inbox::attempt(tx, robot_id, &gone, tally);
    }
    let why = Reason::from(Code::LeaseOver).with("robot_id", robot_id);
    match id.subject.task_id() {
        Some(task_id) => {
            happen(tx, task_id, News::of(Event::LeaseOver, Some(&why)));
        }
        None => errands::lease_over(tx, robot_id, why),
    }
}

/// The attempt that holds the robot, against what the robot lists.
fn attempt(tx: &mut Tx, robot_id: &RobotId, live: &Live, tally: &mut Tally) {
    let Some(id) = tx.view.held_by(robot_id).cloned() else { return };
    let Some(a) = tx.view.attempt(&id).cloned() else { return };
    let listed = live.report.attempts.iter().find(|r| r.attempt == id);
    let report = |state| AttemptReport {
        attempt: id.clone(),
        state,
        step_index: listed.map_or(a.step_index, |l| l.step_index),
        opened: a.opened || listed.is_some_and(|l| l.opened),
        refusal: None,
        fault: None,
        stats: a.stats,
    };
    match listed {
        None => {
            tally.repaired += 1;
            inbox::attempt(tx, robot_id, &report(WorkState::Aborted), tally);
        }
        Some(l) if l.state.is_over() && l.state != WorkState::Failed => {
            tally.repaired += 1;
            inbox::attempt(tx, robot_id, &report(l.state), tally);
        }
        Some(l) if l.state == WorkState::StepUnknown => {
            let Some(task_id) = id.subject.task_id() else { return };
            tally.repaired += 1;
            let report = report(l.state);
            happen(tx, task_id, News { event: Event::StepUnknown, why: None, report: Some(&report) });
        }
        Some(l) if needs_sight(&a, live) => {
            let Some(task_id) = id.subject.task_id() else { return errands::seen(tx, robot_id) };
            tally.repaired += 1;
            let report = report(l.state);
            happen(tx, task_id, News { event: Event::SeenRunning, why: None, report: Some(&report) });
        }
        Some(_) => {}
    }
}

/// A robot in automatic mode lists an attempt that the record has as unanswered or UNCERTAIN.
fn needs_sight(a: &Attempt, live: &Live) -> bool {
    live.report.mode == Mode::Automatic && (a.uncertain.is_some() || a.phase == AttemptPhase::Offered)
}

/// Attempts that are over for both may leave the robot's list.
fn forget_reported(tx: &mut Tx, robot_id: &RobotId, live: &Live) {
    let over = live.report.attempts.iter().filter(|r| r.state.is_over() || r.state == WorkState::StepUnknown);
    let closed = tx.view.desired_work.get(robot_id.as_str()).map(|d| d.row.closed.clone()).unwrap_or_default();
    let holder = tx.view.held_by(robot_id);
    if over.into_iter().any(|r| holder != Some(&r.attempt) && !closed.contains(&r.attempt)) {
        tx.view.dirty.insert(robot_id.clone());
    }
}

fn stalled(tx: &mut Tx, robot_id: &RobotId, live: &Live) {
    let Some(task_id) = tx.view.held_by(robot_id).and_then(|a| a.subject.task_id().cloned()) else { return };
    let Some(task) = tx.view.task(&task_id) else { return };
    let Some(intake) = tx.view.intake(&task_id) else { return };
    let uncertain = tx.view.held_by(robot_id).and_then(|a| tx.view.attempt(a)).is_some_and(|a| a.uncertain.is_some());
    let accepted = tx.view.held_by(robot_id).and_then(|a| tx.view.attempt(a)).and_then(|a| a.accepted);
    let young = accepted.is_none_or(|at| tx.now.utc.ms_since(at) <= intake.spec.stall_ms);
    let excused = places::waits(tx.view, robot_id)
        || live.report.mode != Mode::Automatic
        || live.report.hardware_stop != HardwareStop::None
        || task.phase != Phase::Running
        || uncertain;
    let stall_ms = intake.spec.stall_ms;
    if excused {
        tx.view.excused.insert(robot_id.clone(), tx.now.site);
        return;
    }
    let excused_at = tx.view.excused.get(robot_id).copied().unwrap_or_default();
    let quiet = tx.now.site.since(live.progress_at.max(tx.view.started.site).max(excused_at)).as_ms();
    if quiet > stall_ms && !young {
        let why = Reason::from(Code::Stalled).with("quiet_ms", quiet);
        happen(tx, &task_id, News::of(Event::Stall, Some(&why)));
    }
}
