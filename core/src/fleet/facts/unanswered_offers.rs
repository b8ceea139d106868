//! Robots that hear offers and take none: passed over for a while, then out of dispatch until they take a probe.
//!
//! 1. An offer is missed only if a later heartbeat of its session has applied it and lists no answer: the robot heard it.
//! 2. Each offer that is missed or refused doubles the time in which the robot gets no other; one that it takes ends that. A refusal for what
//!    the task asks for is an answer.
//! 3. Three that were missed within ten minutes, or five that were refused in a row, open a breaker. After ten minutes the robot gets one
//!    offer; if it takes that, the breaker closes, else it opens anew.
//! 4. When many robots miss an offer at once, none is to blame: one incident names the server and its network.
//!
//! Called by `repair` and `inbox` for what robots say, and by the filters. Robots that are not heard are no matter of this room.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::RobotControl;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::limits;
use crate::reason::{Code, Reason};
use crate::robot_events::AttemptReport;
use crate::time::{LinkDuration, Now};

/// Notes that a robot heard an offer and did not answer it.
pub fn note_missed_offer(tx: &mut Tx, robot_id: &RobotId) {
    let now = tx.now;
    let unanswered = &mut tx.view.unanswered_offers;
    unanswered.missed.insert(robot_id.clone(), now.link);
    unanswered.missed.retain(|_, at| now.link.since(*at) <= limits::UNANSWERED_AT_ONCE);
    let at_once: Vec<RobotId> = unanswered.missed.keys().cloned().collect();
    let in_row = unanswered.backed_off.get(robot_id).map_or(1, |(n, _)| n.saturating_add(1));
    if are_many(at_once.len(), tx.view.sessions.len()) {
        at_once.iter().for_each(|robot_id| excuse_missed_offer(tx, robot_id));
        let reason = Reason::from(Code::OffersNotAnswered).with("robots", at_once.len());
        incidents::open_about(tx, reason, None, "");
        return back_off(tx, robot_id, 1);
    }
    back_off(tx, robot_id, in_row);
    count_missed_offer(tx, robot_id);
}

/// Notes that a robot refused an offer: for what the task asks for, which is the task's matter, or for its own sake: then it is passed over, so that it
/// uses up no patience of tasks that others could take.
pub fn note_refused_offer(tx: &mut Tx, robot_id: &RobotId, report: &AttemptReport) {
    let code = report.refusal.as_ref().map(|why| why.code);
    if code == Some(Code::UnsupportedAction) {
        return note_answer(tx, robot_id);
    }
    let in_row = tx.view.unanswered_offers.backed_off.get(robot_id).map_or(1, |(n, _)| n.saturating_add(1));
    back_off(tx, robot_id, in_row);
    if in_row >= limits::REFUSALS_IN_ROW {
        let why = code.map_or_else(|| "none given".to_owned(), |code| code.to_string());
        break_off(tx, robot_id, Reason::from(Code::RobotDoesNotAnswer).with("refusal", why));
    }
}

fn break_off(tx: &mut Tx, robot_id: &RobotId, reason: Reason) {
    let since = Some(tx.now.utc);
    let broken = RobotControl { unanswered_since: since, unanswered: Vec::new(), ..control(tx, robot_id) };
    tx.put_row(broken, "robot.broken_off");
    incidents::open_about(tx, reason, Some(robot_id), "");
}

/// Whether so many of a fleet missed an offer at once that the robots cannot be to blame. One alone is never many.
fn are_many(missed: usize, robots: usize) -> bool {
    missed > limits::UNANSWERED_ROBOTS_MAX || (missed > 1 && missed * 1000 > robots * limits::UNANSWERED_PERMILLE_MAX)
}

fn back_off(tx: &mut Tx, robot_id: &RobotId, in_row: u32) {
    let pause_ms = limits::UNANSWERED_PAUSE.as_ms() << in_row.saturating_sub(1).min(16);
    let until = tx.now.link + LinkDuration(pause_ms.min(limits::UNANSWERED_PAUSE_MAX.as_ms()));
    tx.view.unanswered_offers.backed_off.insert(robot_id.clone(), (in_row, until));
}

fn control(tx: &Tx, robot_id: &RobotId) -> RobotControl {
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    known.unwrap_or_else(|| RobotControl::new(robot_id.clone()))
}

/// Counts a missed offer, and opens the breaker at the third.
fn count_missed_offer(tx: &mut Tx, robot_id: &RobotId) {
    let (mut control, now) = (control(tx, robot_id), tx.now.utc);
    control.unanswered.retain(|at| now.ms_since(*at) <= limits::BREAKER_WINDOW.as_ms());
    control.unanswered.push(now);
    let is_broken = control.unanswered_since.is_some() || control.unanswered.len() >= limits::BREAKER_FAILURES;
    tx.put_row(control, "robot.missed_offer");
    if is_broken {
        break_off(tx, robot_id, Code::RobotDoesNotAnswer.into());
    }
}

