//! Robots that fall silent out of work: who is named, who is told, and what they count for.

use super::*;
use crate::rollout::explain;
use crate::rollout::projection::spec::SmallWaveFailure;

/// Twelve robots change, of which one may be out of work. The first of them is silent from its switch on, and the
/// others wait for it.
fn silent(change: impl FnOnce(&mut RolloutSpec)) -> (Rig, usize) {
    let mut rig = Rig::new(12);
    rig.rules(|s| s.off_work_permille = 100);
    rig.fates(Fate::Silent);
    let mut wide = RolloutSpec {
        waves: vec![Wave::Rest],
        allow_full_push: true,
        small_wave_failure: SmallWaveFailure::Review,
        lost_after_ms: 60_000,
        ..spec()
    };
    change(&mut wide);
    rig.start(wide);
    rig.until(60, |r| r.robots.iter().any(|robot| robot.is_off));
    let first = rig.robots.iter().position(|robot| robot.is_off).expect("one is silent");
    rig.fates(Fate::Good);
    (rig, first)
}

/// What the robot waits for.
fn waits(rig: &Rig, n: usize) -> explain::Blocked {
    let (rollout, r) = (rig.rollout("ro"), rig.robot_in("ro", n));
    explain::blocked(&rig.ota, &rig.board, &rig.now, &rollout, &r).expect("it waits")
}

fn told(rig: &Rig) -> usize {
    rig.incidents().into_iter().filter(|code| *code == Code::BlockedBySilence).count()
}

fn write_off(first: usize) -> Verb {
    Verb::WriteOff(robot_id(first))
}

#[test]
fn a_lost_robot_is_named_and_told_of_and_counts_for_nobody_once_a_person_says_so() {
    let (mut rig, first) = silent(|_| {});
    let other = (first + 1) % 12;
    rig.ticks(35);
    let by = waits(&rig, other).by;
    let held_by = format!("{} (not heard)", robot_id(first));
    assert_eq!((by.code, by.metadata.get("held_by")), (Code::BlockedByBudget, Some(&held_by)));
    assert!(by.text().contains(&held_by), "{}", by.text());
    let silence = waits(&rig, first);
    assert_eq!(silence.by.code, Code::BlockedBySilence);
    assert!(silence.deadline.is_some() && silence.since < rig.now.utc, "{silence:?}");
    assert_eq!(rig.verb("ro", write_off(first)).expect_err("not yet").reason.code, Code::RobotNotLost);
    rig.until(40, |r| r.robot_in("ro", first).lost.is_some());
    rig.ticks(5);
    assert_eq!((told(&rig), waits(&rig, first).deadline), (1, None));
    assert_eq!((rig.count(Step::Draining), rig.rollout("ro").in_flight), (11, 12), "time alone frees nothing");
    assert_eq!(rig.verb("ro", write_off(other)).expect_err("it is heard").reason.code, Code::RobotNotLost);
    rig.must("ro", write_off(first));
    assert!(rig.verb("ro", write_off(first)).expect("allowed"), "it was done before");
    assert_eq!(rig.rollout("ro").in_flight, 11);
    rig.until(200, |r| r.count(Step::Trial) == 11);
    assert!(rig.robot_in("ro", first).drain_id.is_some(), "it may still be about to change");
    rig.robots[first].is_off = false;
    rig.ticks(2);
    assert_eq!((rig.robot_in("ro", first).lost, told(&rig)), (None, 1));
}

#[test]
fn the_policy_of_a_roll_out_may_write_lost_robots_off_and_a_person_is_told_all_the_same() {
    let (mut rig, first) = silent(|s| s.writes_off_lost = true);
    rig.until(80, |r| r.robot_in("ro", first).lost.is_some());
    let lost = rig.robot_in("ro", first).lost.expect("lost");
    assert_eq!(lost.written_off.map(|act| act.actor), Some("ota".to_owned()));
    assert_eq!((told(&rig), rig.rollout("ro").in_flight), (1, 11));
    rig.until(200, |r| r.count(Step::Trial) == 11);
}

#[test]
fn a_robot_that_was_written_off_counts_again_when_it_is_heard() {
    let (mut rig, first) = silent(|s| s.writes_off_lost = true);
    rig.until(80, |r| r.robot_in("ro", first).lost.is_some());
    rig.robots[first].fate = Fate::Dawdles;
    rig.robots[first].is_off = false;
    rig.ota_turn();
    rig.pass(1_000);
    rig.turn();
    assert_eq!(rig.robot_in("ro", first).lost, None);
    let drain_id = rig.robot_in("ro", first).drain_id.expect("its drain");
    assert!(!rig.ota.requests[drain_id.as_str()].row.written_off);
    let row: fleet::rows::AreaBudget = rig.row("hall").expect("a row");
    assert!(row.off_work.contains(&robot_id(first)), "{row:?}");
}

#[test]
fn a_robot_that_was_written_off_counts_in_its_area_before_its_roll_out_has_looked_again() {
    let (mut rig, first) = silent(|s| s.writes_off_lost = true);
    rig.until(80, |r| r.robot_in("ro", first).lost.is_some());
    rig.ticks(1);
    let counts = |rig: &Rig| {
        let row: fleet::rows::AreaBudget = rig.row("hall").expect("a row");
        row.off_work.contains(&robot_id(first))
    };
    assert!(!counts(&rig), "it is not heard");
    rig.robots[first].is_off = false;
    rig.pass(1_000);
    rig.fleet_turn();
    assert!(counts(&rig));
}

#[test]
fn who_holds_the_place_in_a_wave_is_named_too() {
    let (mut rig, first) = silent(|s| s.max_in_flight = Some(1));
    rig.ticks(2);
    let by = waits(&rig, (first + 1) % 12).by;
    assert_eq!(by.code, Code::BlockedByTurnInWave);
    assert_eq!(by.metadata.get("held_by"), Some(&robot_id(first).to_string()));
}
