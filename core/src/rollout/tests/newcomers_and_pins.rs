//! Robots that come later, and robots that people keep out.

use super::*;

/// A completed roll-out of all that are there.
fn done(rig: &mut Rig, spec: RolloutSpec) {
    rig.start(spec);
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
}

/// The canary may ask to activate and does not; the next robot has the bundle.
fn canary_activating() -> (Rig, usize, usize) {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let (canary, other) = (rig.order()[0], rig.order()[1]);
    rig.robots[canary].fate = Fate::NeverReady;
    rig.until(20, |r| r.step(canary) == Step::Activating && r.step(other) == Step::Staged);
    (rig, canary, other)
}

#[test]
fn who_comes_after_gets_the_bundle_too_one_by_one() {
    let mut rig = Rig::new(4);
    done(&mut rig, spec());
    (0..3).for_each(|_| rig.arrive());
    let mut most = 0;
    for _ in 0..200 {
        rig.tick();
        most = most.max(rig.rollout("ro").in_flight);
    }
    assert_eq!((most, rig.count(Step::Committed)), (1, 7));
    assert!(rig.robots.iter().all(|r| r.version == "2.0.0"));
}

#[test]
fn who_came_while_it_ran_gets_it_when_it_is_completed() {
    let mut rig = Rig::new(4);
    rig.put_row(AreaBundle { area_id: AreaId::parse("quality").expect("an id"), rollouts: BTreeMap::new() });
    rig.start(spec());
    rig.ticks(5);
    rig.arrive();
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.until(100, |r| r.robots[4].kept == "2.0.0");
}

#[test]
fn whom_it_was_not_for_does_not_get_it_for_having_come_again() {
    let mut rig = Rig::new(6);
    let mut only = spec();
    only.selector.labels.insert("line".into(), "even".into());
    done(&mut rig, only);
    rig.attach(1, |_| {});
    rig.ticks(20);
    assert_eq!(rig.robots[1].version, "0.9.0");
    rig.label(1, "line", "even");
    rig.until(100, |r| r.robots[1].kept == "2.0.0");
}

#[test]
fn whom_no_wave_took_is_no_newcomer() {
    let mut rig = Rig::new(6);
    done(&mut rig, RolloutSpec { waves: vec![Wave::Count(1), Wave::Count(2)], ..spec() });
    (0..6).for_each(|n| rig.attach(n, |_| {}));
    rig.ticks(30);
    assert_eq!(rig.robots.iter().filter(|r| r.version == "2.0.0").count(), 3);
}

#[test]
fn a_newcomer_that_fails_is_the_last_and_a_person_is_told() {
    let mut rig = Rig::new(4);
    done(&mut rig, spec());
    (0..3).for_each(|_| rig.arrive());
    rig.fates(Fate::BadAtStart);
    rig.ticks(100);
    let bad = rig.ota.robots.values().filter(|r| r.row.failure.is_some()).count();
    assert_eq!((bad, rig.count(Step::RolledBack), rig.count(Step::Skipped)), (1, 1, 2));
    assert!(rig.incidents().contains(&Code::NewcomerFailed));
    rig.arrive();
    rig.ticks(10);
    assert_eq!(rig.ota.robots_of(&rollout_id("ro")).count(), 7);
}

#[test]
fn newcomers_on_their_way_do_not_get_a_bundle_that_was_taken_back() {
    let mut rig = Rig::new(4);
    done(&mut rig, spec());
    rig.arrive();
    rig.robots[4].fate = Fate::NeverReady;
    rig.until(60, |r| r.count(Step::Activating) == 1);
    rig.ask(&Command::Revoke { bundle: bundle_id(2), reason: "leaks".into() }).expect("allowed");
    rig.robots[4].fate = Fate::Good;
    rig.ticks(10);
    let r = rig.robot_in("ro", 4);
    assert_eq!((r.step, r.attempted, r.why.expect("a reason").code), (Step::Skipped, false, Code::BundleRevoked));
    assert_eq!(rig.rollout("ro").in_flight, 0);
}

#[test]
fn a_newcomer_that_falls_silent_gets_it_when_it_is_back() {
    let mut rig = Rig::new(4);
    done(&mut rig, spec());
    rig.arrive();
    rig.pass(1_000);
    rig.turn();
    rig.robots[4].is_off = true;
    rig.ticks(60);
    rig.robots[4].is_off = false;
    rig.until(100, |r| r.robots[4].kept == "2.0.0");
}

