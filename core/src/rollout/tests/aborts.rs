//! The way back: who goes, who stays, and that nothing takes an abort back.

use super::*;
use crate::rollout::projection::spec::AbortScope;

#[test]
fn a_bad_bundle_never_gets_past_its_canary_and_everybody_is_back() {
    for fate in [Fate::BadAtStart, Fate::Silent] {
        let mut rig = Rig::new(8);
        rig.fates(fate);
        rig.start(spec());
        rig.until(400, |r| r.phase().goes_back());
        let abort = rig.rollout("ro").abort.expect("its evidence");
        assert_eq!(abort.touched, 1, "{fate:?}");
        rig.robots.iter_mut().for_each(|r| r.is_off = false);
        rig.until(400, |r| r.phase() == Phase::Aborted && r.rollout("ro").in_flight == 0);
        assert_eq!(rig.ota.robots.values().filter(|r| r.row.attempted).count(), 1);
        assert!(rig.robots.iter().all(|r| r.version == "0.9.0"), "{fate:?}");
        assert_eq!(rig.rollout("ro").abort.expect("it stands"), abort, "nothing takes it back");
    }
}

/// A roll-out of which wave 0 has committed and wave 1 is on trial.
fn half(scope: AbortScope, irreversible: bool) -> Rig {
    let mut rig = Rig::new(6);
    rig.put_row(Bundle { is_irreversible: irreversible, ..bundle(2) });
    rig.start(RolloutSpec { abort_scope: scope, soak_ms: 20_000, ..spec() });
    rig.until(200, |r| r.rollout("ro").wave == 1 && r.phase() == Phase::Soaking);
    assert_eq!((rig.count(Step::Committed), rig.count(Step::Trial)), (1, 5));
    rig
}

#[test]
fn an_abort_takes_back_all_that_was_touched_or_only_who_is_on_trial() {
    for (scope, irreversible, back) in
        [(AbortScope::All, false, 6), (AbortScope::Trial, false, 5), (AbortScope::All, true, 5)]
    {
        let mut rig = half(scope, irreversible);
        rig.must("ro", Verb::Abort);
        rig.until(100, |r| r.phase() == Phase::Aborted);
        assert_eq!(rig.count(Step::RolledBack), back, "{scope:?} {irreversible}");
        assert_eq!(rig.robots.iter().filter(|r| r.version == "0.9.0").count(), back);
        assert!(rig.ota.quarantines.is_empty(), "a person's abort accuses no robot");
    }
}

#[test]
fn what_cannot_be_gone_back_from_is_kept_also_while_it_is_being_committed() {
    let mut rig = Rig::new(4);
    rig.put_row(Bundle { is_irreversible: true, ..bundle(2) });
    rig.start(spec());
    rig.until(100, |r| r.count(Step::Committing) == 1);
    rig.must("ro", Verb::Abort);
    rig.until(100, |r| r.phase() == Phase::Aborted);
    assert_eq!((rig.count(Step::Committed), rig.count(Step::Reverting)), (1, 0));
}

#[test]
fn after_a_hard_stop_robots_leave_work_at_once_and_after_a_number_as_the_budget_allows() {
    for hard in [true, false] {
        let mut rig = half(AbortScope::All, false);
        rig.fleet_sleeps = true;
        if hard {
            let class = crate::robot::FaultClass::Recoverable;
            let n = rig.order()[3];
            rig.say_event(
                n,
                RobotEvent::Fault { fault: Fault { code: 66, class, message: String::new() }, cleared: false },
            );
        } else {
            rig.verb("ro", Verb::Abort).expect("allowed");
        }
        rig.ticks(3);
        assert_eq!(rig.ota.requests.values().filter(|r| r.row.urgent).count(), if hard { 6 } else { 0 });
        assert_eq!(rig.ota.requests.len(), 6);
    }
}

#[test]
fn whoever_is_not_heard_at_an_abort_goes_back_before_it_works_again() {
    let mut rig = half(AbortScope::All, false);
    let n = rig.order()[3];
    rig.robots[n].is_off = true;
    rig.ticks(40);
    if !rig.phase().goes_back() {
        rig.verb("ro", Verb::Abort).expect("allowed");
    }
    rig.until(100, |r| r.phase() == Phase::Aborted);
    assert_eq!(rig.step(n), Step::Reverting, "nobody waits for it");
    assert!(rig.ota.requests.values().any(|r| r.row.robot_id == robot_id(n) && r.row.urgent));
    rig.robots[n].is_off = false;
    rig.until(30, |r| r.step(n) == Step::RolledBack);
    assert_eq!(rig.robots[n].version, "0.9.0");
    assert_eq!(rig.rollout("ro").in_flight, 0);
}

