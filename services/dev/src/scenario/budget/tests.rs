//! Each way in which robots can be out of work against the rules is one objection, and what the rules allow is none.

use super::{Judge, Pace, RobotReport};
use midshift_core::fleet::rows::{Drain, DrainState};
use midshift_core::ids::{AreaId, DrainId, RobotId, RolloutId};
use midshift_core::time::{LinkTime, Utc};
use std::collections::BTreeMap;

const NOW: LinkTime = LinkTime(1_000_000);

fn area(name: &str) -> AreaId {
    AreaId::parse(name).expect("an area")
}

fn robot(number: usize) -> RobotId {
    RobotId::parse(&format!("r-{number:02}")).expect("a robot")
}

fn rollout() -> RolloutId {
    RolloutId::parse("walk-2").expect("a roll-out")
}

fn report(number: usize, at: &str) -> RobotReport {
    RobotReport {
        robot_id: robot(number),
        heard: NOW,
        area_id: Some(area(at)),
        is_stuck: false,
        changes: false,
        goes_back: false,
    }
}

/// The drain of a robot that was taken from an area.
fn drain(number: usize, from: &str) -> Drain {
    Drain {
        drain_id: DrainId::parse(&format!("d-{number:02}")).expect("a drain"),
        robot_id: robot(number),
        state: DrainState::Draining,
        reason: String::new(),
        actor: "ota".to_owned(),
        within_ms: 600_000,
        since: Utc(0),
        why: None,
        area_id: Some(area(from)),
        rollout_id: Some(rollout()),
        urgent: false,
        is_way_back: false,
    }
}

/// Twenty robots in the hall, of which two may be out of work, and three at packing, of which one may; all in one wave.
fn judge() -> Judge {
    let mut judge = Judge::new(BTreeMap::from([(area("hall"), 100), (area("packing"), 100)]));
    judge.rollout(rollout(), Pace::default());
    (0..23).for_each(|number| judge.robot(rollout(), robot(number), 0));
    judge.judge_reports(NOW, &all());
    judge
}

fn all() -> Vec<RobotReport> {
    (0..20).map(|n| report(n, "hall")).chain((20..23).map(|n| report(n, "packing"))).collect()
}

#[test]
fn each_area_has_a_budget_of_its_own() {
    let mut judge = judge();
    [drain(0, "hall"), drain(1, "hall"), drain(20, "packing")].into_iter().for_each(|d| judge.drain(d));
    let seen = judge.take_seen();
    assert_eq!(seen.broken, Vec::<String>::new());
    let fullest: Vec<_> = seen.areas.iter().map(|a| (a.area_id.as_str(), a.out, a.may)).collect();
    assert_eq!((fullest, seen.may_at_once), (vec![("hall", 2, 2), ("packing", 1, 1)], 3));
}

#[test]
fn a_robot_that_was_written_off_spends_no_budget_until_it_counts_again() {
    let mut judge = judge();
    judge.rollout(rollout(), Pace { max_in_flight: Some(2), ..Pace::default() });
    (0..2).for_each(|number| judge.drain(drain(number, "hall")));
    judge.write_off(rollout(), robot(0));
    judge.drain(drain(2, "hall"));
    assert_eq!(judge.take_seen().broken, Vec::<String>::new());
    judge.count(&rollout(), &robot(0));
    judge.drain(drain(3, "hall"));
    let names = "(r-00, r-01, r-02, r-03)";
    let told = [
        format!("hall: 4 robots were out of work {names}, 2 may be"),
        format!("4 robots were out of work for it at once {names}, 2 may be"),
    ];
    assert_eq!(judge.take_seen().broken, told);
}

#[test]
fn one_area_may_not_spend_the_budget_of_another() {
    // Three may be out over the whole site.
    for (numbers, from, told) in [
        (vec![0, 1, 2], "hall", "hall: 3 robots were out of work (r-00, r-01, r-02), 2 may be"),
        (vec![20, 21], "packing", "packing: 2 robots were out of work (r-20, r-21), 1 may be"),
    ] {
        let mut judge = judge();
        numbers.into_iter().for_each(|n| judge.drain(drain(n, from)));
        assert_eq!(judge.take_seen().broken, [told]);
    }
}

#[test]
fn a_robot_counts_for_the_area_that_it_was_taken_from_until_its_drain_is_no_more() {
    let mut judge = judge();
    judge.drain(drain(20, "packing"));
    judge.drain(Drain { state: DrainState::Held, ..drain(20, "packing") });
    // It parks in the hall: there two more may be out, and at packing none.
    let parked = |s: RobotReport| if s.robot_id == robot(20) { report(20, "hall") } else { s };
    judge.judge_reports(NOW, &all().into_iter().map(parked).collect::<Vec<_>>());
    [drain(0, "hall"), drain(1, "hall")].into_iter().for_each(|d| judge.drain(d));
    assert_eq!(judge.take_seen().broken, Vec::<String>::new());
    judge.drain(drain(21, "packing"));
    assert_eq!(judge.take_seen().broken.len(), 1);
    judge.drain_is_gone("d-20");
    judge.drain(Drain { state: DrainState::Refused, ..drain(21, "packing") });
    judge.drain(drain(22, "packing"));
    assert_eq!(judge.take_seen().broken, Vec::<String>::new());
}

