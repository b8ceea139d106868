//! Robots that fetch a bundle while they work, and those that cannot be had when their turn comes.

use super::*;

#[test]
fn all_robots_fetch_before_the_first_is_taken_out_of_work() {
    let mut rig = Rig::new(6);
    rig.fleet_sleeps = true;
    rig.start(spec());
    rig.ticks(3);
    assert_eq!(rig.count(Step::Staged), 5);
    assert_eq!(rig.count(Step::Draining), 1);
}

#[test]
fn a_canary_that_is_not_heard_is_replaced_by_the_next_robot() {
    let mut rig = Rig::new(6);
    rig.create("ro", spec());
    rig.must("ro", Verb::Submit);
    rig.must("ro", Verb::Approve);
    let canary =
        crate::rollout::members::matching::find_members(&rig.ota, &rig.board, &rig.rollout("ro")).0[0].0.clone();
    let n: usize = canary.as_str()[1..].parse().expect("a number");
    rig.robots[n].is_off = true;
    rig.ticks(40);
    rig.must("ro", Verb::Start { supersede: false });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    assert_eq!(rig.robot_in("ro", n).why.expect("a reason").code, Code::SkippedOffline);
    let first = |r: &&RolloutRobot| r.wave == 0 && r.step == Step::Trial;
    assert_eq!(rig.ota.robots_of(&rollout_id("ro")).filter(first).count(), 1);
}

#[test]
fn a_robot_that_was_told_and_falls_silent_before_its_drain_is_skipped_and_not_drained() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { soak_ms: 60_000, ..spec() });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    let n = rig.order()[1];
    assert_eq!(rig.step(n), Step::Staged);
    rig.robots[n].is_off = true;
    rig.until(200, |r| r.rollout("ro").wave == 1 && r.phase() == Phase::Soaking);
    assert_eq!(rig.robot_in("ro", n).why.expect("a reason").code, Code::SkippedOffline);
    assert!(rig.robot_in("ro", n).moments.asked.is_none());
}

#[test]
fn a_robot_that_gets_no_bytes_is_passed_over_after_its_time_and_pauses_do_not_count() {
    let mut rig = Rig::new(4);
    rig.checks_rebuild = false;
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::NoBytes;
    rig.tick();
    // Its staging was told, and it is waited for in the wave once all others have it.
    rig.report(n, UpdateState::Downloading);
    let limit = crate::limits::STAGED_WITHIN.as_ms();
    let wait = |rig: &mut Rig, ms: u64| {
        rig.pass(ms);
        rig.turn();
    };
    wait(&mut rig, limit);
    rig.tick();
    assert_eq!(rig.phase(), Phase::Applying);
    rig.must("ro", Verb::Pause);
    wait(&mut rig, 2 * limit);
    rig.must("ro", Verb::Resume);
    wait(&mut rig, limit - 60_000);
    assert_eq!(rig.step(n), Step::Staging, "it stood still for all but that");
    wait(&mut rig, 60_000);
    rig.tick();
    assert_eq!(rig.robot_in("ro", n).why.expect("a reason").code, Code::SkippedStuck);
}

#[test]
fn a_robot_that_refuses_the_bundle_is_left_out_and_not_tried_again() {
    let mut rig = Rig::new(5);
    rig.create("ro", spec());
    rig.robots[2].fate = Fate::Unfit;
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("ro", verb);
    }
    rig.until(400, |r| r.phase() == Phase::Completed);
    let r = rig.robot_in("ro", 2);
    assert_eq!((r.step, r.why.expect("a reason").code, r.again), (Step::Skipped, Code::BundleUnfit, false));
    assert!(!rig.rollout("ro").second_pass);
}

/// A roll-out whose robot 2 refuses for this reason, at its end.
fn refused_for(code: Code) -> Rig {
    let mut rig = Rig::new(5);
    rig.create("ro", spec());
    rig.robots[2].fate = Fate::Refuses(code);
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("ro", verb);
    }
    rig.until(400, |r| r.phase() == Phase::Completed);
    let r = rig.robot_in("ro", 2);
    assert_eq!((r.step, r.why.map(|why| why.code), r.attempted), (Step::Skipped, Some(code), false));
    rig
}

