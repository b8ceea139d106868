//! A robot that could not go back, and gets another order since.

use crate::release::{Bundle, Releases};
use crate::rig::Rig;
use crate::updates::{
    Order, committed, connected, name_of, on_trial, refused, relaunch, report, stage, state, switch, want,
};
use midshift_core::reason::Code;
use midshift_core::update::{Goal, UpdateState};

/// With `second` on trial, and stuck with it: the kept set, `first`, has rotted. With its name, and what rots it: the
/// second time its byte is as it was.
pub fn stuck(rig: Rig, releases: &Releases, first: &Bundle, second: &Bundle) -> (Rig, String, impl Fn() + use<>) {
    let rig = committed(rig, releases, first, 1);
    let kept = name_of(&rig);
    let (mut rig, mut order) = on_trial(rig, releases, second, 2);
    let (sets, digest) = (rig.updates.as_ref().expect("has them").sets.clone(), first.manifest.components[0].digest);
    let rot = move || sets.rot(&digest);
    rot();
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!(state(&rig), Some(UpdateState::Stuck));
    (rig, kept, rot)
}

#[test]
fn a_stuck_robot_goes_back_by_a_newer_order_once_its_kept_set_is_whole_again() {
    let (rig, releases) = connected();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let (mut rig, kept, rot) = stuck(rig, &releases, &first, &second);
    let order_back = |rig: &mut Rig, generation: u64| {
        let mut order = Order::new(releases.directive(&second, generation));
        order.generation = generation * 100_000;
        want(rig, order.to(Goal::Revert));
    };
    order_back(&mut rig, 3);
    let told = report(&rig).map(|told| (told.state, told.directive_generation));
    assert_eq!((told, rig.exit), (Some((UpdateState::Stuck, 3)), None), "it looked, and nothing was mended");
    rot();
    rig.pass(5_000);
    assert_eq!(state(&rig), Some(UpdateState::Stuck), "nobody has said so");
    order_back(&mut rig, 4);
    let mut rig = relaunch(rig);
    rig.pass(1_000);
    assert_eq!((state(&rig), switch(&rig).running()), (Some(UpdateState::RolledBack), kept.as_str()));
}

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
