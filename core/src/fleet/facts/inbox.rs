//! Takes what robots said, in commit order: news of attempts and places, modes, stops.
//!
//! Invariant: a report counts only for the newest epoch of its task; older ones are fenced and counted, never obeyed.

use super::holds::apply_hardware_stop;
use super::{disbelief, unanswered_offers};
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::decision::report::Tally;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::HolderState;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::{News, apply_event, event_of, release};
use crate::fleet::tasks::{arrivals, breaker, claims, errand_reports, plausible};
use crate::ids::{PlaceId, RobotId};
use crate::reason::{Code, Reason};
use crate::robot::WorkState;
use crate::robot::{Lane, Load, Mode};
use crate::robot_events::{AttemptReport, InboxEntry, InboxItem, PlaceNews, RobotEvent, SampleBody, UNREADABLE_WORK};
use crate::task::{AttemptPhase, Event};

/// Obeys one entry of the robot inbox.
pub fn obey_entry(tx: &mut Tx, entry: &InboxEntry, board: &Board, tally: &mut Tally) {
    let robot_id = &entry.robot_id;
    let InboxItem::Sample(sample) = &entry.what else {
        if entry.lane == Lane::Event {
            arrivals::lost(tx, robot_id);
        }
        return;
    };
    let SampleBody::Event(event) = &sample.body else { return };
    match event {
        RobotEvent::Attempt(report) if arrivals::unseen(tx.view, &tx.now, robot_id, report).is_some() => {
            arrivals::wait(tx, report);
        }
        RobotEvent::Attempt(report) => {
            breaker::count_let_go(tx, robot_id, report);
            if calls_offer_over(tx.view, robot_id, report) {
                unanswered_offers::note_refused_offer(tx, robot_id, report);
            }
            apply_attempt_report(tx, robot_id, report, tally);
        }
        RobotEvent::Place { place_id, grant_id, news: PlaceNews::Entered }
            if claims::waits_for_heartbeat(tx.view, board, robot_id, place_id) =>
        {
            arrivals::note(tx, robot_id, place_id);
            claims::check_grant(tx, robot_id, place_id, *grant_id);
        }
        RobotEvent::Place { place_id, grant_id, news } => apply_place_news(tx, robot_id, place_id, *grant_id, *news),
        RobotEvent::Mode(mode) => apply_mode(tx, robot_id, *mode),
        RobotEvent::HardwareStop(stop) => apply_hardware_stop(tx, robot_id, *stop),
        RobotEvent::StaleAuthority { what, .. } if what == UNREADABLE_WORK => {
            incidents::open_about(tx, Code::WorkUnreadable.into(), Some(robot_id), "");
        }
        RobotEvent::StaleAuthority { .. } => tally.stale_authority += 1,
        RobotEvent::Load(Some(load)) => note_load(tx, robot_id, load),
        // The rollout service reads these itself.
        RobotEvent::Update(_) => {}
        // Its heartbeat says the same, and holds come of that.
        RobotEvent::FleetStop { .. } => {}
        RobotEvent::Fault { .. } | RobotEvent::Load(None) | RobotEvent::BatteryCritical { .. } => {}
    }
}

/// An offer stands, and its robot says that it is over without having taken or refused it.
fn calls_offer_over(view: &FleetProjection, robot_id: &RobotId, report: &AttemptReport) -> bool {
    let attempt = view.attempt(&report.attempt).filter(|a| a.robot_id == *robot_id);
    let stands = attempt.is_some_and(|a| a.phase == AttemptPhase::Offered && a.uncertain.is_none());
    stands && matches!(report.state, WorkState::Aborted | WorkState::Suspended)
}

