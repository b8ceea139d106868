//! Offers: what a robot takes, what it refuses and what it remembers.

use crate::rig::{Rig, action, attempt, goto, point, welcome};
use crate::test_body::TestBody;
use midshift_agent::body::BodyNews;
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_agent::core::{ExitReason, Input};
use midshift_agent::memory::MemoryStore;
use midshift_core::desired_state::{Assignment, DesiredWork};
use midshift_core::robot::WorkState;
use midshift_core::robot::{Fault, FaultClass, Mode};
use midshift_core::robot_events::RobotEvent;
use midshift_core::step::Effect;
use midshift_proto::link::v1;
use midshift_proto::session::{ClockSample, Downlink, Echo, ToRobot, Welcome};

fn drive(rig: &Rig, name: &str, epoch: u64) -> Assignment {
    rig.offer(name, epoch, vec![goto("B")], vec![point("A", None, false, &[]), point("B", Some(0), false, &[])])
}

/// A rig with this naive rule on.
fn naive(bug: SeededBug) -> Rig {
    Rig::with(TestBody::at("A"), MemoryStore::new(), Bugs::seeded(&[bug]))
}

fn offered(mut rig: Rig, after_ms: u64) -> Rig {
    rig.connect();
    let offer = drive(&rig, "T1", 1);
    rig.pass(after_ms);
    rig.work(rig.desired(Some(offer)));
    rig
}

fn done_once(mut rig: Rig) -> Rig {
    rig.connect();
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    rig.body.reach();
    rig.pass(500);
    assert_eq!(rig.states().last(), Some(&(WorkState::Succeeded, 1)));
    rig
}

#[test]
fn an_offer_is_on_the_ledger_before_anybody_hears_of_it_and_before_the_body_moves() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.slow_disk = true;
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!((rig.states(), rig.body.goes_to()), (vec![], vec![]));
    assert!(rig.store.memory().expect("loaded").ledger.holder.is_none());
    rig.flush();
    let holder = rig.store.memory().expect("loaded").ledger.holder.expect("a holder");
    assert_eq!(holder.attempt, attempt("T1", 1));
    assert_eq!(rig.body.goes_to(), ["B"]);
    assert_eq!(rig.states(), [(WorkState::Accepted, 0), (WorkState::Navigating, 0)]);
}

#[test]
fn an_offer_that_lay_in_a_buffer_for_twelve_seconds_moves_nobody() {
    let mut rig = offered(Rig::at("A"), 12_000);
    assert_eq!((rig.stale(), rig.body.goes_to().len()), (1, 0));
    assert_eq!(rig.refusals(), ["STALE_AUTHORITY"]);
    // Said once, and never taken later under the same epoch.
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!((rig.refusals().len(), rig.body.goes_to().len()), (0, 0));
}

#[test]
fn counting_from_receipt_would_let_a_buffered_offer_start_a_body() {
    let rig = offered(naive(SeededBug::AuthorityFromReceipt), 12_000);
    assert_eq!(rig.body.goes_to(), ["B"]);
}

#[test]
fn an_offer_anchored_to_the_session_before_is_refused() {
    let mut rig = Rig::at("A");
    rig.connect();
    let offer = drive(&rig, "T1", 1);
    rig.connect();
    rig.work(rig.desired(Some(offer)));
    assert_eq!(rig.refusals(), ["STALE_AUTHORITY"]);
}

#[test]
fn an_epoch_that_was_passed_is_refused_also_after_a_restart_and_by_another_store() {
    let mut rig = Rig::at("A");
    rig.connect();
    let wait = |rig: &Rig, epoch| rig.offer("T1", epoch, vec![action("pick", Effect::Repeatable)], vec![]);
    rig.work(rig.desired(Some(wait(&rig, 5))));
    rig.work(rig.desired(None));
    assert_eq!(rig.states().last(), Some(&(WorkState::Aborted, 0)));
    let mut rig = rig.restart();
    rig.connect_as(Welcome { session_epoch: 9, store_id: "store-2".into(), ..welcome() });
    rig.reports();
    for epoch in [4, 5] {
        rig.work(rig.desired(Some(wait(&rig, epoch))));
    }
    let reports = rig.reports();
    assert_eq!(reports[0].refusal.as_ref().map(|r| r.code.as_str()), Some("STALE_EPOCH"));
    assert_eq!((reports.len(), rig.body.log().acts), (1, 1));
    rig.work(rig.desired(Some(wait(&rig, 6))));
    assert_eq!(rig.body.log().acts, 2);
}

#[test]
fn a_finished_task_is_answered_from_memory_and_never_done_again() {
    let mut rig = done_once(Rig::at("A")).restart();
    rig.body.set(|b| b.waypoint = Some(crate::rig::waypoint("A")));
    rig.connect();
    rig.reports();
    rig.work(rig.desired(Some(drive(&rig, "T1", 2))));
    let reports = rig.reports();
    assert_eq!(
        reports.iter().map(|r| (r.state, r.attempt.epoch)).collect::<Vec<_>>(),
        [(WorkState::Succeeded, 1), (WorkState::Refused, 2)]
    );
    assert_eq!(reports[1].refusal.as_ref().map(|r| r.code.as_str()), Some("ALREADY_FINISHED"));
    assert!(rig.body.goes_to().is_empty());
    // The same question again: the answer stands.
    rig.work(rig.desired(Some(drive(&rig, "T1", 2))));
    assert_eq!(rig.reports().len(), 0);
}

#[test]
fn a_ledger_without_its_fence_would_do_a_finished_task_again() {
    let mut rig = done_once(naive(SeededBug::NoEpochFence));
    rig.body.set(|b| b.waypoint = Some(crate::rig::waypoint("A")));
    rig.body.set(|b| b.pose.x_mm = 0);
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!(rig.body.goes_to(), ["B"]);
}

