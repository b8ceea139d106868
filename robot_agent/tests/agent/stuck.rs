//! A robot that could not go back, and gets another order since.

use crate::updates::{Order, connected, refused, relaunch, stage, state, stuck, switch, want};
use midshift_core::reason::Code;
use midshift_core::update::{Goal, UpdateState};

#[test]
fn a_stuck_robot_that_gets_a_newer_bundle_reads_its_kept_set_before_it_goes_back_to_it() {
    let (rig, releases) = connected();
    let [first, second, third] = ["1.1.0", "1.2.0", "1.3.0"].map(|version| releases.release(version));
    let (mut rig, kept, rot) = stuck(rig, &releases, &first, &second);
    let before = (Some(UpdateState::Stuck), switch(&rig));
    stage(&mut rig, &releases, &third, 3);
    rig.pass(5_000);
    assert_eq!(((state(&rig), switch(&rig)), rig.exit), (before.clone(), None), "its kept set has rotted");
    assert_eq!(refused(&rig), [Code::KeptSetBad], "once");
    // To leave the set before is no way on either: it would end what is on trial without a look at what is kept.
    let mut back = Order::new(releases.directive(&first, 4));
    back.generation = 400;
    want(&mut rig, back.to(Goal::Revert));
    rig.pass(5_000);
    assert_eq!(((state(&rig), switch(&rig)), rig.exit), (before, None));
    rot();
    stage(&mut rig, &releases, &third, 5);
    let mut rig = relaunch(rig);
    rig.pass(1_000);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), kept.as_str()));
    stage(&mut rig, &releases, &third, 5);
    assert_eq!(state(&rig), Some(UpdateState::Staged), "the order is taken after that");
}