/// Applies a report of an attempt, from the inbox or from an inventory.
pub fn apply_attempt_report(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport, tally: &mut Tally) {
    let id = &report.attempt;
    let is_offer = tx.view.attempt(id).is_some_and(|a| a.accepted.is_none() && a.robot_id == *robot_id);
    if is_offer && report.state == WorkState::Refused {
        unanswered_offers::note_refused_offer(tx, robot_id, report);
    } else if is_offer && !matches!(report.state, WorkState::Aborted | WorkState::Suspended) {
        unanswered_offers::note_answer(tx, robot_id);
    }
    if let Some(why) = plausible::judge(tx.view, id, robot_id, report.state, report.step_index) {
        return disbelief::doubt(tx, robot_id, id, &why);
    }
    let Some(task_id) = id.subject.task_id() else {
        errand_reports::apply_report(tx, robot_id, report);
        return;
    };
    let newest = tx.view.task(task_id).and_then(|t| t.attempt_id());
    let ours = (newest.as_ref() == Some(id)
        && tx.view.task(task_id).is_some_and(|t| t.robot_id.as_ref() == Some(robot_id)))
        || tx.view.bugs.late_reports_count();
    let is_taken = tx.view.attempt(id).is_some_and(|a| a.accepted.is_some());
    let (event, why) = match event_of(report) {
        // What it took before it cannot refuse any more: it says that it does not have it.
        Event::Refused if is_taken => (Event::StopConfirmed, None),
        event => (event, report.refusal.as_ref()),
    };
    let moved = ours && apply_event(tx, task_id, News { event, why, report: Some(report) });
    if !moved {
        tally.fenced += 1;
    }
    if report.state.is_over() {
        release(tx, robot_id, report);
    }
}

/// Notes the load that a robot says it carries: an item of the task it works on opens that task, whatever else it says.
pub fn note_load(tx: &mut Tx, robot_id: &RobotId, load: &Load) {
    let task = load.task_id.as_ref().and_then(|id| tx.view.task(id)).filter(|t| t.opened_robot_id.is_none());
    let attempt = task.and_then(|t| t.attempt_id()).filter(|id| tx.view.held_by(robot_id) == Some(id));
    let Some((mut task, id)) = task.cloned().zip(attempt) else { return };
    task.opened_robot_id = Some(robot_id.clone());
    tx.put_row(task, "task.opened");
    if let Some(mut a) = tx.view.attempt(&id).cloned() {
        a.is_opened = true;
        tx.put_row(a, "attempt.changed");
    }
}

/// Applies news of a place.
pub fn apply_place_news(tx: &mut Tx, robot_id: &RobotId, place_id: &PlaceId, grant_id: u64, news: PlaceNews) {
    let known = tx.view.places.get(place_id.as_str()).map(|p| p.row.clone());
    let holder = known.as_ref().map(|place| place.holder(robot_id));
    // Of a place whose row cannot be read nobody knows whether it stood there.
    let was_inside = holder.is_none_or(|holder| holder.is_some_and(|holder| holder.state == HolderState::Inside));
    if news == PlaceNews::Entered {
        arrivals::note(tx, robot_id, place_id);
    } else if was_inside {
        arrivals::note_left(tx, robot_id, place_id);
    }
    let Some(mut place) = known else { return };
    let Some(at) = place.holders.iter().position(|h| h.robot_id == *robot_id && h.grant_id == grant_id) else {
        if news == PlaceNews::Entered {
            claims::take_over(tx, robot_id, place_id, grant_id);
            claims::entered(tx, robot_id, place_id);
        }
        return;
    };
    let kind = match news {
        PlaceNews::Entered => {
            place.holders[at].state = HolderState::Inside;
            "place.entered"
        }
        PlaceNews::Left | PlaceNews::NotEntered => {
            place.holders.remove(at);
            let ours = place
                .quarantine
                .as_ref()
                .is_some_and(|q| q.metadata.get("robot_id").is_some_and(|r| r == robot_id.as_str()));
            if ours {
                place.quarantine = None;
            }
            if news == PlaceNews::Left { "place.left" } else { "place.not_entered" }
        }
    };
    tx.put_row(place, kind);
    if news == PlaceNews::Entered {
        claims::entered(tx, robot_id, place_id);
    }
}

/// A person took the robot over: what it has becomes UNCERTAIN. Back in automatic mode, its heartbeat says what it still has.
fn apply_mode(tx: &mut Tx, robot_id: &RobotId, mode: Mode) {
    tx.view.dirty.insert(robot_id.clone());
    if mode == Mode::Automatic {
        return;
    }
    let why = Reason::new(Code::RobotManual, "A person took the robot over.").with("robot_id", robot_id);
    match tx.view.held_by(robot_id).map(|a| a.subject.task_id().cloned()) {
        Some(Some(task_id)) => {
            apply_event(tx, &task_id, News::from_event(Event::LeaseOver, Some(&why)));
        }
        Some(None) => errand_reports::mark_uncertain(tx, robot_id, why),
        None => {}
    }
}
