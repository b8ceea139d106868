//! Orders to go back that robots do not take, and directives that lay too long.

use super::*;

const DAY_MS: u64 = 24 * 3_600_000;

/// A roll-out of which wave 0 has committed and wave 1 is on trial.
fn half() -> Rig {
    let mut rig = Rig::new(6);
    rig.start(RolloutSpec { soak_ms: 20_000, ..spec() });
    rig.until(200, |r| r.rollout("ro").wave == 1 && r.phase() == Phase::Soaking);
    rig
}

/// Bundle 2 was kept by all, 3 was tried and left again by one: only a directive of its own leads that one back from 2.
fn left_another(n: usize) -> Rig {
    let mut rig = Rig::new(4);
    rig.start(spec());
    rig.until(400, |r| r.phase() == Phase::Completed);
    rig.ticks(4);
    let mut next = RolloutSpec { bundle: bundle_id(3), waves: vec![Wave::Rest], allow_full_push: true, ..spec() };
    next.selector.robots.insert(robot_id(n));
    rig.start_as("next", next, false);
    rig.until(60, |r| r.robot_in("next", n).step == Step::Trial);
    rig.must("next", Verb::Abort);
    rig.until(60, |r| r.rollout("next").phase == Phase::Aborted);
    assert_eq!(rig.robots[n].version, "2.0.0");
    rig
}

/// Takes bundle 2 back from everybody.
fn take_back(rig: &mut Rig) {
    rig.ask(&Command::Rollback { of: rollout_id("ro"), rollout_id: rollout_id("back") }).expect("allowed");
    for verb in [Verb::Submit, Verb::Approve, Verb::Start { supersede: false }] {
        rig.must("back", verb);
    }
}

fn section(rig: &Rig, n: usize) -> DesiredUpdate {
    rig.row(robot_id(n).as_str()).expect("a section")
}

/// Robots, reasons and roll-outs of the incidents that say that one could not go back.
fn stuck(rig: &Rig) -> Vec<(String, Option<String>, Option<String>)> {
    let told = rig.feed.iter().filter(|e| &*e.kind == crate::drain_request::INCIDENT);
    let read = |e: &Entry| {
        let reason: Reason = serde_json::from_str(e.body.as_ref()?).expect("a reason");
        let fact = |key: &str| reason.metadata.get(key).cloned();
        (reason.code == Code::RollbackFailed).then(|| (e.subject.to_string(), fact("because"), fact("rollout_id")))
    };
    told.filter_map(read).collect()
}

#[test]
fn a_robot_that_keeps_nothing_is_stuck_and_its_abort_comes_to_its_end() {
    let mut rig = half();
    let n = rig.order()[0];
    assert_eq!(rig.step(n), Step::Committed);
    rig.robots[n].fate = Fate::KeepsNothing;
    rig.must("ro", Verb::Abort);
    rig.until(100, |r| r.phase() == Phase::Aborted);
    assert_eq!((rig.step(n), rig.count(Step::RolledBack)), (Step::Stuck, 5));
    assert_eq!(rig.robot_in("ro", n).failure.expect("counted").code, Code::RollbackFailed);
    let told = (robot_id(n).to_string(), Some("NOTHING_KEPT".to_owned()), Some("ro".to_owned()));
    assert_eq!(stuck(&rig), [told]);
    assert_eq!(rig.rollout("ro").in_flight, 1, "it stays out of work");
    rig.retire(n);
    rig.ticks(2);
    assert_eq!((rig.step(n), rig.rollout("ro").in_flight), (Step::Skipped, 0), "a person has looked");
}

fn unstick(n: usize) -> Command {
    Command::Unstick { robot_id: robot_id(n), reason: "its disk was put back".into() }
}

#[test]
fn a_robot_that_kept_nothing_and_was_mended_is_ordered_back_once_more() {
    let mut rig = half();
    let [n, other] = [rig.order()[0], rig.order()[1]];
    rig.robots[n].fate = Fate::KeepsNothing;
    rig.must("ro", Verb::Abort);
    rig.until(100, |r| r.phase() == Phase::Aborted);
    assert_eq!(rig.step(n), Step::Stuck);
    assert!(rig.ask(&unstick(other)).is_err(), "that one is back");
    let before = section(&rig, n).generation;
    rig.robots[n].fate = Fate::Good;
    assert!(!rig.ask(&unstick(n)).expect("it is stuck"));
    assert!(rig.ask(&unstick(n)).expect("it was told so"), "asked twice it is done once");
    rig.until(30, |r| r.step(n) == Step::RolledBack);
    assert!(section(&rig, n).generation > before, "by an order of its own");
    assert_eq!((rig.robots[n].version.as_str(), rig.rollout("ro").in_flight), ("0.9.0", 0));
}