#[test]
fn robots_that_are_stopped_go_back_where_they_stand() {
    let mut rig = half(AbortScope::All, false);
    rig.robots.iter_mut().for_each(|r| {
        r.stop = HardwareStop::Manual;
        // In a lane, where no drain may hold it.
        r.at = "j11";
    });
    rig.fleet_sleeps = true;
    rig.must("ro", Verb::Abort);
    rig.ticks(12);
    assert_eq!(rig.count(Step::RolledBack), 6);
}

#[test]
fn a_robot_that_cannot_go_back_is_shown_keeps_its_drain_and_keeps_nobody_waiting() {
    let mut rig = half(AbortScope::All, false);
    let n = rig.order()[3];
    rig.report(n, UpdateState::Stuck);
    rig.robots[n].fate = Fate::Probation;
    rig.until(100, |r| r.phase() == Phase::Aborted);
    assert_eq!(rig.rollout("ro").abort.expect("latched").reason.code, Code::RollbackFailed);
    assert_eq!(rig.step(n), Step::Stuck);
    assert!(rig.incidents().contains(&Code::RollbackFailed));
    rig.report(n, UpdateState::RolledBack);
    rig.tick();
    assert_eq!(rig.step(n), Step::RolledBack, "somebody mended it");
}

#[test]
fn an_abort_before_the_start_just_ends_it() {
    let mut rig = Rig::new(2);
    rig.create("ro", spec());
    rig.must("ro", Verb::Abort);
    rig.ticks(3);
    assert_eq!(rig.phase(), Phase::Aborted);
    assert!(rig.verb("ro", Verb::Abort).expect("it was done"), "asked twice it is done once");
}

/// Nobody is heard any more since this canary is on probation, for longer than makes a robot lost.
fn all_dark_on_probation() -> (Rig, usize) {
    let mut rig = Rig::new(6);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Probation;
    rig.until(60, |r| r.robot_in("ro", n).moments.switched.is_some());
    rig.robots.iter_mut().for_each(|r| r.is_off = true);
    rig.ticks(310);
    (rig, n)
}

#[test]
fn a_silent_network_pauses_and_is_nobodys_failure() {
    let (mut rig, n) = all_dark_on_probation();
    assert!(rig.rollout("ro").pauses.contains(&crate::rollout::projection::rows::Pause::Infrastructure));
    assert_eq!(rig.robot_in("ro", n).failure, None);
    rig.robots.iter_mut().for_each(|r| (r.is_off, r.fate) = (false, Fate::Good));
    rig.until(300, |r| r.phase() == Phase::Completed);
    assert!(rig.ota.quarantines.is_empty());
}

#[test]
fn a_network_that_comes_back_for_the_others_first_burns_no_bundle() {
    let (mut rig, n) = all_dark_on_probation();
    for other in (0..6).filter(|other| *other != n) {
        rig.robots[other].is_off = false;
        rig.robots[other].epoch = rig.now.wall.0 as u64;
        rig.attach(other, |_| {});
    }
    rig.ticks(2);
    assert!(rig.rollout("ro").pauses.contains(&crate::rollout::projection::rows::Pause::Infrastructure));
    assert_eq!(rig.robot_in("ro", n).failure, None, "they were missed as long as it was");
    rig.until(600, |r| r.robot_in("ro", n).failure.is_some());
    assert_eq!(
        rig.robot_in("ro", n).failure.map(|f| f.code),
        Some(Code::RobotLost),
        "the others keep contact and it does not come"
    );
}

#[test]
fn too_few_others_to_compare_with_pause_it_too() {
    let mut rig = Rig::new(3);
    rig.fates(Fate::Silent);
    rig.start(spec());
    rig.ticks(330);
    assert!(rig.rollout("ro").pauses.contains(&crate::rollout::projection::rows::Pause::InfrastructureUnknown));
}