#[test]
fn a_refusal_keeps_its_own_reason_and_one_that_may_pass_is_asked_once_more_at_the_end() {
    for code in [Code::NoRoom, Code::BaseTooSoon, Code::MetadataRefused] {
        let rig = refused_for(code);
        assert_eq!((rig.rollout("ro").second_pass, rig.robot_in("ro", 2).again), (true, true), "{code:?}");
    }
    for code in [Code::BundleUnfit, Code::BundleCorrupt] {
        let rig = refused_for(code);
        assert_eq!((rig.rollout("ro").second_pass, rig.robot_in("ro", 2).again), (false, false), "{code:?}");
    }
}

#[test]
fn a_robot_whose_base_came_too_soon_is_asked_again_after_its_wait_and_in_no_wave_that_was_judged() {
    const WAIT_MS: u64 = 30_000;
    let waves = vec![Wave::Count(1), Wave::Count(1), Wave::Count(1), Wave::Rest];
    let mut rig = Rig::new(7);
    rig.start(RolloutSpec { waves, soak_ms: 20_000, ..spec() });
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::NoBytes;
    rig.tick();
    let reason = Some(Reason::from(Code::BaseTooSoon).with("wait_ms", WAIT_MS));
    let told = rig.robots[n].report.clone().expect("an update");
    rig.report_update(n, UpdateReport { state: UpdateState::Refused, reason, ..told });
    rig.robots[n].fate = Fate::Good;
    rig.until(10, |r| r.step(n) == Step::Skipped);
    let skipped = rig.now.utc;
    rig.until(400, |r| r.step(n) != Step::Skipped);
    assert!(rig.now.utc.ms_since(skipped) >= WAIT_MS, "not before");
    let (r, rollout) = (rig.robot_in("ro", n), rig.rollout("ro"));
    assert_eq!((r.again, r.wave, rollout.phase, rollout.second_pass), (true, rollout.wave, Phase::Applying, false));
    assert!((1..=3).contains(&r.wave), "wave {}", r.wave);
    rig.until(400, |r| r.phase() == Phase::Completed);
    assert_eq!((rig.step(n), rig.rollout("ro").second_pass), (Step::Committed, false));
}

#[test]
fn a_robot_that_has_the_bundle_already_is_left_alone_and_known_to_have_it() {
    let rig = refused_for(Code::SkippedCurrent);
    assert!(!rig.rollout("ro").second_pass);
    assert_eq!(rig.robot_in("ro", 2).moments.asked, None, "it was not taken out of work");
    assert_eq!(rig.ota.software_of(&robot_id(2)).committed, Some(bundle_id(2)));
}

#[test]
fn robots_that_another_roll_out_keeps_for_ever_are_passed_over() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(400, |r| r.phase() == Phase::Completed);
    // One never says that it has committed.
    let n = rig.order()[2];
    let mut kept = rig.robot_in("ro", n);
    kept.step = Step::Committing;
    rig.put_row(kept);
    rig.report(n, UpdateState::Trial);
    rig.robots[n].report = None;
    rig.checks_rebuild = false;
    rig.start_as("next", RolloutSpec { bundle: bundle_id(3), ..spec() }, false);
    rig.ticks(60);
    rig.pass(crate::limits::STAGED_WITHIN.as_ms());
    rig.turn();
    rig.ticks(60);
    rig.pass(crate::limits::STAGED_WITHIN.as_ms());
    rig.turn();
    rig.ticks(100);
    rig.pass(crate::limits::STAGED_WITHIN.as_ms());
    rig.turn();
    rig.until(200, |r| r.rollout("next").phase == Phase::Completed);
    assert_eq!(rig.robot_in("next", n).why.expect("a reason").code, Code::SkippedBusy);
}