#[test]
fn a_stuck_robot_that_was_set_up_anew_is_told_as_back_and_one_that_runs_the_bundle_is_not() {
    for version in ["0.9.0", "2.0.0"] {
        let mut rig = half();
        let n = rig.order()[0];
        rig.robots[n].fate = Fate::KeepsNothing;
        rig.must("ro", Verb::Abort);
        rig.until(100, |r| r.phase() == Phase::Aborted);
        assert_eq!((rig.step(n), rig.robots[n].version.as_str()), (Step::Stuck, "2.0.0"));
        rig.robots[n].report = None;
        rig.robots[n].version = version.to_owned();
        rig.attach(n, |_| {});
        rig.ticks(5);
        assert_eq!(rig.step(n), Step::Stuck, "nobody has said so");
        rig.ask(&unstick(n)).expect("it is stuck");
        rig.until(60, |r| r.step(n) != Step::Reverting);
        let (end, incidents) = if version == "0.9.0" { (Step::RolledBack, 1) } else { (Step::Stuck, 2) };
        assert_eq!((rig.step(n), stuck(&rig).len()), (end, incidents), "{version}");
        let software: RobotSoftware = rig.row(robot_id(n).as_str()).expect("a row");
        assert_eq!(software.committed.is_none(), end == Step::RolledBack, "{version}");
        assert_eq!(rig.rollout("ro").in_flight, u32::from(end == Step::Stuck));
    }
}

/// What a robot waits for, and what a person can do.
fn waits_for(rig: &Rig, n: usize) -> Option<Reason> {
    let (rollout, r) = (rig.rollout("ro"), rig.robot_in("ro", n));
    crate::rollout::explain::blocked(&rig.ota, &rig.board, &rig.now, &rollout, &r).map(|blocked| blocked.by)
}

/// The robot waits for a person to say whose machine shows this key, and no order is signed for it.
fn assert_held_back(rig: &Rig, n: usize, device_key: &str, last: u64) {
    let by = waits_for(rig, n).expect("it waits");
    let named = [by.metadata["robot_id"].as_str(), by.metadata["device_key"].as_str()];
    assert_eq!((by.code, named), (Code::SkippedOtherKey, [robot_id(n).as_str(), device_key]));
    assert!(by.code.next_step().contains("--accept-key"), "{}", by.code.next_step());
    let told = rig.row::<DesiredUpdate>(robot_id(n).as_str()).map_or(0, |d| d.generation);
    assert!(told <= last, "{told} was signed");
    assert_eq!((rig.step(n), rig.phase()), (Step::Reverting, Phase::Aborted), "and its roll-out waits for nobody");
}

fn accept(rig: &mut Rig, n: usize, device_key: String) {
    rig.ask(&Command::AcceptKey { robot_id: robot_id(n), device_key }).expect("allowed");
}

#[test]
fn no_order_back_is_signed_for_a_machine_with_another_key_until_a_person_takes_it() {
    let (mut rig, n) = canary_on_its_way_back();
    // What it was told is gone, as after a restore: only a directive of its own can tell it again.
    let last = section(&rig, n).generation;
    rig.write(Key::new(DesiredUpdate::TABLE, robot_id(n).as_str()), None, "test.gone");
    let device_key = rig.shows_another_key(n);
    rig.robots[n].is_off = false;
    rig.ticks(60);
    assert_held_back(&rig, n, &device_key, last);
    accept(&mut rig, n, device_key);
    rig.until(60, |r| r.step(n) == Step::RolledBack);
    assert!(section(&rig, n).generation > last);
}

#[test]
fn a_roll_out_that_takes_another_back_waits_for_nobody_whose_key_a_person_must_take() {
    let n = 2;
    let mut rig = left_another(n);
    rig.robots[n].fate = Fate::Stubborn;
    take_back(&mut rig);
    rig.until(60, |r| r.robot_in("back", n).way_back.generation > 0);
    let first = section(&rig, n).directive;
    let device_key = rig.shows_another_key(n);
    rig.until(200, |r| r.rollout("back").phase == Phase::Completed);
    let r = rig.robot_in("back", n);
    assert_eq!((r.step, r.way_back.refused.is_some()), (Step::Reverting, true), "it is not ordered back anew");
    assert_eq!(section(&rig, n).directive, first);
    rig.robots[n].fate = Fate::Good;
    accept(&mut rig, n, device_key);
    rig.until(60, |r| r.robot_in("back", n).step == Step::RolledBack);
    assert_ne!(section(&rig, n).directive, first);
}

#[test]
fn what_a_stuck_robot_said_before_it_was_mended_does_not_make_it_stuck_again() {
    let mut rig = half();
    let n = rig.order()[0];
    rig.report(n, UpdateState::Stuck);
    rig.must("ro", Verb::Abort);
    rig.until(60, |r| r.step(n) == Step::Stuck);
    rig.ask(&unstick(n)).expect("it is stuck");
    rig.ota_turn();
    assert_eq!((rig.step(n), stuck(&rig).len()), (Step::Reverting, 1));
    rig.until(200, |r| r.step(n) == Step::RolledBack);
    assert_eq!(stuck(&rig).len(), 1);
}

