//! Why the agent's rules are as they are: each scenario is played with the rule, which holds, and with the naive one,
//! which does not.

use crate::release::Releases;
use crate::rig::{Rig, goto, point};
use crate::stops::{freed, moves, serve, stop, told};
use crate::updates::{Order, state, want};
use midshift_agent::bugs::{Bugs, SeededBug};
use midshift_core::desired_state::{Assignment, RoutePoint};
use midshift_core::robot::StopLevel;
use midshift_core::robot_events::UNREADABLE_WORK;
use midshift_core::update::{Goal, UpdateState};
use midshift_proto::session::Downlink;

fn rig(bugs: &[SeededBug]) -> (Rig, Releases) {
    let releases = Releases::new();
    (freed(Rig::naive(&releases, Bugs::seeded(bugs))), releases)
}

/// Under way to C over B, whose lane has a speed limit.
fn driving(bugs: &[SeededBug]) -> Rig {
    let (mut rig, _) = rig(bugs);
    let slow = RoutePoint { speed_limit_mm_s: Some(400), ..point("B", None, false, &[]) };
    let route = vec![point("A", None, false, &[]), slow, point("C", Some(0), false, &[])];
    let offer = Assignment { speed_limit_mm_s: Some(1_200), ..rig.offer("T1", 1, vec![goto("C")], route) };
    rig.work(rig.desired(Some(offer)));
    assert_eq!(rig.body.goes_to(), ["B", "C"]);
    rig
}

/// Whether a robot stands that hears of a stop while its ledger is being written.
fn stands_while_it_writes(bugs: &[SeededBug]) -> bool {
    let mut rig = driving(bugs);
    rig.slow_disk = true;
    serve(&mut rig, 5_000);
    assert!(rig.unwritten.is_some(), "the disk is at it");
    told(&mut rig, vec![stop(1, StopLevel::Halt)], vec![]);
    !moves(&rig)
}

#[test]
fn a_stop_waits_for_no_disk_and_where_it_does_the_robot_drives_on() {
    assert!(stands_while_it_writes(&[]));
    assert!(!stands_while_it_writes(&[SeededBug::StopYieldsToDisk]));
}

/// How fast the body is sent along the slow lane, millimetres per second.
fn speed_on_the_slow_lane(bugs: &[SeededBug]) -> u32 {
    driving(bugs).body.log().path[0].speed_mm_s
}

#[test]
fn the_lowest_limit_holds_and_where_the_last_word_counts_a_task_raises_it() {
    assert_eq!(speed_on_the_slow_lane(&[]), 400);
    assert_eq!(speed_on_the_slow_lane(&[SeededBug::LastWordIsTheLimit]), 1_200);
}

/// What becomes of a directive that is signed as it should be, for a bundle that no release lists.
fn told_to_take_what_nobody_released(bugs: &[SeededBug]) -> Option<UpdateState> {
    let (mut rig, releases) = rig(bugs);
    let stranger = Releases::new().release("6.6.6");
    want(&mut rig, Order::new(releases.directive(&stranger, 1)).to(Goal::Stage));
    state(&rig)
}

#[test]
fn software_that_nobody_released_is_not_taken_and_a_rule_that_asks_no_release_takes_it() {
    assert_eq!(told_to_take_what_nobody_released(&[]), None);
    assert!(told_to_take_what_nobody_released(&[SeededBug::UnlistedIsFine]).is_some());
}

/// Whether an order that a robot had before is obeyed again once a newer one has come.
fn obeys_an_old_order_again(bugs: &[SeededBug]) -> bool {
    let (mut rig, releases) = rig(bugs);
    let (old, new) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let orders = [releases.directive(&old, 1), releases.directive(&new, 2), releases.directive(&old, 1)];
    for (n, directive) in orders.into_iter().enumerate() {
        let mut order = Order::new(directive);
        order.generation = 100 * (n as u64 + 1);
        want(&mut rig, order.to(Goal::Stage));
    }
    let bundle = rig.core.memory().ledger.software.update.as_ref().map(|update| update.bundle);
    bundle == Some(old.digest)
}

#[test]
fn an_order_is_obeyed_once_and_without_its_number_it_can_be_played_again() {
    assert!(!obeys_an_old_order_again(&[]));
    assert!(obeys_an_old_order_again(&[SeededBug::ReplaysAreTaken]));
}

/// Whether a robot that is sent work of a later protocol says that it cannot read it.
fn says_that_it_cannot_read(bugs: &[SeededBug]) -> bool {
    let mut rig = driving(bugs);
    rig.down(Downlink { unreadable_work: Some("step 7 of kind 12".to_owned()), ..Downlink::default() });
    rig.pass(1_000);
    let said = format!("{:?}", rig.events).contains(UNREADABLE_WORK);
    assert_eq!(said, rig.stale() > 0);
    said
}

#[test]
fn work_of_a_later_protocol_is_told_and_a_rule_that_passes_over_it_goes_on_without_a_word() {
    assert!(says_that_it_cannot_read(&[]));
    assert!(!says_that_it_cannot_read(&[SeededBug::NewerWorkIsIgnored]));
}