#[test]
fn a_robot_that_is_pinned_stays_at_what_it_runs_however_far_it_is() {
    let (mut rig, canary, other) = canary_activating();
    for n in [canary, other] {
        rig.ask(&Command::Pin { robot_id: robot_id(n), reason: "a trade fair".into() }).expect("allowed");
    }
    rig.until(300, |r| r.phase() == Phase::Completed);
    for n in [canary, other] {
        assert_eq!(rig.robot_in("ro", n).why.expect("a reason").code, Code::SkippedPinned);
        assert_eq!(rig.robots[n].version, "0.9.0");
    }
    assert_eq!(rig.robots.iter().filter(|r| r.version == "2.0.0").count(), 2);
}

#[test]
fn a_robot_that_shows_another_device_key_and_was_not_enrolled_since_gets_nothing_however_far_it_is() {
    let (mut rig, canary, other) = canary_activating();
    for n in [canary, other] {
        rig.shows_another_key(n);
    }
    rig.until(300, |r| r.phase() == Phase::Completed);
    for n in [canary, other] {
        let why = rig.robot_in("ro", n).why.expect("a reason");
        assert_eq!((why.code, why.metadata["device_key"].as_str()), (Code::SkippedOtherKey, &*"ab".repeat(32)));
        assert_eq!(rig.robots[n].version, "0.9.0");
    }
    assert_eq!(rig.robots.iter().filter(|r| r.version == "2.0.0").count(), 2);
}

#[test]
fn another_device_key_that_a_person_took_keeps_a_robot_from_nothing() {
    let mut rig = Rig::new(4);
    for n in 0..4 {
        let device_key = rig.shows_another_key(n);
        rig.tick();
        let command = Command::AcceptKey { robot_id: robot_id(n), device_key };
        rig.ask(&command).expect("allowed");
    }
    rig.start(spec());
    rig.until(300, |r| r.phase() == Phase::Completed);
    assert!(rig.robots.iter().all(|r| r.version == "2.0.0"));
}

#[test]
fn an_excluded_robot_is_left_out_and_somebody_stands_in() {
    let mut rig = Rig::new(4);
    rig.fleet_sleeps = true;
    rig.start(RolloutSpec { small_wave: crate::rollout::projection::spec::SmallWave::Review, ..spec() });
    let n = rig.order()[0];
    rig.must("ro", Verb::Pause);
    rig.ticks(2);
    rig.must("ro", Verb::Exclude(robot_id(n)));
    assert!(rig.verb("ro", Verb::Exclude(robot_id(n))).expect("done before"));
    rig.fleet_sleeps = false;
    rig.must("ro", Verb::Resume);
    rig.until(60, |r| r.phase() == Phase::Review);
    assert_eq!(rig.robot_in("ro", n).why.expect("a reason").code, Code::SkippedExcluded);
    assert_eq!((rig.rollout("ro").wave, rig.count(Step::Trial)), (0, 1));
}

#[test]
fn a_quarantined_robot_gets_it_again_only_after_a_person_has_looked() {
    let (mut rig, n) = canary_on_trial();
    rig.goes_back(n, Some(Code::BreakerOnTrial));
    rig.until(60, |r| r.phase() == Phase::Aborted);
    done_as(&mut rig, "next");
    assert_eq!(rig.robots[n].version, "0.9.0");
    let lift = Command::LiftQuarantine { robot_id: robot_id(n), bundle: bundle_id(2) };
    rig.ask(&lift).expect("allowed");
    assert_eq!(rig.ask(&lift).expect_err("it is gone").reason.code, Code::QuarantineNotFound);
    rig.until(100, |r| r.robots[n].kept == "2.0.0");
}

fn done_as(rig: &mut Rig, id: &str) {
    rig.start_as(id, spec(), false);
    rig.until(400, |r| r.rollout(id).phase == Phase::Completed);
    rig.ticks(4);
}

#[test]
fn a_retired_robot_gives_its_drain_back_and_is_waited_for_by_nobody() {
    let mut rig = Rig::new(6);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Dawdles;
    rig.until(20, |r| r.robot_in("ro", n).grant.is_some());
    rig.robots[n].is_off = true;
    rig.retire(n);
    rig.ticks(2);
    assert_eq!(rig.releases(), [ReleasedBy::Retired]);
    assert_eq!(rig.robot_in("ro", n).why.expect("a reason").code, Code::SkippedRetired);
    rig.until(300, |r| r.phase() == Phase::Completed);
}

#[test]
fn since_when_a_robot_was_heard_is_forgotten_with_the_robot() {
    let mut rig = Rig::new(3);
    rig.ticks(3);
    assert_eq!(rig.ota.contacts.len(), 3);
    rig.board.remove(&robot_id(0));
    rig.retire(1);
    rig.ota_turn();
    let board = rig.board.clone();
    rig.ota.forget_contacts(&board);
    assert_eq!(rig.ota.contacts.keys().collect::<Vec<_>>(), [&robot_id(2)]);
}
