//! Drains with fleet's real law, and permissions that are given only inside them.

use super::*;
use crate::task::forms::Transport;
use crate::task::{TaskIntake, TaskState};

/// Drains of roll-out `ro` by state.
fn drains(rig: &Rig, state: DrainState) -> usize {
    rig.fleet.drains.values().filter(|d| d.row.state == state).count()
}

fn wide() -> RolloutSpec {
    RolloutSpec { waves: vec![Wave::Rest], allow_full_push: true, ..spec() }
}

#[test]
fn permission_is_given_only_while_the_drain_holds_the_robot_and_the_roll_out_runs() {
    let mut rig = Rig::new(4);
    rig.fleet_sleeps = true;
    rig.start(spec());
    let n = rig.order()[0];
    rig.until(20, |r| r.step(n) == Step::Draining);
    let drain_id = rig.robot_in("ro", n).drain_id.expect("a drain");
    let set = crate::ids::SetId::parse("factory").expect("an id");
    rig.say_event(n, RobotEvent::Update(UpdateEvent::Ready { drain_id: drain_id.clone(), set: set.clone() }));
    rig.ticks(3);
    assert!(rig.robot_in("ro", n).grant.is_none(), "the drain does not hold it");
    rig.fleet_sleeps = false;
    rig.until(20, |r| r.step(n) == Step::Activating);
    rig.must("ro", Verb::Pause);
    rig.say_event(n, RobotEvent::Update(UpdateEvent::Ready { drain_id, set }));
    rig.ticks(3);
    assert!(rig.robot_in("ro", n).grant.is_none(), "the roll-out stands still");
    assert_eq!(rig.step(n), Step::Staged, "it works on meanwhile");
    assert_eq!(rig.rollout("ro").in_flight, 0);
}

#[test]
fn a_word_of_an_older_drain_gets_no_permission() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::NeverReady;
    rig.until(20, |r| r.step(n) == Step::Activating);
    let old = rig.robot_in("ro", n).drain_id.expect("a drain");
    rig.must("ro", Verb::Pause);
    rig.ticks(3);
    rig.must("ro", Verb::Resume);
    rig.until(20, |r| r.step(n) == Step::Activating);
    assert_ne!(rig.robot_in("ro", n).drain_id, Some(old.clone()), "ids are never used again");
    let set = crate::ids::SetId::parse("factory").expect("an id");
    rig.say_event(n, RobotEvent::Update(UpdateEvent::Ready { drain_id: old, set }));
    rig.ticks(3);
    assert!(rig.robot_in("ro", n).grant.is_none());
}

#[test]
fn an_unused_permission_is_taken_back_only_when_the_robot_says_so_past_its_life() {
    let mut rig = Rig::new(5);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Dawdles;
    rig.until(20, |r| r.robot_in("ro", n).grant.is_some());
    let given = rig.robot_in("ro", n).grant.expect("given").grant_id;
    rig.must("ro", Verb::Pause);
    rig.robots[n].is_off = true;
    rig.ticks(60);
    assert!(rig.robot_in("ro", n).drain_id.is_some(), "time alone releases nothing");
    assert!(rig.releases().is_empty());
    rig.robots[n].is_off = false;
    rig.ticks(2);
    assert!(rig.robot_in("ro", n).grant.is_some(), "its heartbeats are not past its life yet");
    rig.ticks(10);
    assert_eq!(rig.robot_in("ro", n).grant, None);
    rig.ticks(2);
    assert_eq!(rig.releases(), [ReleasedBy::NotUsed]);
    rig.robots[n].fate = Fate::Good;
    rig.must("ro", Verb::Resume);
    rig.until(60, |r| r.step(n) == Step::Trial);
    assert!(rig.robot_in("ro", n).moments.switched.is_some() && rig.robots[n].seen_grant > given);
}

