//! Steps: what is done, in which order, and how it ends.

use crate::rig::{Rig, action, goto, point, step};
use midshift_agent::body::{BodyNews, Checked};
use midshift_agent::core::Input;
use midshift_core::desired_state::{Assignment, DesiredWork};
use midshift_core::robot::WorkState;
use midshift_core::robot::{FAULT_TIMEOUT, Fault, FaultClass, Load};
use midshift_core::robot_events::RobotEvent;
use midshift_core::step::{Effect, StepKind, WorkStep};

fn fault(code: u32) -> Fault {
    Fault { code, class: FaultClass::Recoverable, message: String::new() }
}

fn accepted(steps: Vec<WorkStep>) -> Rig {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(rig.offer("T1", 1, steps, vec![]))));
    rig
}

#[test]
fn work_that_ends_at_once_again_and_again_makes_no_flood_of_heartbeats() {
    let mut rig = Rig::at("A");
    rig.connect();
    let before = rig.hb;
    for n in 0..50 {
        rig.work(rig.desired(Some(rig.offer(&format!("T{n}"), 1, vec![], vec![]))));
        rig.ms += 20;
        rig.give(Input::Tick);
    }
    let ended = rig.states().iter().filter(|(s, _)| *s == WorkState::Succeeded).count();
    assert!(ended > 20, "{ended} ended");
    assert!((2..=5).contains(&(rig.hb - before)), "{} heartbeats in a second", rig.hb - before);
}

#[test]
fn steps_are_done_in_order_and_each_is_said() {
    let mut rig = Rig::at("A");
    rig.connect();
    let steps = vec![goto("B"), action("pick", Effect::AtMostOnce), goto("C"), action("place", Effect::AtMostOnce)];
    let route = vec![point("A", None, false, &[]), point("B", Some(0), false, &[]), point("C", Some(2), false, &[])];
    rig.work(rig.desired(Some(rig.offer("T1", 1, steps, route))));
    rig.body.reach();
    rig.pass(500);
    rig.body.done();
    rig.pass(500);
    rig.body.reach();
    rig.pass(500);
    rig.body.done();
    rig.pass(1_000);
    let reports = rig.reports();
    let told: Vec<_> = reports.iter().map(|r| (r.state, r.step_index, r.opened)).collect();
    assert_eq!(
        told,
        [
            (WorkState::Accepted, 0, false),
            (WorkState::Navigating, 0, false),
            (WorkState::Executing, 1, false),
            (WorkState::Navigating, 2, true),
            (WorkState::Executing, 3, true),
            (WorkState::Succeeded, 4, true),
        ]
    );
    let listed = rig.reported.clone().expect("a heartbeat").attempts;
    assert_eq!(listed.iter().map(|a| a.state).collect::<Vec<_>>(), [WorkState::Succeeded]);
    rig.work(DesiredWork { closed: vec![listed[0].attempt.clone()], ..rig.desired(None) });
    rig.pass(1_000);
    assert_eq!(rig.reported.clone().expect("a heartbeat").attempts, []);
}

#[test]
fn a_resumed_task_goes_where_its_next_step_is_done_and_skips_what_is_done() {
    let mut rig = Rig::at("B");
    rig.connect();
    let steps = vec![goto("A"), action("pick", Effect::AtMostOnce), action("place", Effect::AtMostOnce)];
    let route = vec![point("B", None, false, &[]), point("A", Some(0), false, &[])];
    let offer = Assignment { resume_step: 2, ..rig.offer("T1", 1, steps, route) };
    rig.work(rig.desired(Some(offer)));
    rig.body.reach();
    rig.pass(500);
    let acting = rig.body.log().acting.clone();
    assert!(matches!(acting, Some(StepKind::Action { name, .. }) if name == "place"));
}

#[test]
fn a_step_that_fails_ends_the_attempt_unless_the_step_says_go_on() {
    let mut rig = accepted(vec![action("pick", Effect::Repeatable)]);
    rig.body.says(BodyNews::Failed(fault(1002)));
    rig.pass(500);
    let last = rig.reports().pop().expect("a report");
    assert_eq!((last.state, last.fault.map(|f| f.code)), (WorkState::Failed, Some(1002)));

    let lenient = WorkStep { continue_on_fail: true, ..action("pick", Effect::Repeatable) };
    let mut rig = accepted(vec![lenient, action("place", Effect::Repeatable)]);
    rig.body.says(BodyNews::Failed(fault(1002)));
    rig.pass(500);
    assert_eq!((rig.states().last().copied(), rig.body.log().acts), (Some((WorkState::Executing, 1)), 2));
}

#[test]
fn a_stop_waits_for_a_step_that_must_not_be_stopped_and_a_completion_wins() {
    let firm = WorkStep { cancel_allowed: false, ..action("pick", Effect::Repeatable) };
    let mut rig = accepted(vec![firm.clone(), action("place", Effect::Repeatable)]);
    rig.work(rig.desired(None));
    assert!(rig.body.log().acting.is_some());
    rig.body.done();
    rig.pass(500);
    assert_eq!(rig.states().last(), Some(&(WorkState::Aborted, 1)));

    let mut rig = accepted(vec![firm]);
    rig.work(rig.desired(None));
    rig.body.done();
    rig.pass(500);
    assert_eq!(rig.states().last(), Some(&(WorkState::Succeeded, 1)));
}

