//! Restarts: what a robot knows after it was killed, and what it does about a step that must not be done twice.

use crate::rig::{Rig, action, attempt};
use midshift_agent::body::Checked;
use midshift_core::robot::WorkState;
use midshift_core::step::Effect;

/// Inside `effect`, killed, and told again what it has to do.
fn killed_inside(effect: Effect, checked: Checked) -> Rig {
    let steps = vec![action("pick", effect), action("place", Effect::Repeatable)];
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(rig.offer("T1", 1, steps.clone(), vec![]))));
    assert_eq!(rig.body.log().acts, 1);
    rig.body.set(|b| b.checked = checked);
    rig.body.set(|b| b.acting = None);
    let mut rig = rig.restart();
    rig.connect();
    rig.work(rig.desired(Some(rig.offer("T1", 1, steps, vec![]))));
    rig
}

#[test]
fn an_intent_is_on_the_ledger_before_the_body_begins_what_must_not_be_done_twice() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(rig.offer("T0", 1, vec![action("pick", Effect::Repeatable)], vec![]))));
    rig.body.done();
    rig.slow_disk = true;
    rig.work(rig.desired(Some(rig.offer("T1", 1, vec![action("place", Effect::AtMostOnce)], vec![]))));
    assert_eq!(rig.body.log().acts, 1);
    // Accepted is durable, the intent is not.
    let (batch, ops) = rig.unwritten.take().expect("a batch");
    rig.store.commit_now(&ops);
    rig.give(midshift_agent::core::Input::Persisted(batch));
    let holder = rig.store.memory().expect("loaded").ledger.holder;
    assert_eq!((rig.body.log().acts, holder.and_then(|h| h.intent)), (1, None));
    rig.flush();
    assert_eq!(rig.body.log().acts, 2);
    let holder = rig.store.memory().expect("loaded").ledger.holder.expect("a holder");
    assert_eq!((holder.attempt, holder.intent.map(|i| i.step)), (attempt("T1", 1), Some(0)));
}

#[test]
fn a_step_that_was_done_before_the_kill_is_not_done_again() {
    let mut rig = killed_inside(Effect::AtMostOnce, Checked::Done);
    assert_eq!(rig.states().last(), Some(&(WorkState::Executing, 1)));
    assert_eq!(rig.body.log().acts, 2);
    assert!(
        matches!(&rig.body.log().acting, Some(midshift_core::step::StepKind::Action { name, .. }) if name == "place")
    );
}

#[test]
fn a_step_that_was_not_done_is_done() {
    for effect in [Effect::AtMostOnce, Effect::CheckFirst] {
        let mut rig = killed_inside(effect, Checked::NotDone);
        assert_eq!((rig.states().last().copied(), rig.body.log().acts), (Some((WorkState::Executing, 0)), 2));
    }
}

#[test]
fn a_step_of_which_nobody_knows_makes_the_robot_stand_and_say_so() {
    let mut rig = killed_inside(Effect::AtMostOnce, Checked::Unknown);
    let last = rig.reports().pop().expect("a report");
    assert_eq!((last.state, last.step_index, last.opened), (WorkState::StepUnknown, 0, true));
    rig.pass(700_000);
    assert_eq!(rig.body.log().acts, 1);
    rig.work(rig.desired(None));
    let last = rig.reports().pop().expect("a report");
    assert_eq!((last.state, last.opened), (WorkState::Aborted, true));
}

#[test]
fn what_may_be_repeated_is_repeated() {
    let rig = killed_inside(Effect::Repeatable, Checked::Unknown);
    assert_eq!(rig.body.log().acts, 2);
}

#[test]
fn after_a_restart_work_goes_on_only_when_the_server_has_heard_the_robot() {
    let steps = vec![action("pick", Effect::Repeatable)];
    let mut rig = Rig::at("A");
    rig.connect();
    rig.work(rig.desired(Some(rig.offer("T1", 1, steps.clone(), vec![]))));
    let mut rig = rig.restart();
    rig.give(midshift_agent::core::Input::Connected(midshift_proto::session::Welcome {
        session_epoch: 2,
        ..crate::rig::welcome()
    }));
    rig.epoch = 2;
    rig.work(rig.desired(Some(rig.offer("T1", 1, steps, vec![]))));
    assert_eq!(rig.body.log().acts, 1);
    let listed = rig.reported.clone().expect("a heartbeat").attempts;
    assert_eq!((listed[0].attempt.clone(), listed[0].state), (attempt("T1", 1), WorkState::Paused));
    rig.echo();
    assert_eq!(rig.body.log().acts, 2);
}