#[test]
fn a_robot_that_was_killed_between_its_ledger_and_its_switch_record_gets_another_permission() {
    let mut rig = Rig::new(5);
    rig.start(spec());
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Dawdles;
    rig.until(20, |r| r.robots[n].seen_grant > 0);
    let given = rig.robots[n].seen_grant;
    let staged = rig.robots[n].report.clone().expect("has staged");
    // Its ledger says that it took it; its record, that it did not switch.
    rig.attach(n, |_| {});
    rig.report_update(n, UpdateReport { grant_id: given, ..staged });
    rig.robots[n].fate = Fate::Good;
    rig.until(60, |r| r.step(n) == Step::Trial);
    assert!(rig.robots[n].seen_grant > given, "never the same twice");
}

#[test]
fn a_permission_lies_above_all_that_its_robot_has_used_though_the_store_has_forgotten_them() {
    let mut rig = Rig::new(4);
    // The clock was three days ahead, and the store was restored from a copy of before.
    let used = rig.now.wall.plus_ms(3 * 24 * 3_600_000).0.cast_unsigned();
    rig.robots.iter_mut().for_each(|r| r.seen_grant = used);
    rig.start(spec());
    rig.until(200, |r| r.phase() == Phase::Completed);
    assert!(rig.robots.iter().all(|r| r.version == "2.0.0" && r.seen_grant > used));
}

#[test]
fn a_robot_that_says_it_has_used_what_no_clock_gave_moves_no_number() {
    let mut rig = Rig::new(4);
    rig.start(spec());
    let n = rig.order()[0];
    let used = crate::limits::GENERATION_FOLLOWED_MAX;
    rig.robots[n].seen_grant = used;
    rig.until(30, |r| r.robot_in("ro", n).grant.is_some());
    assert_eq!(rig.robots[n].report.as_ref().map(|report| report.grant_id), Some(used));
    let number = rig.ota.clocks["ota"].row.number;
    assert!(number <= rig.now.wall.0.cast_unsigned() + 10, "{number}");
}

#[test]
fn in_flight_is_never_above_the_wave_nor_above_what_was_asked() {
    let mut rig = Rig::new(12);
    rig.start(RolloutSpec { max_in_flight: Some(3), ..wide() });
    let mut most = 0;
    for _ in 0..120 {
        rig.tick();
        most = most.max(rig.rollout("ro").in_flight);
    }
    assert_eq!(most, 3);
    assert_eq!(rig.phase(), Phase::Completed);
    assert!(rig.releases().iter().all(|why| *why == ReleasedBy::Reported));
    assert!(rig.ota.requests.is_empty() && rig.ota.releases.is_empty() && rig.fleet.drains.is_empty());
}

#[test]
fn drains_wait_until_the_area_lets_them_begin_and_the_row_is_in_the_same_item() {
    let mut rig = Rig::new(12);
    rig.rules(|s| s.off_work_permille = 200);
    rig.fates(Fate::NeverReady);
    rig.start(wide());
    rig.ticks(8);
    assert_eq!((drains(&rig, DrainState::Held), drains(&rig, DrainState::Waiting)), (2, 10));
    let row: fleet::rows::AreaBudget = rig.row("hall").expect("a row");
    assert_eq!((row.off_work.len(), row.off_work_max), (2, 2));
    let waits = rig.fleet.drains.values().filter(|d| d.row.state == DrainState::Waiting);
    assert!(waits.clone().all(|d| d.row.why.as_ref().is_some_and(|w| w.code == Code::BlockedByBudget)));
    let begun = rig.feed.iter().filter(|e| &*e.kind == "drain.begun");
    let counted = rig.feed.iter().filter(|e| &*e.kind == "area.off_work");
    assert!(begun.count() <= counted.count(), "each drain that began wrote the area's row");
}

