//! A robot that could not go back, and gets another order since.

use crate::updates::{Order, committed, connected, name_of, on_trial, refused, relaunch, stage, state, switch, want};
use midshift_core::reason::Code;
use midshift_core::update::{Goal, UpdateState};

#[test]
fn a_stuck_robot_that_gets_a_newer_bundle_reads_its_kept_set_before_it_goes_back_to_it() {
    let (rig, releases) = connected();
    let [first, second, third] = ["1.1.0", "1.2.0", "1.3.0"].map(|version| releases.release(version));
    let rig = committed(rig, &releases, &first, 1);
    let kept = name_of(&rig);
    let (mut rig, mut order) = on_trial(rig, &releases, &second, 2);
    let sets = rig.updates.as_ref().expect("has them").sets.clone();
    // The second time its byte is as it was.
    let rot = || sets.rot(&first.manifest.components[0].digest);
    rot();
    want(&mut rig, order.to(Goal::Revert));
    let stuck = (Some(UpdateState::Stuck), switch(&rig));
    stage(&mut rig, &releases, &third, 3);
    rig.pass(5_000);
    assert_eq!(((state(&rig), switch(&rig)), rig.exit), (stuck.clone(), None), "its kept set has rotted");
    assert_eq!(refused(&rig), [Code::KeptSetBad], "once");
    // To leave the set before is no way on either: it would end what is on trial without a look at what is kept.
    let mut back = Order::new(releases.directive(&first, 4));
    back.generation = 400;
    want(&mut rig, back.to(Goal::Revert));
    rig.pass(5_000);
    assert_eq!(((state(&rig), switch(&rig)), rig.exit), (stuck, None));
    rot();
    stage(&mut rig, &releases, &third, 5);
    let mut rig = relaunch(rig);
    rig.pass(1_000);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), kept.as_str()));
    stage(&mut rig, &releases, &third, 5);
    assert_eq!(state(&rig), Some(UpdateState::Staged), "the order is taken after that");
}