#[test]
fn a_stopped_action_that_may_have_been_done_leaves_the_task_opened() {
    let mut rig = accepted(vec![action("pick", Effect::AtMostOnce)]);
    rig.body.set(|b| b.checked = Checked::Unknown);
    rig.work(rig.desired(None));
    let last = rig.reports().pop().expect("a report");
    assert_eq!((last.state, last.opened), (WorkState::Aborted, true));
}

#[test]
fn a_robot_suspends_at_a_step_boundary_and_never_with_a_load() {
    let steps = vec![action("pick", Effect::Repeatable), action("place", Effect::Repeatable)];
    let suspend =
        |rig: &Rig| rig.desired(Some(Assignment { suspend: true, ..rig.offer("T1", 1, steps.clone(), vec![]) }));
    let mut rig = accepted(steps.clone());
    let work = suspend(&rig);
    rig.work(work);
    assert!(rig.body.log().acting.is_some());
    rig.body.done();
    rig.pass(500);
    assert_eq!(rig.states().last(), Some(&(WorkState::Suspended, 1)));

    let mut rig = accepted(steps.clone());
    rig.body.says(BodyNews::Load(Some(Load { task_id: None, item: "box".into() })));
    let work = suspend(&rig);
    rig.work(work);
    rig.body.done();
    rig.pass(500);
    assert_eq!((rig.states().last().copied(), rig.body.log().acts), (Some((WorkState::Executing, 1)), 2));
}

#[test]
fn the_agents_own_clock_ends_an_attempt_and_stands_still_while_it_is_held() {
    let wait = step(StepKind::Wait { duration_ms: 1_000_000 }, Effect::Repeatable);
    let mut rig = Rig::at("A");
    rig.connect();
    let offer = |rig: &Rig| Assignment { timeout_ms: 20_000, ..rig.offer("T1", 1, vec![wait.clone()], vec![]) };
    rig.work(rig.desired(Some(offer(&rig))));
    rig.pass(10_000);
    rig.work(DesiredWork { held: true, ..rig.desired(Some(offer(&rig))) });
    rig.pass(60_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Paused, 0)));
    rig.work(DesiredWork { resume: Some(rig.authority(10_000)), ..rig.desired(Some(offer(&rig))) });
    rig.pass(9_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Executing, 0)));
    rig.pass(2_000);
    let last = rig.reports().pop().expect("a report");
    assert_eq!((last.state, last.fault.map(|f| f.code)), (WorkState::Failed, Some(FAULT_TIMEOUT)));
}

#[test]
fn an_errand_charges_until_the_threshold_and_parks() {
    let mut params = serde_json::Map::new();
    params.insert("stop_permille".into(), 900.into());
    let charge = step(StepKind::Action { name: "charge".into(), params }, Effect::Repeatable);
    let mut rig = accepted(vec![charge, action("park", Effect::Repeatable)]);
    assert!(rig.body.log().charging);
    rig.body.set(|b| b.battery_permille = 899);
    rig.pass(2_000);
    assert!(rig.body.log().charging);
    rig.body.set(|b| b.battery_permille = 900);
    rig.pass(1_000);
    assert_eq!((rig.body.log().charging, rig.body.log().parks), (false, 1));
    assert_eq!(rig.states().last(), Some(&(WorkState::Succeeded, 2)));
}

#[test]
fn an_errand_that_is_broken_off_at_the_charger_says_how_far_it_came() {
    let steps = || vec![goto("B"), action("charge", Effect::Repeatable)];
    let route = || vec![point("A", None, false, &[]), point("B", Some(0), false, &[])];
    let mut rig = Rig::at("A");
    rig.connect();
    let offer = rig.offer("T1", 1, steps(), route());
    rig.work(rig.desired(Some(offer.clone())));
    assert_eq!(rig.body.goes_to(), ["B"], "a robot on its way to a charger goes on");
    rig.body.reach();
    rig.pass(500);
    assert!(rig.body.log().charging);
    rig.work(rig.desired(Some(Assignment { stop: true, ..offer })));
    rig.pass(1_000);
    assert_eq!(rig.states().last(), Some(&(WorkState::Aborted, 1)), "at its goal, which fleet calls DOCKED");
    assert!(rig.body.log().charging, "docked, it goes on charging");
}

#[test]
fn a_battery_that_becomes_critical_is_said_once() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.body.set(|b| b.battery_permille = 99);
    rig.pass(10_000);
    let critical = |e: &&RobotEvent| matches!(e, RobotEvent::BatteryCritical { battery_permille: 99 });
    assert_eq!(rig.events.iter().filter(critical).count(), 1);
}