#[test]
fn robots_that_left_an_area_a_while_ago_are_no_budget_of_it() {
    let mut judge = judge();
    let left = |from: usize| (0..20).map(|n| report(n, if n < from { "hall" } else { "packing" })).collect::<Vec<_>>();
    judge.judge_reports(LinkTime(NOW.0 + 5_000), &left(19));
    [drain(0, "hall"), drain(1, "hall")].into_iter().for_each(|d| judge.drain(d));
    assert_eq!(judge.take_seen().broken, Vec::<String>::new(), "a planner may have seen the twentieth there");
    judge.drain_is_gone("d-01");
    judge.judge_reports(LinkTime(NOW.0 + 10_001), &left(19));
    judge.drain(drain(1, "hall"));
    assert_eq!(judge.take_seen().broken, ["hall: 2 robots were out of work (r-00, r-01), 1 may be"]);
}

#[test]
fn a_way_back_waits_for_drains_alone_that_end_by_themselves_and_an_urgent_one_for_nobody() {
    let back = |number| Drain { is_way_back: true, ..drain(number, "packing") };
    let mut waits = judge();
    waits.drain(drain(20, "packing"));
    waits.drain(back(21));
    assert_eq!(waits.take_seen().broken.len(), 1, "its turn comes when the other is back");

    let mut stuck = judge();
    let is_stuck = |s: RobotReport| RobotReport { is_stuck: s.robot_id == robot(20), ..s };
    stuck.judge_reports(NOW, &all().into_iter().map(is_stuck).collect::<Vec<_>>());
    stuck.drain(drain(20, "packing"));
    stuck.drain(back(21));
    assert_eq!(stuck.take_seen().broken, Vec::<String>::new(), "only a person brings the other back");

    let mut urgent = judge();
    urgent.drain(drain(20, "packing"));
    urgent.drain(Drain { urgent: true, ..back(21) });
    assert_eq!(urgent.take_seen().broken, Vec::<String>::new());
    urgent.drain(drain(22, "packing"));
    assert_eq!(urgent.take_seen().broken.len(), 1, "it counts for the next");
}

#[test]
fn no_more_are_out_of_work_than_the_wave_has_or_the_roll_out_was_asked_for() {
    let told = "2 robots were out of work for it at once (r-00, r-20), 1 may be";
    for (pace, first_wave, broken) in [
        (Pace::default(), 2, vec![]),
        (Pace::default(), 1, vec![told]),
        (Pace { wave: 1, ..Pace::default() }, 1, vec![]),
        (Pace { max_in_flight: Some(1), ..Pace::default() }, 2, vec![told]),
        (Pace { max_in_flight: Some(9), ..Pace::default() }, 1, vec![told]),
    ] {
        let mut judge = judge();
        (0..23).for_each(|n| judge.robot(rollout(), robot(n), u32::from(n >= first_wave)));
        judge.rollout(rollout(), pace);
        judge.drain(drain(0, "hall"));
        judge.drain(drain(20, "packing"));
        assert_eq!(judge.take_seen().broken, broken, "{pace:?}, {first_wave} in the first wave");
    }
}

#[test]
fn software_that_changes_in_no_drain_is_an_objection_at_the_second_heartbeat() {
    let later = LinkTime(NOW.0 + 1_000);
    let heard = |at: LinkTime| {
        let changes = |s: RobotReport| RobotReport { changes: s.robot_id == robot(3), heard: at, ..s };
        all().into_iter().map(changes).collect::<Vec<RobotReport>>()
    };
    let mut inside = judge();
    inside.drain(drain(3, "hall"));
    let mut outside = judge();
    for judge in [&mut inside, &mut outside] {
        judge.judge_reports(NOW, &heard(NOW));
        judge.judge_reports(later, &heard(NOW));
        assert_eq!(judge.take_seen().broken, Vec::<String>::new(), "its drain may have ended by an event since");
        judge.judge_reports(later, &heard(later));
    }
    assert_eq!(inside.take_seen().broken, Vec::<String>::new());
    assert_eq!(outside.take_seen().broken, ["r-03 changed its software while no drain kept it out of work"]);
}

#[test]
fn what_was_there_before_it_looked_is_counted_and_not_judged() {
    let mut judge = judge();
    judge.forget_rows();
    (0..3).for_each(|n| judge.drain(drain(n, "hall")));
    assert_eq!(judge.take_seen().broken, Vec::<String>::new());
    judge.judge_reports(NOW, &all());
    judge.drain(drain(3, "hall"));
    assert_eq!(judge.take_seen().broken.len(), 1);
}
