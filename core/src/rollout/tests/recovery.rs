//! The service dies, hears twice, or hears late.

use super::*;

#[test]
fn what_meant_nothing_when_it_was_said_means_nothing_after_a_restart() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Dawdles;
    rig.until(20, |r| r.robot_in("ro", n).grant.is_some());
    // The old software has a fault that the new one must not have.
    let fault = Fault { code: 66, class: crate::robot::FaultClass::Recoverable, message: String::new() };
    rig.say_event(n, RobotEvent::Fault { fault, cleared: false });
    // Within the same second a heartbeat says that the new one runs.
    let report = rig.robots[n].report.clone().expect("an update");
    rig.robots[n].report = Some(UpdateReport { state: UpdateState::Trial, ..report });
    rig.ota_turn();
    rig.beat(n);
    rig.ota_turn();
    assert_eq!(rig.step(n), Step::Trial);
    rig.restart();
    rig.ota_turn();
    assert_eq!(rig.robot_in("ro", n).failure, None);
    assert_eq!(rig.rollout("ro").abort, None);
}

#[test]
fn a_heartbeat_that_is_older_than_what_the_robot_said_since_changes_nothing() {
    let (mut rig, n) = canary_on_trial();
    rig.beat(n);
    rig.report(n, UpdateState::RolledBack);
    rig.ota_turn();
    let software: RobotSoftware = rig.row(robot_id(n).as_str()).expect("a row");
    assert_eq!(software.report.expect("a report").state, UpdateState::RolledBack);
    assert_eq!(software.on_trial, None);
}

#[test]
fn a_restart_after_every_turn_changes_nothing_of_the_end() {
    let mut rig = Rig::new(6);
    rig.start(spec());
    for _ in 0..300 {
        rig.tick();
        rig.restart();
        if rig.phase() == Phase::Completed {
            break;
        }
    }
    rig.ticks(3);
    assert_eq!(rig.phase(), Phase::Completed);
    assert!(rig.robots.iter().all(|r| r.version == "2.0.0"));
    assert_eq!(rig.count(Step::Committed), 6);
}

#[test]
fn a_start_that_was_cut_short_reaches_all_robots_all_the_same() {
    let mut rig = Rig::new(200);
    rig.checks_rebuild = false;
    rig.create("ro", RolloutSpec { waves: vec![Wave::Count(1), Wave::Rest], ..spec() });
    rig.must("ro", Verb::Submit);
    rig.must("ro", Verb::Approve);
    let command =
        Command::Do { rollout_id: rollout_id("ro"), verb: Verb::Start { supersede: false }, reason: String::new() };
    let mut plan = Plan::default();
    carry_out(&mut rig.ota, &rig.board, rig.now, &command, &"ana".into(), &mut plan);
    assert_eq!(plan.items.len(), 2, "the second was never written");
    plan.items.truncate(1);
    rig.commit(plan.items);
    rig.restart();
    rig.ticks(4);
    assert_eq!(rig.ota.robots_of(&rollout_id("ro")).count(), 200);
}

#[test]
fn an_entry_that_the_store_never_takes_is_passed_over_once_and_a_person_is_told() {
    let mut rig = Rig::new(3);
    rig.start(RolloutSpec { waves: vec![Wave::Count(1), Wave::Rest], ..spec() });
    let n = rig.order()[0];
    rig.until(60, |r| r.step(n) == Step::Trial);
    rig.goes_back(n, Some(Code::BreakerOnTrial));
    let seq = Seq(rig.seq);
    rig.feed.iter().rfind(|e| e.log == Log::RobotInbox && e.seq <= seq).inspect(|e| {
        rig.ota.unusable.insert(e.seq);
    });
    rig.ota_turn();
    assert_eq!(rig.incidents(), [Code::EntryPassedOver]);
    rig.restart();
    rig.ota_turn();
    assert_eq!(rig.incidents(), [Code::EntryPassedOver], "it is behind the mark");
}