#[test]
fn waiting_drains_are_not_written_again_for_every_number_that_changes() {
    let mut rig = Rig::new(12);
    rig.rules(|s| s.off_work_permille = 200);
    rig.fates(Fate::NeverReady);
    rig.start(wide());
    rig.ticks(8);
    let told = |rig: &Rig| rig.feed.iter().filter(|e| &*e.kind == "drain.waits").count();
    let before = told(&rig);
    (0..3).for_each(|_| rig.arrive());
    rig.ticks(5);
    assert_eq!(drains(&rig, DrainState::Held), 3, "one more may be out of work");
    assert_eq!(told(&rig), before);
}

#[test]
fn robots_with_a_capability_that_is_kept_stay_in_work() {
    let mut rig = Rig::new(12);
    for n in 0..4 {
        rig.attach(n, |i| i.capabilities = vec!["tow".into()]);
    }
    rig.rules(|s| s.keep_in_work.extend([("tow".into(), 3)]));
    rig.fates(Fate::NeverReady);
    rig.start(wide());
    rig.ticks(8);
    let held = (0..4).filter(|n| rig.step(*n) == Step::Activating).count();
    assert_eq!((held, rig.count(Step::Activating)), (1, 9));
}

#[test]
fn robots_that_charge_are_asked_first_and_urgent_drains_do_not_wait() {
    use crate::ids::{AttemptId, Subject};
    use crate::task::state::Errand;
    let mut rig = Rig::new(3);
    rig.rules(|s| s.off_work_permille = 0);
    // The last of them charges: its mutex is with an errand that ends only when it is asked to.
    let id = AttemptId { subject: Subject::Errand { robot_id: robot_id(2), number: 1 }, epoch: 1 };
    rig.put_row(charge(&id, Errand::Charge));
    rig.put_row(RobotAuthority { robot_id: robot_id(2), holder: RobotHolder::Attempt(id) });
    for n in 0..3 {
        rig.put_row(request(n, false));
    }
    rig.fleet_turn();
    let state = |rig: &Rig, n: usize| rig.fleet.drains[format!("ota:{n}").as_str()].row.state;
    assert_eq!([0, 1, 2].map(|n| state(&rig, n)), [DrainState::Waiting, DrainState::Waiting, DrainState::Draining]);
    rig.put_row(crate::drain_request::DrainRequest {
        drain_id: DrainId::parse("ota:9").expect("an id"),
        ..request(0, true)
    });
    rig.fleet_turn();
    let urgent = &rig.fleet.drains["ota:9"].row;
    assert!(urgent.is_on(), "{urgent:?}");
}

#[test]
fn whoever_goes_back_from_an_aborted_bundle_does_not_wait_for_robots_that_only_a_person_brings_back() {
    let mut rig = Rig::new(6);
    for n in 0..3 {
        rig.attach(n, |i| i.capabilities = vec!["tow".into()]);
    }
    rig.rules(|s| {
        s.off_work_permille = 200;
        s.keep_in_work.extend([("tow".into(), 2)]);
    });
    let now = rig.now.utc;
    rig.control(2, |c| c.breaker = Some(now));
    for n in [0, 1] {
        rig.put_row(request(n, false));
    }
    rig.fleet_turn();
    let is_on = |rig: &Rig, n: usize| rig.fleet.drains[format!("ota:{n}").as_str()].row.is_on();
    assert_eq!([0, 1].map(|n| is_on(&rig, n)), [false, false], "one may be out of work, and one is");
    for n in [3, 4] {
        rig.put_row(crate::drain_request::DrainRequest { is_way_back: true, ..request(n, false) });
    }
    rig.put_row(crate::drain_request::DrainRequest {
        drain_id: DrainId::parse("ota:8").expect("an id"),
        is_way_back: true,
        ..request(0, false)
    });
    rig.fleet_turn();
    let on = [3, 4].map(|n| is_on(&rig, n));
    assert_eq!(on.iter().filter(|on| **on).count(), 1, "those that go back wait for each other: {on:?}");
    assert!(!is_on(&rig, 8), "of those that can tow two stay");
    // Whoever went and is stuck, or is not heard any more, keeps nobody waiting.
    let (gone, waits) = if on[0] { (3, 4) } else { (4, 3) };
    rig.robots[gone].is_off = true;
    rig.ticks(40);
    assert!(is_on(&rig, waits), "a robot that is dark keeps nobody on a bad bundle");
}

