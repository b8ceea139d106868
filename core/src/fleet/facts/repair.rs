//! Compares what each heartbeat says with what the rows say, and repairs the difference both ways.
//!
//! Invariant: repair never overtakes events. A difference counts only if the robot has applied the newest desired work and every
//! EVENT and CRITICAL number it had produced has been consumed. The end of a lease frees authority, never a load or a place.

use super::{disbelief, holds, inbox, maps, unanswered_offers};
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::decision::report::Tally;
use crate::fleet::projection::liveness::{Board, is_fresh, is_settled, lease_stands, presence};
use crate::fleet::projection::memory::AttachedTime;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::claims::{PLACES, differences, excess, implausible};
use crate::fleet::tasks::transitions::{self, News, apply_event, may_suspend};
use crate::fleet::tasks::{arrivals, errand_reports, load, plausible};
use crate::fleet::traffic::{route_requests, routing};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId};
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::robot::WorkState;
use crate::robot::{HardwareStop, Mode};
use crate::robot_events::{AttemptReport, PlaceNews};
use crate::task::{Attempt, AttemptPhase, Event, Phase};
use crate::time::Now;
use std::collections::{BTreeSet, btree_map};
use std::iter::Peekable;

/// Counts the time in which a robot is heard.
fn count_attached_time(view: &mut FleetProjection, robot_id: &RobotId, board: &Board, now: &Now) {
    let heard = presence(board, robot_id, now) == Presence::Online;
    let fresh = AttachedTime { ms: 0, until: now.site, is_heard: heard };
    let time = view.attached.entry(robot_id.clone()).or_insert(fresh);
    time.is_heard = heard;
    if heard {
        time.ms += now.site.since(time.until).as_ms();
    }
    time.until = now.site;
}

/// Robots of which there is something to compare: a newer heartbeat, one that could not count yet, or none for too long.
pub(in crate::fleet) fn find_due(view: &FleetProjection, board: &Board, now: &Now) -> BTreeSet<RobotId> {
    // Nearly always the same robots, and all by id: one walk instead of two searches for each.
    let (mut live, mut compared) = (board.iter().peekable(), view.compared.iter().peekable());
    let known = view.authority.values().map(|authority| &authority.row.robot_id);
    let is_due = |robot_id: &&RobotId| {
        let (live, compared) = (seek(&mut live, robot_id), seek(&mut compared, robot_id));
        let newest = live.map(|live| (live.report.session_epoch, live.report.hb));
        let is_online = Presence::since(live.map(|live| live.processed_at), now.link) == Presence::Online;
        !is_online || newest.is_none() || compared != newest.as_ref()
    };
    known.filter(is_due).cloned().collect()
}

/// The row of a robot, which comes after those that were asked for before.
fn seek<'a, V>(rows: &mut Peekable<btree_map::Iter<'a, RobotId, V>>, robot_id: &RobotId) -> Option<&'a V> {
    while rows.next_if(|(id, _)| *id < robot_id).is_some() {}
    rows.next_if(|(id, _)| *id == robot_id).map(|(_, row)| row)
}

/// Repairs one robot, in items that each stay below their limits however long the robot's lists are.
pub fn repair_robot(view: &mut FleetProjection, now: Now, robot_id: &RobotId, board: &Board, plan: &mut Plan) {
    count_attached_time(view, robot_id, board, &now);
    let mut tally = plan.report.tally;
    plan.decide(view, now, "fleet", |tx| {
        transitions::count_hours(tx, robot_id);
        if !lease_stands(tx.view, board, robot_id, &now) {
            return end_lease(tx, robot_id, &mut tally);
        }
        if let Some(live) = board.get(robot_id) {
            load::end_word(tx, live);
            if let Some(load) = load::carried(tx.view, live) {
                inbox::note_load(tx, robot_id, load);
            }
            detect_stall(tx, robot_id, live);
        }
    });
    if let Some(live) = board.get(robot_id).filter(|_| lease_stands(view, board, robot_id, &now)) {
        compare_heartbeat(view, now, live, &mut tally, plan);
    }
    plan.report.tally = tally;
}