#[test]
fn a_lost_robot_is_taken_back_until_the_gate_of_its_wave_closes() {
    let review = crate::rollout::projection::spec::SmallWaveFailure::Review;
    for late in [false, true] {
        let mut rig = Rig::new(16);
        rig.start(RolloutSpec {
            waves: vec![Wave::Count(2), Wave::Count(4), Wave::Rest],
            allow_full_push: true,
            small_wave_failure: review,
            ..spec()
        });
        let n = rig.order()[0];
        rig.robots[n].fate = Fate::Silent;
        rig.until(600, |r| r.robot_in("ro", n).failure.is_some());
        assert_eq!(rig.robot_in("ro", n).failure.expect("lost").code, Code::RobotLost);
        if late {
            // The wave goes on without it to its gate, and a person promotes it.
            rig.until(100, |r| r.phase() == Phase::Review);
            rig.must("ro", Verb::Promote);
        }
        rig.robots[n].fate = Fate::Good;
        rig.robots[n].is_off = false;
        let set = rig.robots[n].report.clone().expect("an update");
        rig.robots[n].version = "2.0.0".into();
        rig.attach(n, |_| {});
        let grant_id = rig.robots[n].seen_grant;
        rig.report_update(n, UpdateReport { state: UpdateState::Probation, grant_id, ..set });
        rig.ticks(2);
        assert_eq!(rig.robot_in("ro", n).failure.is_some(), late);
        if late {
            rig.until(60, |r| r.step(n) == Step::RolledBack);
        } else {
            rig.until(600, |r| r.phase() == Phase::Completed);
        }
    }
}

#[test]
fn a_robot_that_goes_dark_on_trial_is_never_called_clean_and_counts_as_lost_if_others_are_heard() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { exposure_tasks: 0, ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.step(n) == Step::Trial);
    rig.robots[n].is_off = true;
    rig.until(600, |r| r.phase().goes_back());
    let row = rig.rollout("ro");
    assert_eq!((row.promoted, row.abort.map(|a| a.robots)), (0, Some(vec![robot_id(n)])));
    assert_eq!(rig.robot_in("ro", n).failure.expect("lost").code, Code::RobotLost);
    assert!(rig.order()[1..].iter().all(|other| !rig.robot_in("ro", *other).attempted), "nobody came behind it");
}

#[test]
fn a_robot_that_was_dark_for_a_while_on_trial_is_waited_for_at_the_gate() {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { exposure_tasks: 0, ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.step(n) == Step::Trial);
    rig.robots[n].is_off = true;
    rig.until(60, |r| r.phase() == Phase::Gate);
    rig.ticks(20);
    assert_eq!(rig.phase(), Phase::Gate);
    rig.robots[n].is_off = false;
    rig.until(300, |r| r.phase() == Phase::Completed);
}

#[test]
fn robots_that_were_off_before_say_nothing_of_the_network() {
    let mut rig = Rig::new(8);
    rig.retire(7);
    for off in [4, 5, 6, 7] {
        rig.robots[off].is_off = true;
    }
    rig.ticks(60);
    let mut four = spec();
    four.selector.robots.extend((0..4).map(robot_id));
    rig.start(four);
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Silent;
    rig.until(600, |r| r.phase().goes_back());
    assert_eq!(rig.robot_in("ro", n).failure.expect("lost").code, Code::RobotLost);
}

#[test]
fn a_robot_that_did_not_reach_its_server_burns_no_bundle_unless_it_was_lost_alone() {
    for alone in [false, true] {
        let mut rig = Rig::new(6);
        rig.start(spec());
        let n = rig.order()[0];
        rig.robots[n].fate = Fate::Silent;
        if alone {
            rig.until(600, |r| r.robot_in("ro", n).failure.is_some());
        } else {
            rig.until(60, |r| r.step(n) == Step::Activating && r.robot_in("ro", n).grant.is_some());
            rig.ticks(20);
        }
        rig.robots[n].is_off = false;
        rig.goes_back(n, Some(Code::LostServer));
        rig.until(60, |r| r.step(n) == Step::RolledBack);
        assert_eq!((rig.robot_in("ro", n).failure.is_some(), !rig.ota.quarantines.is_empty()), (alone, alone));
    }
}

#[test]
fn an_abort_waits_for_permissions_on_the_link_clock_however_fast_the_site_is() {
    let mut rig = Rig::new(6);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Silent;
    rig.until(20, |r| r.robot_in("ro", n).grant.is_some());
    rig.robots[n].is_off = true;
    rig.must("ro", Verb::Abort);
    // Ten minutes of the site in a second of the link.
    rig.now.site.0 += 600_000;
    rig.now.utc = rig.now.utc.plus_ms(600_000);
    rig.tick();
    assert_eq!((rig.phase(), rig.robot_in("ro", n).step), (Phase::Aborting, Step::Activating));
    rig.ticks(50);
    assert_eq!(rig.phase(), Phase::Aborting);
    rig.until(20, |r| r.phase() != Phase::Aborting);
    assert_eq!(rig.robot_in("ro", n).step, Step::Activating, "it keeps its drain");
}