/// An opened task of this robot, whose item it carries.
fn opened(rig: &mut Rig, n: usize, phase: crate::task::Phase) {
    let task_id = crate::ids::TaskId::parse(&format!("t{n}")).expect("an id");
    rig.robots[n].load = Some(crate::robot::Load { task_id: Some(task_id.clone()), item: "box".into() });
    let form = Transport {
        kind: "transport".into(),
        from_waypoint: "A01".into(),
        to_waypoint: "B03".into(),
        timeout_ms: Some(600_000),
        ..Transport::default()
    };
    let intake = TaskIntake {
        task_id,
        spec: form.into_raw().check("task", &|_| true).expect("a task"),
        actor: String::new(),
        request_id: String::new(),
        payload_hash: String::new(),
        created: Utc(BEGIN),
        number: n as u64,
        type_revision: None,
    };
    rig.put_row(TaskState {
        phase,
        opened_robot_id: Some(robot_id(n)),
        robot_id: Some(robot_id(n)),
        ..TaskState::born(&intake)
    });
}

#[test]
fn a_robot_that_carries_the_item_of_a_task_that_is_tried_again_ends_it_before_it_is_taken() {
    use crate::task::Phase;
    let mut rig = Rig::new(2);
    opened(&mut rig, 0, Phase::RetryWait);
    rig.ticks(1);
    rig.put_row(request(0, false));
    rig.ticks(20);
    let drain = |rig: &Rig| rig.fleet.drains["ota:0"].row.state;
    assert_eq!(drain(&rig), DrainState::Draining);
    opened(&mut rig, 0, Phase::Queued);
    rig.ticks(2);
    assert_eq!(drain(&rig), DrainState::Draining);
    let work =
        |rig: &Rig, n: usize| crate::fleet::assignment::filters::robot(&rig.fleet, &rig.board, &robot_id(n), &rig.now);
    assert_eq!(work(&rig, 0), Ok(()), "it may be given the rest of its task");
    assert_eq!(work(&rig, 1), Ok(()));
    rig.robots[0].load = None;
    rig.ticks(2);
    assert_eq!(drain(&rig), DrainState::Held);
    assert!(work(&rig, 0).is_err());
}

#[test]
fn a_robot_with_a_load_that_only_a_person_can_take_is_waited_for_until_its_drains_deadline() {
    let mut rig = Rig::new(2);
    opened(&mut rig, 0, crate::task::Phase::NeedsOperator);
    rig.robots[1].load = Some(crate::robot::Load { task_id: None, item: "box".into() });
    rig.ticks(1);
    (0..2).for_each(|n| rig.put_row(request(n, false)));
    rig.fleet_turn();
    rig.ticks(20);
    let state = |rig: &Rig, id: &str| rig.fleet.drains[id].row.state;
    assert_eq!(["ota:0", "ota:1"].map(|id| state(&rig, id)), [DrainState::Draining; 2]);
    rig.robots[1].load = None;
    rig.ticks(60);
    assert_eq!(["ota:0", "ota:1"].map(|id| state(&rig, id)), [DrainState::Refused, DrainState::Held]);
    assert_eq!(rig.fleet.drains["ota:0"].row.why.as_ref().map(|why| why.code), Some(Code::SkippedBusy));
}