/// Compares the rows with a heartbeat, if its differences count.
fn compare_heartbeat(view: &mut FleetProjection, now: Now, live: &NewestHeartbeat, tally: &mut Tally, plan: &mut Plan) {
    if !is_settled(view, live) || !is_fresh(view, live) {
        tally.pending += 1;
        return;
    }
    let robot_id = &live.robot_id;
    view.compared.insert(robot_id.clone(), (live.report.session_epoch, live.report.hb));
    let doubt = plausible::doubtful(view, live);
    let stop = live.report.hardware_stop;
    if doubt.is_none() || stop != HardwareStop::None {
        plan.decide(view, now, "fleet", |tx| holds::apply_hardware_stop(tx, robot_id, stop));
    }
    repair_places(view, now, live, doubt.is_none(), plan);
    if let Some((id, why)) = doubt {
        plan.decide(view, now, "fleet", |tx| disbelief::doubt(tx, robot_id, &id, &why));
        return;
    }
    plan.decide(view, now, "fleet", |tx| {
        arrivals::note_standing(tx, live);
        repair_attempt(tx, robot_id, live, tally);
        note_unknown_attempt(tx, robot_id, live);
        suspend_to_charge(tx, robot_id, live);
        forget_reported(tx, robot_id, live);
        maps::compare(tx, live);
    });
}

/// Suspends the task of a robot that must charge: a preemptible one that it has not opened, at a step boundary.
fn suspend_to_charge(tx: &mut Tx, robot_id: &RobotId, live: &NewestHeartbeat) {
    let Some(task_id) = tx.view.held_by(robot_id).and_then(|id| id.subject.task_id()).cloned() else { return };
    let vitals = &live.report.vitals;
    if !may_suspend(tx.view, &task_id, live) || tx.view.site.chargers().next().is_none() {
        return;
    }
    let Some(here) = routing::find(tx.view, vitals.waypoint.as_ref()) else { return };
    let least = tx.view.policy(&tx.view.site.area_of(here).area_id).charge_mandatory_permille;
    if vitals.battery_permille < least {
        let why = Reason::from(Code::BatterySuspend)
            .with("robot_id", robot_id)
            .with("battery_permille", vitals.battery_permille)
            .with("mandatory_permille", least);
        apply_event(tx, &task_id, News::from_event(Event::Suspend, Some(&why)));
    }
}

