//! Fleet stop and software: nothing is activated while a robot is stopped, and going back stays possible where it
//! stands.

use crate::release::Releases;
use crate::rig::{Rig, action};
use crate::stops::{attend, desk, freed, reset, serve, stop, stop_id, told};
use crate::updates::{
    Order, activate, drain, maintain, name_of, on_trial, relaunch, report, stage, state, switch, want,
};
use midshift_core::desired_state::DesiredWork;
use midshift_core::robot::StopLevel;
use midshift_core::robot_events::RobotEvent;
use midshift_core::step::Effect;
use midshift_core::update::{Goal, UpdateEvent, UpdateState};

fn staged() -> (Rig, Order, Releases) {
    let releases = Releases::new();
    let mut rig = freed(Rig::updatable_with(&releases, desk()));
    let bundle = releases.release("1.1.0");
    let order = stage(&mut rig, &releases, &bundle, 1);
    assert_eq!(state(&rig), Some(UpdateState::Staged));
    (rig, order, releases)
}

fn halt(rig: &mut Rig) {
    told(rig, vec![stop(1, StopLevel::Halt)], vec![]);
}

fn blocked_by(rig: &Rig) -> Option<String> {
    report(rig).and_then(|r| r.reason).and_then(|r| r.metadata.get("by").cloned())
}

#[test]
fn nothing_is_activated_while_a_robot_is_stopped_and_after_its_resume_it_is() {
    let (mut rig, mut order, _) = staged();
    halt(&mut rig);
    activate(&mut rig, &mut order, "drain-1");
    serve(&mut rig, 3_000);
    assert_eq!((state(&rig), rig.exit, blocked_by(&rig).as_deref()), (Some(UpdateState::Staged), None, Some("stop")));
    let begun =
        |e: &RobotEvent| matches!(e, RobotEvent::Update(UpdateEvent::Changed(r)) if r.state == UpdateState::Switching);
    assert!(!rig.events.iter().any(begun), "its grant is not even used");
    told(&mut rig, vec![], vec![reset(1)]);
    let maintenance = Some(drain("drain-1"));
    rig.work(DesiredWork { maintenance, resumed: vec![stop_id(1)], ..rig.desired(None) });
    serve(&mut rig, 1_000);
    activate(&mut rig, &mut order, "drain-1");
    assert_eq!(state(&relaunch(rig)), Some(UpdateState::Probation));
}

#[test]
fn a_stop_that_comes_while_the_switch_waits_for_the_disk_takes_it_back() {
    for ticks in 0..3 {
        let (mut rig, mut order, _) = staged();
        rig.slow_disk = true;
        activate(&mut rig, &mut order, "drain-1");
        rig.silence(500 * ticks);
        halt(&mut rig);
        rig.flush();
        assert_eq!((state(&rig), rig.exit), (Some(UpdateState::Staged), None), "{ticks}");
        assert_eq!(switch(&rig).running(), "factory");
        let (mut rig, mut order, _) = staged();
        rig.slow_disk = true;
        activate(&mut rig, &mut order, "drain-1");
        rig.silence(500 * ticks);
        rig.flush();
        assert_eq!(switch(&rig).running(), name_of(&rig), "without a stop it is done");
    }
}

#[test]
fn a_robot_that_is_stopped_at_work_goes_back_where_it_stands_and_nothing_moves() {
    let releases = Releases::new();
    let bundle = releases.release("1.1.0");
    let rig = freed(Rig::updatable_with(&releases, desk()));
    let (mut rig, mut order) = on_trial(rig, &releases, &bundle, 1);
    attend(&mut rig);
    serve(&mut rig, 4_000);
    maintain(&mut rig, None);
    rig.work(rig.desired(Some(rig.offer("T1", 1, vec![action("pick", Effect::Repeatable)], vec![]))));
    assert!(rig.body.log().acting.is_some());
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!((state(&rig), rig.exit), (Some(UpdateState::RollingBack), None), "it works");
    halt(&mut rig);
    serve(&mut rig, 1_000);
    let acts = rig.body.log().acts;
    let mut rig = relaunch(rig);
    attend(&mut rig);
    serve(&mut rig, 5_000);
    assert_eq!((state(&rig), rig.body.log().acts), (Some(UpdateState::RolledBack), acts));
    assert_eq!(switch(&rig).running(), "factory");
}