#[test]
fn a_load_keeps_nobody_from_going_back_nor_from_a_person_who_asked_for_the_robot() {
    let mut rig = Rig::new(2);
    rig.robots[0].load = Some(crate::robot::Load { task_id: None, item: "box".into() });
    opened(&mut rig, 1, crate::task::Phase::Queued);
    rig.ticks(1);
    let mut plan = fleet::Plan::default();
    plan.decide(&mut rig.fleet, rig.now, "ana", |tx| drain::request_drain(tx, &robot_id(0), "oil", "ana", 60_000));
    rig.commit(plan.items);
    rig.put_row(crate::drain_request::DrainRequest { is_way_back: true, ..request(1, false) });
    rig.ticks(3);
    let states: Vec<_> = rig.fleet.drains.values().map(|d| d.row.state).collect();
    assert_eq!(states, [DrainState::Held, DrainState::Held]);
}

fn request(n: usize, urgent: bool) -> crate::drain_request::DrainRequest {
    crate::drain_request::DrainRequest {
        drain_id: DrainId::parse(&format!("ota:{n}")).expect("an id"),
        robot_id: robot_id(n),
        rollout_id: rollout_id("ro"),
        reason: String::new(),
        within_ms: 60_000,
        urgent,
        is_way_back: false,
        forward: false,
        written_off: false,
    }
}

fn charge(id: &crate::ids::AttemptId, errand: crate::task::state::Errand) -> crate::task::Attempt {
    crate::task::Attempt {
        attempt: id.clone(),
        robot_id: robot_id(2),
        errand: Some(errand),
        goal: Some(WaypointId::parse("charge-1").expect("an id")),
        phase: crate::task::AttemptPhase::Executing,
        uncertain: None,
        offer: crate::authority::Authority { session_epoch: 2, hb: 1, valid_ms: 5_000 },
        step_index: 0,
        reported: None,
        is_opened: false,
        offered: Utc(BEGIN),
        accepted: None,
        ended: None,
        fault: None,
        refusal: None,
        stats: WorkStats::default(),
        software: String::new(),
        visited: None,
    }
}

#[test]
fn a_request_and_its_release_together_make_no_drain_and_both_go_when_none_stands() {
    let mut rig = Rig::new(2);
    rig.put_row(request(0, false));
    rig.put_row(crate::drain_request::DrainRelease { drain_id: request(0, false).drain_id, why: ReleasedBy::NoGrant });
    rig.fleet_turn();
    assert!(rig.fleet.drains.is_empty());
    rig.ota_turn();
    assert!(rig.ota.requests.is_empty() && rig.ota.releases.is_empty());
    rig.put_row(request(1, false));
    rig.fleet_turn();
    rig.put_row(crate::drain_request::DrainRelease { drain_id: request(1, false).drain_id, why: ReleasedBy::NoGrant });
    rig.ota_turn();
    assert_eq!(rig.ota.requests.len(), 1, "the drain stands");
    rig.fleet_turn();
    rig.ota_turn();
    assert!(rig.ota.requests.is_empty() && rig.ota.releases.is_empty());
    assert_eq!(rig.row::<RobotAuthority>(robot_id(1).as_str()).expect("a row").holder, RobotHolder::None);
}

#[test]
fn a_drain_behind_one_of_a_person_is_given_up_after_an_hour() {
    let mut rig = Rig::new(4);
    rig.checks_rebuild = false;
    rig.start(spec());
    let n = rig.order()[0];
    let mut plan = fleet::Plan::default();
    plan.decide(&mut rig.fleet, rig.now, "ana", |tx| drain::request_drain(tx, &robot_id(n), "oil", "ana", 60_000));
    rig.commit(plan.items);
    rig.ticks(10);
    assert_eq!(rig.step(n), Step::Draining);
    rig.pass(crate::limits::STAGED_WITHIN.as_ms());
    rig.turn();
    let r = rig.robot_in("ro", n);
    assert_eq!((r.step, r.why.expect("a reason").code), (Step::Skipped, Code::SkippedBusy));
    assert_eq!(rig.releases(), [ReleasedBy::NoGrant]);
}