/// Ends the authority of a robot whose lease is over: its attempt becomes UNCERTAIN.
fn end_lease(tx: &mut Tx, robot_id: &RobotId, tally: &mut Tally) {
    if tx.view.bugs.timeout_frees_place() {
        for id in transitions::places_of(tx, robot_id) {
            let holder = tx.view.places.get(id.as_str()).and_then(|p| p.row.holder(robot_id).cloned());
            if let (Some(holder), Ok(place_id)) = (holder, crate::ids::PlaceId::parse(&id)) {
                inbox::apply_place_news(tx, robot_id, &place_id, holder.grant_id, PlaceNews::Left);
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
            opened: a.is_opened,
            refusal: None,
            fault: None,
            stats,
        };
        return inbox::apply_attempt_report(tx, robot_id, &gone, tally);
    }
    let why = Reason::from(Code::LeaseOver).with("robot_id", robot_id);
    match id.subject.task_id() {
        Some(task_id) => {
            apply_event(tx, task_id, News::from_event(Event::LeaseOver, Some(&why)));
        }
        None => errand_reports::mark_uncertain(tx, robot_id, why),
    }
}

/// Repairs the attempt that holds a robot from the attempts that the robot lists.
fn repair_attempt(tx: &mut Tx, robot_id: &RobotId, live: &NewestHeartbeat, tally: &mut Tally) {
    let Some(id) = tx.view.held_by(robot_id).cloned() else { return };
    let Some(a) = tx.view.attempt(&id).cloned() else { return };
    let listed = live.report.attempts.iter().find(|r| r.attempt == id);
    let report = |state| AttemptReport {
        attempt: id.clone(),
        state,
        step_index: listed.map_or(a.step_index, |l| l.step_index),
        opened: a.is_opened || listed.is_some_and(|l| l.opened),
        refusal: None,
        fault: a.fault.clone(),
        stats: a.stats,
    };
    let mut is_over = |tx: &mut Tx, report: &AttemptReport| {
        tally.repaired += 1;
        match arrivals::unseen(tx.view, &tx.now, robot_id, report) {
            Some(place_id) => disbelief::disbelieve(tx, robot_id, report, &place_id),
            None => inbox::apply_attempt_report(tx, robot_id, report, tally),
        }
    };
    match listed {
        None => {
            if is_unanswered(tx.view, &a, live) {
                unanswered_offers::note_missed_offer(tx, robot_id);
            }
            is_over(tx, &report(WorkState::Aborted));
        }
        Some(l) if l.state.is_over() => is_over(tx, &report(l.state)),
        Some(l) if l.state == WorkState::StepUnknown => {
            let Some(task_id) = id.subject.task_id() else { return };
            tally.repaired += 1;
            let report = report(l.state);
            apply_event(tx, task_id, News { event: Event::StepUnknown, why: None, report: Some(&report) });
        }
        Some(l) if needs_sight(&a, live) => {
            unanswered_offers::note_answer(tx, robot_id);
            let Some(task_id) = id.subject.task_id() else { return errand_reports::note_heard(tx, robot_id) };
            tally.repaired += 1;
            let report = report(l.state);
            apply_event(tx, task_id, News { event: Event::SeenRunning, why: None, report: Some(&report) });
        }
        // The event that told of it was lost for good: what a robot says only adds.
        Some(l) if l.step_index > a.step_index || (l.opened && !a.is_opened) => {
            let Some(task_id) = id.subject.task_id() else { return };
            tally.repaired += 1;
            let report = report(l.state);
            apply_event(tx, task_id, News { event: Event::Progress, why: None, report: Some(&report) });
        }
        Some(_) => {}
    }
}

/// The robot heard the offer and lists no answer: the offer stands, or was taken back only because nobody answered it.
fn is_unanswered(view: &FleetProjection, a: &Attempt, live: &NewestHeartbeat) -> bool {
    let task = a.attempt.subject.task_id().and_then(|id| view.task(id));
    let ran_out = task.and_then(|t| t.reason.as_ref()).is_some_and(|r| r.code == Code::OfferNotAnswered);
    let waits = a.phase == AttemptPhase::Offered || (a.phase == AttemptPhase::Stopping && ran_out);
    let desired = view.desired_work.get(live.robot_id.as_str()).and_then(|d| d.row.assignment.as_ref());
    let is_sent = desired.is_some_and(|given| given.attempt == a.attempt);
    is_sent && waits && a.accepted.is_none() && a.offer.session_epoch == live.report.session_epoch
}

/// Notes an attempt that a robot lists and no row knows. If the robot keeps it, an incident is opened.
fn note_unknown_attempt(tx: &mut Tx, robot_id: &RobotId, live: &NewestHeartbeat) {
    forget_disowned(tx, robot_id, live);
    let Some(attempt) = unknown_attempt(tx.view, live).cloned() else {
        tx.view.unknown.remove(robot_id);
        return;
    };
    let since = match tx.view.unknown.get(robot_id) {
        Some((known, since)) if *known == attempt => *since,
        _ => tx.now.link,
    };
    tx.view.unknown.insert(robot_id.clone(), (attempt.clone(), since));
    if tx.now.link.since(since) >= limits::ATTEMPT_UNKNOWN_AFTER {
        let reason = Reason::from(Code::AttemptUnknown).with("attempt", attempt);
        incidents::open_about(tx, reason, Some(robot_id), "attempt");
    }
}

/// The first attempt that a robot lists as its own and that does not hold it; what a person disowned does not count.
pub fn unknown_attempt<'l>(view: &FleetProjection, live: &'l NewestHeartbeat) -> Option<&'l AttemptId> {
    let holder = view.held_by(&live.robot_id);
    let disowned = view.control.get(live.robot_id.as_str()).map(|c| c.row.disowned.as_slice()).unwrap_or_default();
    let mine = live.report.attempts.iter().filter(|r| !r.state.is_over()).map(|r| &r.attempt);
    mine.into_iter().find(|id| holder != Some(*id) && !disowned.contains(id))
}