/// Takes back the missed offers that were counted a moment ago.
fn excuse_missed_offer(tx: &mut Tx, robot_id: &RobotId) {
    let (mut control, now) = (control(tx, robot_id), tx.now.utc);
    let before = (control.unanswered.len(), control.unanswered_since);
    let window = limits::BREAKER_WINDOW.as_ms();
    control.unanswered.retain(|at| (limits::UNANSWERED_AT_ONCE.as_ms()..=window).contains(&now.ms_since(*at)));
    control.unanswered_since =
        control.unanswered_since.filter(|at| now.ms_since(*at) > limits::UNANSWERED_AT_ONCE.as_ms());
    if before != (control.unanswered.len(), control.unanswered_since) {
        tx.put_row(control, "robot.excused");
    }
}

/// Notes that a robot took an offer, or refused it for what the task asks for.
pub fn note_answer(tx: &mut Tx, robot_id: &RobotId) {
    tx.view.unanswered_offers.missed.remove(robot_id);
    tx.view.unanswered_offers.backed_off.remove(robot_id);
    let control = control(tx, robot_id);
    if control.unanswered_since.is_some() {
        tx.put_row(RobotControl { unanswered_since: None, unanswered: Vec::new(), ..control }, "robot.answered");
        incidents::close_about(tx, Code::RobotDoesNotAnswer, robot_id, "it answered an offer");
    }
}

/// Checks that a robot answers offers, or that its next probe is due.
///
/// # Errors
/// If it does not answer.
pub fn check_answering(view: &FleetProjection, robot_id: &RobotId, now: &Now) -> Result<(), Reason> {
    let since = view.control.get(robot_id.as_str()).and_then(|c| c.row.unanswered_since);
    if let Some(since) = since.filter(|since| now.ms_since(*since) < limits::BREAKER_WINDOW.as_ms()) {
        let left_ms = limits::BREAKER_WINDOW.as_ms() - now.ms_since(since);
        return Err(Reason::from(Code::RobotDoesNotAnswer).with("probe_in_ms", left_ms));
    }
    match view.unanswered_offers.backed_off.get(robot_id) {
        Some((in_row, until)) if now.link < *until => {
            let left_ms = until.since(now.link).as_ms();
            Err(Reason::from(Code::OfferNotAnswered).with("in_a_row", in_row).with("again_in_ms", left_ms))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::site::{CORRIDOR, text};
    use crate::time::LinkTime;
    use std::sync::Arc;

    fn view() -> FleetProjection {
        FleetProjection::new(Arc::new(text::parse(CORRIDOR).expect("reads")), Now::default(), Now::default())
    }

    fn robot(n: usize) -> RobotId {
        RobotId::parse(&format!("r{n}")).expect("an id")
    }

    fn at(secs: u64) -> Now {
        Now { link: LinkTime(secs * 1_000), utc: crate::time::Utc(secs as i64 * 1_000), ..Now::default() }
    }

    fn miss(view: &mut FleetProjection, n: usize, secs: u64) {
        let mut tx = Tx::new(view, at(secs), "tests");
        note_missed_offer(&mut tx, &robot(n));
    }

    fn code(view: &FleetProjection, n: usize, secs: u64) -> Option<Code> {
        check_answering(view, &robot(n), &at(secs)).err().map(|reason| reason.code)
    }

    #[test]
    fn one_that_does_not_answer_is_passed_over_for_longer_and_longer_and_then_until_a_probe() {
        let mut view = view();
        miss(&mut view, 1, 100);
        assert_eq!(code(&view, 1, 101), Some(Code::OfferNotAnswered));
        assert_eq!(code(&view, 1, 102), None);
        miss(&mut view, 1, 110);
        assert_eq!((code(&view, 1, 113), code(&view, 1, 114)), (Some(Code::OfferNotAnswered), None));
        miss(&mut view, 1, 130);
        assert_eq!((code(&view, 1, 729), code(&view, 1, 730)), (Some(Code::RobotDoesNotAnswer), None));
        miss(&mut view, 1, 731);
        assert_eq!(code(&view, 1, 1_330), Some(Code::RobotDoesNotAnswer), "a probe that is not answered opens it anew");
        assert_eq!(view.incidents.len(), 1);
        let mut tx = Tx::new(&mut view, at(1_400), "tests");
        note_answer(&mut tx, &robot(1));
        assert_eq!(code(&view, 1, 1_400), None);
        assert!(view.incidents.values().all(|i| i.row.closed.is_some()), "it closes by itself");
    }

    #[test]
    fn offers_missed_far_apart_open_no_breaker() {
        let mut view = view();
        for secs in [1_000, 1_500, 2_000, 2_500] {
            miss(&mut view, 1, secs);
        }
        assert!(view.incidents.is_empty());
    }

    #[test]
    fn many_that_miss_offers_at_once_are_not_to_blame() {
        let mut view = view();
        for n in 0..4 {
            miss(&mut view, n, 100 + n as u64);
        }
        let codes: Vec<Code> = view.incidents.values().map(|i| i.row.reason.code).collect();
        assert_eq!(codes, [Code::OffersNotAnswered]);
        assert!(view.control.values().all(|c| c.row.unanswered.is_empty()));
        for (missed, robots, many) in [(1, 1, false), (2, 20, false), (2, 9, true), (3, 20, false), (4, 1_000, true)] {
            assert_eq!(are_many(missed, robots), many, "{missed} of {robots}");
        }
    }
}
