//! A server without a key whose orders robots take: it tells nobody what would have to be signed, says why, and goes on
//! when it has one.

use super::*;
use crate::rollout::explain;
use crate::rollout::projection::rows::Pause;

/// What a robot waits for, as whoever asks is told.
fn waits_for(rig: &Rig, n: usize) -> Option<Code> {
    let rollout = rig.rollout("ro");
    explain::blocked(&rig.ota, &rig.board, &rig.now, &rollout, &rig.robot_in("ro", n)).map(|blocked| blocked.by.code)
}

#[test]
fn nobody_is_told_to_fetch_and_the_roll_out_says_why_until_there_is_a_key() {
    let mut rig = Rig::new(4);
    rig.keyless = true;
    rig.start(spec());
    rig.ticks(30);
    assert_eq!(rig.ota.desired.len(), 0, "an order that robots refuse would skip them");
    assert_eq!(rig.count(Step::Waiting), 4);
    assert_eq!(rig.rollout("ro").pauses, BTreeSet::from([Pause::Keyless]));
    assert!((0..4).all(|n| waits_for(&rig, n) == Some(Code::NoDirectiveKey)));
    rig.keyless = false;
    rig.until(200, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    assert_eq!(rig.count(Step::Committed), 4);
}

#[test]
fn a_roll_out_at_work_stands_still_and_no_more_robots_come_out_of_work() {
    let mut rig = Rig::new(4);
    rig.start(RolloutSpec { soak_ms: 60_000, ..spec() });
    rig.until(60, |r| r.phase() == Phase::Soaking);
    rig.keyless = true;
    rig.ticks(120);
    assert_eq!((rig.phase(), rig.count(Step::Staged), rig.count(Step::Trial)), (Phase::Soaking, 3, 1));
    let n = rig.order()[3];
    assert_eq!(waits_for(&rig, n), Some(Code::NoDirectiveKey));
    rig.keyless = false;
    rig.until(300, |r| r.phase() == Phase::Completed);
}

#[test]
fn robots_go_back_by_the_order_that_they_took_also_without_a_key() {
    let (mut rig, n) = canary_on_trial();
    rig.keyless = true;
    rig.must("ro", Verb::Abort);
    rig.until(60, |r| r.phase() == Phase::Aborted);
    assert_eq!(rig.step(n), Step::RolledBack);
}

#[test]
fn an_order_back_that_must_be_signed_anew_waits_for_a_key_and_nothing_else_does() {
    let (mut rig, n) = canary_on_its_way_back();
    rig.keyless = true;
    // What it was told is gone, as after a restore: only a directive of its own can tell it again.
    let told = rig.ota.desired[robot_id(n).as_str()].row.generation;
    rig.write(Key::new(DesiredUpdate::TABLE, robot_id(n).as_str()), None, "test.gone");
    rig.robots[n].is_off = false;
    rig.ticks(90);
    assert!(!rig.ota.desired.contains_key(robot_id(n).as_str()), "nothing was signed");
    assert_eq!((rig.step(n), waits_for(&rig, n)), (Step::Reverting, Some(Code::NoDirectiveKey)));
    rig.keyless = false;
    rig.until(60, |r| r.ota.desired.get(robot_id(n).as_str()).is_some_and(|d| d.row.generation > told));
}

#[test]
fn who_comes_after_the_end_is_not_switched_without_a_key() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    rig.arrive();
    rig.until(100, |r| r.count(Step::Staged) == 1);
    rig.keyless = true;
    rig.ticks(90);
    assert_eq!((rig.step(4), rig.robots[4].version.as_str()), (Step::Staged, "0.9.0"));
    assert_eq!(waits_for(&rig, 4), Some(Code::NoDirectiveKey));
    rig.keyless = false;
    rig.until(100, |r| r.robots[4].kept == "2.0.0");
}