/// What the robot has let go is known to nobody any more.
fn forget_disowned(tx: &mut Tx, robot_id: &RobotId, live: &NewestHeartbeat) {
    let Some(control) = tx.view.control.get(robot_id.as_str()).map(|c| &c.row) else { return };
    let is_listed = |id: &AttemptId| live.report.attempts.iter().any(|r| r.attempt == *id);
    if control.disowned.iter().all(is_listed) {
        return;
    }
    let mut control = control.clone();
    control.disowned.retain(is_listed);
    tx.put_row(control, "robot.disowned");
}

/// A robot in automatic mode lists an attempt that the record has as unanswered or UNCERTAIN.
fn needs_sight(a: &Attempt, live: &NewestHeartbeat) -> bool {
    live.report.mode == Mode::Automatic && (a.uncertain.is_some() || a.phase == AttemptPhase::Offered)
}

/// Attempts that are over for both may leave the robot's list.
fn forget_reported(tx: &mut Tx, robot_id: &RobotId, live: &NewestHeartbeat) {
    let over = live.report.attempts.iter().filter(|r| r.state.is_over() || r.state == WorkState::StepUnknown);
    let closed = tx.view.desired_work.get(robot_id.as_str()).map(|d| d.row.closed.clone()).unwrap_or_default();
    let holder = tx.view.held_by(robot_id);
    if over.into_iter().any(|r| holder != Some(&r.attempt) && !closed.contains(&r.attempt)) {
        tx.view.dirty.insert(robot_id.clone());
    }
}

/// Fires the event of a stall if a robot at work has reported no progress for longer than its task allows.
fn detect_stall(tx: &mut Tx, robot_id: &RobotId, live: &NewestHeartbeat) {
    let Some(task_id) = tx.view.held_by(robot_id).and_then(|a| a.subject.task_id().cloned()) else { return };
    let Some(task) = tx.view.task(&task_id) else { return };
    let Some(intake) = tx.view.intake(&task_id) else { return };
    let uncertain = tx.view.held_by(robot_id).and_then(|a| tx.view.attempt(a)).is_some_and(|a| a.uncertain.is_some());
    let accepted = tx.view.held_by(robot_id).and_then(|a| tx.view.attempt(a)).and_then(|a| a.accepted);
    let young = accepted.is_none_or(|at| tx.now.ms_since(at) <= intake.spec.stall_ms);
    let excused = route_requests::waits(tx.view, robot_id)
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
        apply_event(tx, &task_id, News::from_event(Event::Stall, Some(&why)));
    }
}

/// Brings place rows to what a settled robot reports: entered, gone, or standing somewhere nobody knew of. What is not `sound` frees nothing.
fn repair_places(view: &mut FleetProjection, now: Now, live: &NewestHeartbeat, sound: bool, plan: &mut Plan) {
    let robot_id = &live.robot_id;
    let excess = excess(view, live);
    let mut changes = differences(view, live);
    changes.retain(|(_, _, news)| (sound && excess.is_none()) || *news == PlaceNews::Entered);
    for some in changes.chunks(limits::PLACES_PER_ITEM) {
        plan.decide(view, now, "fleet", |tx| {
            for (place_id, grant_id, news) in some {
                inbox::apply_place_news(tx, robot_id, place_id, *grant_id, *news);
            }
        });
    }
    if let Some(claims) = excess {
        let why = implausible().with(PLACES, Vec::from_iter(claims).join(" "));
        plan.decide(view, now, "fleet", |tx| {
            incidents::open_about(tx, why, Some(robot_id), "");
        });
    }
}
