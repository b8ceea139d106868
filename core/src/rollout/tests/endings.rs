//! How roll-outs end that nothing ended early: with their bundle on as many robots as was asked, or not.

use super::*;
use crate::rollout::projection::rows::Ending;

fn outcome(rig: &Rig, id: &str) -> Option<Ending> {
    rig.rollout(id).outcome
}

/// A completed roll-out to five robots, of which one refuses the bundle.
fn four_of_five(complete_percent: u32) -> (Rig, usize) {
    let mut rig = Rig::new(5);
    rig.start(RolloutSpec { complete_percent, ..spec() });
    let n = rig.order()[4];
    rig.robots[n].fate = Fate::Unfit;
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    (rig, n)
}

#[test]
fn a_roll_out_that_updated_nobody_is_incomplete_and_serves_nobody() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    assert_eq!(outcome(&rig, "ro"), None);
    rig.fates(Fate::Unfit);
    rig.until(400, |r| r.phase() == Phase::Completed);
    assert_eq!(outcome(&rig, "ro"), Some(Ending::Incomplete));
    assert_eq!(rig.incidents(), [Code::RolloutIncomplete]);
    rig.arrive();
    rig.ticks(20);
    assert_eq!(rig.robots[4].version, "0.9.0");
}

#[test]
fn the_share_that_makes_it_complete_is_what_was_asked_for() {
    assert_eq!(outcome(&four_of_five(80).0, "ro"), Some(Ending::Complete));
    assert_eq!(outcome(&four_of_five(81).0, "ro"), Some(Ending::Incomplete));
}

#[test]
fn whom_a_person_keeps_out_was_not_offered_it() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[3];
    rig.must("ro", Verb::Exclude(robot_id(n)));
    rig.until(400, |r| r.phase() == Phase::Completed);
    assert_eq!((rig.step(n), outcome(&rig, "ro")), (Step::Skipped, Some(Ending::Complete)));
}

#[test]
fn a_roll_out_that_was_offered_to_nobody_is_incomplete_and_says_why() {
    let mut rig = Rig::new(3);
    rig.start(spec());
    for n in 0..3 {
        rig.ask(&Command::Pin { robot_id: robot_id(n), reason: "a trade fair".into() }).expect("allowed");
    }
    rig.until(60, |r| r.phase() == Phase::Completed);
    assert_eq!((rig.count(Step::Skipped), outcome(&rig, "ro")), (3, Some(Ending::Incomplete)));
    let told = rig.feed.iter().rfind(|e| &*e.kind == crate::drain_request::INCIDENT).and_then(|e| e.body.as_ref());
    let told: Reason = serde_json::from_str(told.expect("a person is told")).expect("a reason");
    assert_eq!((told.code, told.metadata["offered"].as_str()), (Code::RolloutIncomplete, "0"));
    assert!(told.text().contains("pinned"), "{}", told.text());
}

#[test]
fn whoever_had_the_bundle_already_ends_with_it() {
    let mut rig = Rig::new(4);
    rig.start(RolloutSpec { complete_percent: 100, ..spec() });
    rig.fates(Fate::Refuses(Code::SkippedCurrent));
    rig.until(400, |r| r.phase() == Phase::Completed);
    assert_eq!((rig.count(Step::Skipped), outcome(&rig, "ro")), (4, Some(Ending::Complete)));
    assert_eq!(rig.incidents(), []);
}

#[test]
fn robots_that_are_tried_again_complete_it_and_then_newcomers_get_it() {
    let (mut rig, n) = four_of_five(90);
    assert_eq!(outcome(&rig, "ro"), Some(Ending::Incomplete));
    rig.robots[n].fate = Fate::Good;
    rig.must("ro", Verb::RetryFailed);
    rig.until(100, |r| r.step(n) == Step::Committed);
    assert_eq!(outcome(&rig, "ro"), Some(Ending::Complete));
    rig.arrive();
    rig.until(100, |r| r.robots[5].kept == "2.0.0");
}

#[test]
fn one_that_takes_another_back_is_complete_once_enough_went_back() {
    let mut rig = Rig::new(5);
    rig.start(spec());
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    rig.ask(&Command::Rollback { of: rollout_id("ro"), rollout_id: rollout_id("back") }).expect("allowed");
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("back", verb);
    }
    rig.robots[3].is_off = true;
    rig.until(200, |r| r.rollout("back").phase == Phase::Completed);
    assert_eq!(outcome(&rig, "back"), Some(Ending::Incomplete));
    rig.robots[3].is_off = false;
    rig.until(60, |r| r.robot_in("back", 3).step == Step::RolledBack);
    assert_eq!(outcome(&rig, "back"), Some(Ending::Complete));
}
