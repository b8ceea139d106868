//! What was skipped is tried once more, what was completed can be taken back.

use super::*;

#[test]
fn who_was_skipped_is_tried_once_more_at_the_end_and_then_it_is_final() {
    let mut rig = Rig::new(6);
    rig.create("ro", spec());
    rig.robots[1].is_off = true;
    rig.robots[2].is_off = true;
    rig.ticks(40);
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("ro", verb);
    }
    rig.until(200, |r| r.rollout("ro").wave == 1 && r.phase() == Phase::Soaking);
    rig.robots[1].is_off = false;
    rig.until(300, |r| r.phase() == Phase::Completed);
    rig.ticks(5);
    assert_eq!(rig.robot_in("ro", 1).step, Step::Committed);
    assert!(rig.robot_in("ro", 1).again);
    let r = rig.robot_in("ro", 2);
    assert_eq!((r.step, r.why.expect("a reason").code, r.again), (Step::Skipped, Code::SkippedOffline, true));
    rig.robots[2].is_off = false;
    rig.ticks(20);
    assert_eq!(rig.robot_in("ro", 2).step, Step::Skipped, "it is final");
}

#[test]
fn when_nobody_was_there_the_second_pass_begins_with_a_canary_again() {
    let mut rig = Rig::new(8);
    rig.create("ro", spec());
    rig.must("ro", Verb::Submit);
    rig.must("ro", Verb::Approve);
    rig.robots.iter_mut().for_each(|r| r.is_off = true);
    rig.ticks(40);
    rig.must("ro", Verb::Start { supersede: false });
    rig.until(60, |r| r.rollout("ro").second_pass);
    rig.robots.iter_mut().for_each(|r| r.is_off = false);
    rig.fates(Fate::BadAtStart);
    // They come back in the same second.
    rig.pass(0);
    rig.until(200, |r| r.phase() == Phase::Aborted || r.phase() == Phase::Completed);
    let attempted = rig.ota.robots.values().filter(|r| r.row.attempted).count();
    assert!(attempted <= 1, "{attempted} of 8 met a bad bundle");
}

#[test]
fn a_completed_roll_out_is_taken_back_by_another() {
    let mut rig = Rig::new(5);
    rig.start(RolloutSpec { max_in_flight: Some(1), ..spec() });
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    let back = Command::Rollback { of: rollout_id("ro"), rollout_id: rollout_id("back") };
    rig.ask(&back).expect("allowed");
    assert!(rig.ask(&back).expect("done before"));
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("back", verb);
    }
    // One is not heard: it keeps nobody, and goes back when it comes.
    rig.robots[3].is_off = true;
    rig.until(200, |r| r.rollout("back").phase == Phase::Completed);
    assert_eq!(rig.robots.iter().filter(|r| r.version == "0.9.0").count(), 4);
    assert!(rig.ota.area_bundles.values().all(|a| a.row.rollouts.is_empty()), "newcomers do not get it");
    assert!(rig.ota.quarantines.is_empty());
    rig.robots[3].is_off = false;
    rig.until(60, |r| r.robot_in("back", 3).step == Step::RolledBack);
    assert_eq!(rig.robots[3].version, "0.9.0");
    let software: RobotSoftware = rig.row(robot_id(0).as_str()).expect("a row");
    assert_eq!((software.committed, software.on_trial), (None, None));
}

#[test]
fn what_cannot_be_gone_back_from_is_not_rolled_back() {
    let mut rig = Rig::new(3);
    rig.put_row(Bundle { is_irreversible: true, ..bundle(2) });
    rig.start(spec());
    rig.until(200, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    let back = Command::Rollback { of: rollout_id("ro"), rollout_id: rollout_id("back") };
    assert_eq!(rig.ask(&back).expect_err("refused").reason.code, Code::NothingToRevert);
}

#[test]
fn failed_and_skipped_robots_are_retried_one_by_one_and_their_quarantine_is_lifted() {
    let mut rig = Rig::new(16);
    let waves = vec![Wave::Count(12), Wave::Rest];
    rig.start(RolloutSpec { waves, allow_full_push: true, ..spec() });
    let n = rig.order()[14];
    rig.until(200, |r| r.rollout("ro").wave == 1 && r.step(n) == Step::Trial);
    rig.goes_back(n, Some(Code::BreakerOnTrial));
    // One of 16 proves neither.
    rig.until(60, |r| r.phase() == Phase::Review);
    rig.must("ro", Verb::Promote);
    rig.until(60, |r| r.phase() == Phase::Completed);
    assert_eq!(rig.step(n), Step::RolledBack);
    assert_eq!(rig.ota.quarantines.len(), 1);
    rig.must("ro", Verb::RetryFailed);
    assert_eq!(rig.robot_in("ro", n).why.map(|w| (w.code, w.message)), Some((Code::RetriedByPerson, "because".into())));
    assert!(rig.ota.quarantines.is_empty());
    rig.until(100, |r| r.step(n) == Step::Committed);
    assert_eq!(rig.robots[n].version, "2.0.0");
    assert!(rig.verb("ro", Verb::RetryFailed).is_err(), "nobody is left");
}