#[test]
fn a_second_attempt_is_refused_while_another_holds_the_robot() {
    let mut rig = offered(Rig::at("A"), 0);
    rig.reports();
    rig.work(rig.desired(Some(drive(&rig, "T2", 1))));
    let reports = rig.reports();
    let refused = reports.iter().find(|r| r.attempt == attempt("T2", 1)).expect("an answer");
    assert_eq!(refused.refusal.as_ref().map(|r| r.code.as_str()), Some("ANOTHER_HOLDER"));
    assert!(reports.iter().any(|r| r.attempt == attempt("T1", 1) && r.state == WorkState::Stopping));

    let mut rig = offered(naive(SeededBug::IgnoreHolder), 0);
    rig.work(rig.desired(Some(drive(&rig, "T2", 1))));
    assert!(rig.reports().iter().any(|r| r.attempt == attempt("T2", 1) && r.state == WorkState::Accepted));
}

#[test]
fn what_the_robot_cannot_do_now_is_refused_with_the_reason() {
    let unknown = |rig: &Rig| rig.offer("T1", 1, vec![action("weld", Effect::Repeatable)], vec![]);
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(unknown(&rig))));
    assert_eq!(rig.refusals(), ["UNSUPPORTED_ACTION"]);

    let mut rig = Rig::at("Z");
    rig.connect();
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!(rig.refusals(), ["UNKNOWN_WAYPOINT"]);

    let body = TestBody::at("A");
    body.set(|b| b.mode = Mode::Manual);
    let rig = offered(Rig::with(body, MemoryStore::new(), Bugs::default()), 0);
    assert_eq!({ rig }.refusals(), ["NOT_AUTOMATIC"]);

    let mut rig = Rig::at("A");
    rig.connect_as(Welcome { observed: true, ..welcome() });
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!(rig.refusals(), ["ROBOT_OBSERVED"]);
}

#[test]
fn a_body_that_failed_its_test_takes_no_work_until_it_says_that_the_fault_is_over() {
    let fault = Fault { code: 77, class: FaultClass::Recoverable, message: "gripper does not close".into() };
    let body = TestBody::at("A");
    body.set(|b| b.broken = Some(fault.clone()));
    let mut rig = Rig::with(body, MemoryStore::new(), Bugs::default());
    rig.connect();
    // Told as a fault that nobody waits for, whatever the maker calls it.
    let told = Fault { class: FaultClass::Mechanical, ..fault.clone() };
    assert!(rig.events.contains(&RobotEvent::Fault { fault: told.clone(), cleared: false }));
    assert_eq!(rig.reported.as_ref().and_then(|r| r.fault.clone()), Some(told));
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!(rig.refusals(), ["ROBOT_FAULT"]);
    rig.body.says(BodyNews::Fault(fault, false));
    rig.pass(1_000);
    assert_eq!(rig.reported.as_ref().and_then(|r| r.fault.clone()), None);
    rig.work(rig.desired(Some(drive(&rig, "T1", 2))));
    assert_eq!(rig.states().first(), Some(&(WorkState::Accepted, 0)));
}

#[test]
fn desired_work_never_moves_backwards_unless_the_store_is_another() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(None));
    let old = midshift_core::desired_state::DesiredWork { generation: 3, ..rig.desired(Some(drive(&rig, "T1", 1))) };
    rig.down(Downlink { work: Some(old.clone()), ..Downlink::default() });
    assert_eq!(rig.states(), []);
    rig.connect_as(Welcome { session_epoch: 7, store_id: "store-2".into(), ..welcome() });
    let old = midshift_core::desired_state::DesiredWork { assignment: Some(drive(&rig, "T1", 1)), ..old };
    rig.down(Downlink { work: Some(old), ..Downlink::default() });
    assert_eq!(rig.states().first(), Some(&(WorkState::Accepted, 0)));
}

#[test]
fn an_offer_that_was_taken_back_unanswered_is_never_taken_later() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(Assignment { stop: true, ..drive(&rig, "T1", 1) })));
    rig.work(rig.desired(Some(drive(&rig, "T1", 1))));
    assert_eq!(rig.refusals(), ["STALE_EPOCH"]);
}

#[test]
fn work_that_cannot_be_read_ends_no_session_and_the_robot_says_so() {
    let mut rig = Rig::at("A");
    rig.connect();
    let held = DesiredWork { assignment: Some(drive(&rig, "T1", 1)), ..rig.desired(None) };
    let mut message = v1::SessionResponse::from(&ToRobot::Downlink(Box::new(Downlink {
        echo: Some(Echo { hb: 1, clock: ClockSample::default(), is_clock_doubted: false }),
        work: Some(DesiredWork { generation: 9, ..held.clone() }),
        ..Downlink::default()
    })));
    if let Some(v1::session_response::Message::Downlink(down)) = &mut message.message
        && let Some(assignment) = down.work.as_mut().and_then(|work| work.assignment.as_mut())
    {
        assignment.from_step = 99;
    }
    let read = midshift_proto::parse(message).expect("the message is read all the same");
    let ToRobot::Downlink(down) = read else { panic!("not a downlink") };
    assert_eq!((down.echo.map(|echo| echo.hb), &down.work), (Some(1), &None));
    rig.work(held.clone());
    assert_eq!(rig.states().first(), Some(&(WorkState::Accepted, 0)));
    rig.down(*down);
    assert_eq!(rig.stale(), 1, "it says so");
}

#[test]
fn the_second_fence_ends_the_process() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.give(Input::Fenced);
    assert_eq!(rig.exit, None);
    rig.connect();
    rig.give(Input::Fenced);
    assert_eq!(rig.exit, Some(ExitReason::FencedTwice));
}