#[test]
fn an_order_to_go_back_that_is_refused_is_signed_anew_once() {
    for stubborn in [false, true] {
        let mut rig = half();
        let n = rig.order()[0];
        rig.robots[n].fate = Fate::Stubborn;
        rig.must("ro", Verb::Abort);
        let first = section(&rig, n).directive;
        rig.until(60, |r| !r.robots[n].judged.is_empty());
        if !stubborn {
            rig.robots[n].fate = Fate::Good;
        }
        rig.until(60, |r| r.phase() == Phase::Aborted);
        assert_ne!(section(&rig, n).directive, first, "signed anew");
        let (end, incidents) = if stubborn { (Step::Stuck, 1) } else { (Step::RolledBack, 0) };
        assert_eq!((rig.step(n), stuck(&rig).len()), (end, incidents));
        let second = section(&rig, n).directive;
        rig.ticks(20);
        assert_eq!(section(&rig, n).directive, second, "and no third time");
    }
}

#[test]
fn what_a_robot_says_of_an_older_order_says_nothing_of_the_newest() {
    let mut rig = half();
    let n = rig.order()[0];
    rig.robots[n].fate = Fate::Stubborn;
    let before = section(&rig, n).generation;
    rig.must("ro", Verb::Abort);
    rig.until(60, |r| section(r, n).goal == Goal::Revert);
    let reason = Code::NothingKept.into();
    rig.say_event(n, RobotEvent::Update(UpdateEvent::DirectiveRefused { generation: before, reason }));
    rig.ota_turn();
    assert_eq!((rig.step(n), rig.robot_in("ro", n).way_back.refused), (Step::Reverting, None));
}

#[test]
fn an_order_to_go_back_that_lies_too_long_is_signed_anew_for_a_robot_that_is_away() {
    let n = 2;
    let mut rig = left_another(n);
    take_back(&mut rig);
    rig.until(60, |r| r.robot_in("back", n).way_back.generation > 0);
    // It is told so, and falls silent before it has read it.
    rig.robots[n].is_off = true;
    let first = section(&rig, n).directive;
    for _ in 0..8 {
        rig.pass(DAY_MS);
        rig.turn();
    }
    assert_eq!(rig.robot_in("back", n).step, Step::Reverting);
    assert_ne!(section(&rig, n).directive, first);
    rig.robots[n].is_off = false;
    rig.until(20, |r| r.robot_in("back", n).step == Step::RolledBack);
    assert_eq!((rig.robots[n].version.as_str(), stuck(&rig).len()), ("0.9.0", 0));
}

#[test]
fn an_order_that_was_taken_is_not_signed_anew_however_long_the_robot_takes() {
    let n = 2;
    let mut rig = left_another(n);
    take_back(&mut rig);
    rig.until(60, |r| r.robot_in("back", n).way_back.generation > 0);
    let generation = section(&rig, n).generation;
    // It took it, and is switched off before it goes back.
    rig.report_update(n, fresh_report(UpdateState::Committed, &bundle_id(2), generation));
    rig.ota_turn();
    rig.robots[n].is_off = true;
    for _ in 0..8 {
        rig.pass(DAY_MS);
        rig.turn();
    }
    assert_eq!(section(&rig, n).generation, generation);
}

#[test]
fn an_order_to_fetch_that_lay_too_long_while_the_server_was_away_leaves_nobody_out() {
    let mut rig = Rig::new(4);
    rig.create("ro", spec());
    rig.must("ro", Verb::Submit);
    rig.must("ro", Verb::Approve);
    rig.robots[1].is_off = true;
    rig.must("ro", Verb::Start { supersede: false });
    assert_eq!(rig.step(1), Step::Staging);
    let first = section(&rig, 1).directive;
    // Nobody plans for eight days. Then it comes back, and is told what was in the store.
    rig.pass(8 * DAY_MS);
    rig.robots[1].is_off = false;
    rig.robot_acts(1);
    assert_eq!(rig.robots[1].judged, first, "it is too old");
    rig.ticks(3);
    let r = rig.robot_in("ro", 1);
    assert!(r.why.is_none() && matches!(r.step, Step::Staged | Step::Draining), "{:?} {:?}", r.why, r.step);
}

#[test]
fn whom_only_a_signed_order_leads_back_stays_at_work_until_there_is_a_key() {
    let mut rig = left_another(1);
    rig.keyless = true;
    take_back(&mut rig);
    rig.ticks(120);
    let waits = rig.robot_in("back", 1);
    assert_eq!((waits.step, waits.drain_id), (Step::Staged, None), "out of work it would keep others from going back");
    assert_eq!(rig.robots[1].version, "2.0.0");
    assert!(
        (0..4)
            .filter(|n| *n != 1)
            .any(|n| rig.robot_in("back", n).step == Step::RolledBack || rig.robots[n].version == "0.9.0")
    );
    rig.keyless = false;
    rig.until(300, |r| r.rollout("back").phase == Phase::Completed);
    assert!(rig.robots.iter().all(|r| r.version == "0.9.0"));
}
