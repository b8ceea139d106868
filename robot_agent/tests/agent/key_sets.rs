//! Which keys a robot takes directives of: a new one only if a release lists it and a key that was current signed it.
//! Each test is named by what is tried.

use crate::release::{Bundle, Releases};
use crate::rig::Rig;
use crate::updates::{Order, committed, connected, maintain, on_trial, refused, state, want};
use midshift_core::reason::Code;
use midshift_core::update::{Goal, UpdateState};

/// Tells the robot to stage `bundle` by the key of seed `by`. Whether it took the order.
fn takes(rig: &mut Rig, releases: &Releases, by: u8, bundle: &Bundle, generation: u64) -> bool {
    let before = refused(rig).len();
    want(rig, back(releases, by, bundle, generation).to(Goal::Stage));
    let refused = &refused(rig)[before..];
    let of_order = |code: &Code| matches!(code, Code::BadSignature | Code::DirectiveRefused);
    assert!(refused.iter().all(of_order), "{refused:?}");
    refused.is_empty()
}

/// The server's side of an order that the key of seed `by` signs.
fn back(releases: &Releases, by: u8, bundle: &Bundle, generation: u64) -> Order {
    let mut order = Order::new(releases.directive_by(by, bundle, generation));
    order.generation = generation * 1_000;
    order
}

#[test]
fn a_key_that_is_listed_and_signed_by_a_current_one_is_taken_and_the_old_one_ends() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    assert!(!takes(&mut rig, &releases, 8, &bundle, 1), "nobody told of it");
    releases.list_keys(1, &[8, 7], 7);
    assert!(takes(&mut rig, &releases, 8, &bundle, 2));
    assert_eq!(state(&rig), Some(UpdateState::Staged));
    assert!(takes(&mut rig, &releases, 7, &bundle, 3), "both are good");
    releases.list_keys(2, &[8], 8);
    assert!(!takes(&mut rig, &releases, 7, &bundle, 4), "it has ended");
    let mut rig = rig.restart();
    rig.connect();
    assert!(!takes(&mut rig, &releases, 7, &bundle, 5), "also after a start");
    assert!(takes(&mut rig, &releases, 8, &bundle, 6));
}

#[test]
fn a_key_that_is_listed_but_not_signed_by_a_current_one_is_not_taken() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.list_keys(1, &[8], 8);
    releases.list_keys(2, &[66], 66);
    assert!(!takes(&mut rig, &releases, 8, &bundle, 1), "release people alone bring in no key");
    assert!(!takes(&mut rig, &releases, 66, &bundle, 2));
    assert!(takes(&mut rig, &releases, 7, &bundle, 3));
}

#[test]
fn a_key_that_a_current_one_signed_but_no_release_lists_is_not_taken() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.hold_keys(1, &[66], 7);
    assert!(!takes(&mut rig, &releases, 66, &bundle, 1), "a thief of the server's key brings in none");
    assert!(takes(&mut rig, &releases, 7, &bundle, 2));
}

#[test]
fn a_key_that_an_ended_one_signed_is_not_taken_and_an_older_set_does_not_come_back() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.list_keys(1, &[7, 8], 7);
    let older = releases.documents();
    releases.list_keys(2, &[8], 8);
    assert!(takes(&mut rig, &releases, 8, &bundle, 1));
    releases.list_keys(3, &[66], 7);
    assert!(!takes(&mut rig, &releases, 66, &bundle, 2), "the key that signed it has ended");
    releases.replay(&older);
    let before = refused(&rig).len();
    want(&mut rig, back(&releases, 7, &bundle, 3).to(Goal::Stage));
    assert_eq!(refused(&rig)[before..], [Code::MetadataRefused], "older documents are not believed at all");
    let mut rig = rig.restart();
    rig.connect();
    want(&mut rig, back(&releases, 7, &bundle, 4).to(Goal::Stage));
    assert_eq!(refused(&rig).last(), Some(&Code::MetadataRefused));
}

#[test]
fn a_robot_that_was_away_goes_from_set_to_set() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.list_keys(1, &[8], 7);
    releases.list_keys(2, &[9], 8);
    releases.list_keys(3, &[10], 9);
    assert!(!takes(&mut rig, &releases, 9, &bundle, 1), "it has ended meanwhile");
    assert!(takes(&mut rig, &releases, 10, &bundle, 2));
}

#[test]
fn a_server_without_the_bytes_of_a_set_is_asked_again_and_nothing_is_taken_until_then() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.list_keys(1, &[8], 7);
    releases.corrupt(true);
    assert!(takes(&mut rig, &releases, 8, &bundle, 1), "it is put off, not refused");
    assert_eq!(state(&rig), None);
    releases.corrupt(false);
    rig.pass(60_000);
    assert_eq!(state(&rig), Some(UpdateState::Staged));
}

#[test]
fn what_was_taken_goes_on_when_its_key_has_ended() {
    let (rig, releases) = connected();
    let (first, second) = (releases.release("1.1.0"), releases.release("1.2.0"));
    let (mut rig, mut order) = on_trial(rig, &releases, &first, 1);
    releases.list_keys(1, &[8], 7);
    maintain(&mut rig, None);
    want(&mut rig, order.to(Goal::Commit));
    assert_eq!(state(&rig), Some(UpdateState::Committed));
    assert!(takes(&mut rig, &releases, 8, &second, 2));
    let mut staged = back(&releases, 8, &second, 2);
    staged.generation += 10;
    releases.list_keys(2, &[9], 8);
    assert!(!takes(&mut rig, &releases, 7, &first, 3), "the set is known now");
    let mut rig = rig.restart();
    rig.connect();
    staged.generation += 10_000;
    want(&mut rig, staged.to(Goal::Stage));
    assert_eq!(state(&rig), Some(UpdateState::Staged));
    want(&mut rig, staged.to(Goal::Revert));
    assert_eq!(state(&rig), Some(UpdateState::Refused), "it is dropped as its own order says");
}

#[test]
fn an_order_to_go_back_by_a_key_that_came_since_is_obeyed() {
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut rig = committed(rig, &releases, &bundle, 1);
    releases.list_keys(1, &[8], 7);
    let before = refused(&rig).len();
    let mut order = back(&releases, 8, &bundle, 2);
    order.generation += 1;
    want(&mut rig, order.to(Goal::Revert));
    assert_eq!(refused(&rig).len(), before);
    assert_ne!(state(&rig), Some(UpdateState::Committed), "it goes back");
    let (rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    let mut rig = committed(rig, &releases, &bundle, 1);
    want(&mut rig, back(&releases, 66, &bundle, 2).to(Goal::Revert));
    assert_eq!((refused(&rig).last(), state(&rig)), (Some(&Code::BadSignature), Some(UpdateState::Committed)));
}

#[test]
fn keys_that_a_person_puts_into_the_trust_file_count_instead_and_older_sets_stay_behind() {
    let (mut rig, releases) = connected();
    let bundle = releases.release("1.1.0");
    releases.list_keys(1, &[8], 7);
    releases.list_keys(2, &[9], 8);
    assert!(takes(&mut rig, &releases, 9, &bundle, 1));
    // All keys are lost. The new file names one that signed an older set, too.
    releases.trust(8);
    let mut rig = rig.restart();
    rig.connect();
    assert!(!takes(&mut rig, &releases, 9, &bundle, 2));
    assert!(takes(&mut rig, &releases, 8, &bundle, 3));
    releases.list_keys(3, &[10], 8);
    assert!(takes(&mut rig, &releases, 10, &bundle, 4), "and is handed over as ever");
}
