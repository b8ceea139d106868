//! Roll-outs that go wrong, directed: a bad bundle whose robots are stopped, and robots that do not come back to their server. Every law of
//! the witness holds in them too.

use crate::directed::{Scene, config, waves};
use crate::net::LineState;
use crate::orders::Order;
use crate::room::{Naive, RoomConfig};
use crate::run::steer;
use crate::software::{BAD_WITH_LOAD, GOOD, HANGS};
use midshift_core::gates::TaskTally;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::rollout::rows::{Outcome, Pause, Phase, Rollout};
use midshift_core::update::UpdateState;
use midshift_proto::ota::v1::RolloutSpec;
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_sim::faults::FaultRates;

/// Time that a stop lasts, longer than any way back, milliseconds.
const STOP_MS: u64 = 400_000;
/// Site time without its server after which a robot on probation goes back by itself, and some more, milliseconds.
const LOST_SERVER_MS: u64 = 620_000;

/// Who says first that it is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum First {
    Person,
    Gate,
}

fn seconds(seconds: i64) -> Option<prost_types::Duration> {
    Some(prost_types::Duration { seconds, nanos: 0 })
}

/// Millimetres that each of these has driven.
fn driven(scene: &Scene, robots: &[usize]) -> Vec<u64> {
    robots.iter().map(|robot| scene.room.hall.robots()[*robot].lock().odometers_mm().0).collect()
}

/// There is work for everybody, so that a robot that may move does.
fn each_moves(scene: &mut Scene, what: &str, robots: &[usize]) {
    let before = driven(scene, robots);
    scene.work(24);
    let robots = robots.to_vec();
    scene.until(what, |room| {
        let now = robots.iter().map(|robot| room.hall.robots()[*robot].lock().odometers_mm().0);
        now.zip(&before).all(|(now, before)| now > *before)
    });
}

/// From the stop of every canary to the end of the roll-out, and to work again.
fn stopped_canaries_go_back(scene: &mut Scene, canaries: &[usize], first: First) -> Rollout {
    scene.stop_hard(canaries, STOP_MS);
    let stands = driven(scene, canaries);
    if first == First::Person {
        scene.order(Order::Abort("bad".to_owned()));
        scene.answered();
    }
    let row = scene.ends("bad");
    if first == First::Gate {
        // Too late, and no harm.
        scene.order(Order::Abort("bad".to_owned()));
        scene.answered();
    }
    assert_eq!(row.phase, Phase::Aborted);
    let abort = row.abort.as_ref().expect("a reason");
    assert_eq!(abort.actor.is_some(), first == First::Person, "{abort:?}");
    assert_eq!(abort.touched as usize, canaries.len(), "{abort:?}");
    assert_eq!(scene.robots_in(UpdateState::RolledBack), canaries, "they went back while they were stopped");
    for canary in canaries {
        assert!(scene.room.is_stopped(*canary), "the stop was longer than the way back");
        assert_eq!(scene.runs(*canary), None, "robot {canary} is on what it kept");
    }
    assert_eq!(driven(scene, canaries), stands, "going back moved nobody");
    // There is work, and nobody who is stopped takes it; nor when the stop is over, before a person says so.
    let others: Vec<usize> = scene.all().into_iter().filter(|robot| !canaries.contains(robot)).collect();
    each_moves(scene, "the others to work", &others);
    let all = canaries.to_vec();
    scene.until("the stops to be over", |room| all.iter().all(|canary| !room.is_stopped(*canary)));
    scene.work(24);
    scene.pass(60_000);
    assert_eq!(driven(scene, canaries), stands, "nobody said that they may go on");
    for canary in canaries {
        scene.let_go(*canary);
    }
    each_moves(scene, "the canaries to work again", canaries);
    scene.comes_to_rest();
    scene.all_run(None);
    assert_eq!(scene.activations() as usize, canaries.len(), "none came after them");
    row
}

#[test]
fn a_canary_whose_program_hangs_and_whose_body_is_stopped_goes_back_and_moves_when_a_person_says_so() {
    for (seed, first) in [(70, First::Person), (71, First::Gate)] {
        let mut scene = Scene::open(seed, 6);
        scene.begin("bad", HANGS, |_| {});
        let canary = scene.some_is_in(UpdateState::Probation);
        let row = stopped_canaries_go_back(&mut scene, &[canary], first);
        let code = row.abort.map(|abort| abort.reason.code);
        let wanted = if first == First::Person { Code::AbortedByPerson } else { Code::FailureAmongFew };
        assert_eq!(code, Some(wanted));
    }
}

/// Brings a bundle that is bad with a load onto both canaries, who then work with it.
fn two_on_trial(seed: u64) -> (Scene, Vec<usize>) {
    let mut scene = Scene::open(seed, 6);
    scene.begin("bad", BAD_WITH_LOAD, |spec| {
        two_first(spec);
        spec.soak = seconds(1_500);
    });
    scene.until("both on trial", |room| {
        let mut seen = room.observer.lock();
        let on_trial = |robot: &usize| {
            seen.changes().state(&room.hall.robots()[*robot].robot_id().clone()) == Some(UpdateState::Trial)
        };
        (0..6).filter(on_trial).count() == 2
    });
    let canaries = scene.robots_in(UpdateState::Trial);
    (scene, canaries)
}

fn two_first(spec: &mut RolloutSpec) {
    waves(spec, &[Size::Count(2), Size::Rest(true)]);
    spec.allow_full_push = true;
}

#[test]
fn canaries_that_are_stopped_at_work_go_back_where_they_stand_and_move_when_a_person_says_so() {
    let (mut scene, canaries) = two_on_trial(72);
    each_moves(&mut scene, "the canaries to work", &canaries);
    let row = stopped_canaries_go_back(&mut scene, &canaries, First::Gate);
    assert_eq!(row.abort.map(|a| (a.reason.code, a.hard)), Some((Code::HardwareStopOnTrial, true)));
}

#[test]
fn a_person_ends_a_roll_out_whose_canaries_were_stopped_too_late_to_count_and_they_go_back_as_they_stand() {
    let (mut scene, canaries) = two_on_trial(73);
    scene.pass(limits::HARDWARE_STOP_COUNTS.as_ms() + 10_000);
    each_moves(&mut scene, "the canaries to work", &canaries);
    let row = stopped_canaries_go_back(&mut scene, &canaries, First::Person);
    assert_eq!(row.abort.map(|a| a.reason.code), Some(Code::AbortedByPerson));
}

/// From the moment of its switch on a canary does not reach its server, alone or like everybody, until it has gone back by itself.
fn never_reaches_its_server(seed: u64, alone: bool) -> (Scene, usize) {
    let mut scene = Scene::open(seed, 6);
    scene.begin("first", GOOD[0], |_| {});
    let canary = scene.some_is_in(UpdateState::Switching);
    let cut: Vec<usize> = if alone { vec![canary] } else { scene.all().into_iter().collect() };
    cut.iter().for_each(|robot| steer(&mut scene.room, *robot, LineState::Cut));
    let since_ms = scene.room.now_ms();
    assert_eq!(scene.some_is_in(UpdateState::Probation), canary);
    assert_eq!(scene.runs(canary), scene.bundle(GOOD[0]), "it runs what it was to be tried with");
    let before_ms = 10_000;
    scene.pass(600_000 - before_ms - (scene.room.now_ms() - since_ms));
    assert_eq!(scene.robots_in(UpdateState::Probation), [canary], "it waits for its server to the end");
    let row = scene.row("first");
    if alone {
        assert_eq!((row.phase.goes_back(), row.pauses.len()), (true, 0), "{row:?}");
    } else {
        assert_eq!((row.abort.as_ref(), row.pauses.contains(&Pause::Infrastructure)), (None, true), "{row:?}");
    }
    scene.pass(LOST_SERVER_MS - 600_000 + before_ms);
    assert_eq!(scene.robots_in(UpdateState::RolledBack), [canary], "it went back without being told");
    assert_eq!(scene.runs(canary), None, "it is on what it kept");
    // It is heard before the others, which tell nothing of the network while they come back.
    steer(&mut scene.room, canary, LineState::Open);
    scene.until("the server to hear it", |room| {
        let seen = room.observer.lock().changes().rollout("first").cloned();
        seen.is_some_and(|row| row.phase.is_over() || row.pauses.is_empty())
    });
    cut.iter().for_each(|robot| steer(&mut scene.room, *robot, LineState::Open));
    (scene, canary)
}

#[test]
fn a_robot_that_goes_back_because_nobody_reached_the_server_burns_no_bundle() {
    let (mut scene, canary) = never_reaches_its_server(75, false);
    // The wave has shown nothing, for or against: a person is asked, and goes on.
    scene.comes_to("first", Phase::Review);
    assert_eq!(scene.runs(canary), None);
    scene.order(Order::Promote("first".to_owned()));
    let row = scene.ends("first");
    assert_eq!((row.phase, &row.abort), (Phase::Completed, &None), "{row:?}");
    assert!(row.verdicts.iter().all(|v| v.robots.outcomes.failed == 0), "{row:?}");
    scene.comes_to_rest();
    assert_eq!(scene.runs(canary), None);
}

#[test]
fn a_robot_that_alone_never_reached_its_server_is_back_by_itself_and_does_not_get_the_bundle_again() {
    let (mut scene, canary) = never_reaches_its_server(76, true);
    let row = scene.ends("first");
    assert_eq!(row.phase, Phase::Aborted);
    assert_eq!(row.verdicts.last().map(|v| (v.attempted, v.robots.outcomes.failed)), Some((1, 1)), "{row:?}");
    scene.comes_to_rest();
    scene.all_run(None);
    // The server has confirmed that the bundle lost it: others may try it, this robot does not.
    scene.begin("again", GOOD[0], |_| {});
    assert_eq!(scene.ends("again").phase, Phase::Completed);
    scene.comes_to_rest();
    for robot in scene.all() {
        let wanted = scene.bundle(GOOD[0]).filter(|_| robot != canary);
        assert_eq!(scene.runs(robot), wanted, "robot {robot}");
    }
}
#[test]
fn a_bundle_that_is_bad_only_with_a_load_touches_no_more_than_its_canaries_and_they_are_back() {
    // Bodies as they are: obstacles now and then, a thousand times as many with this bundle and a load. Without jams, after which a
    // person has to look for the load.
    let faults = FaultRates { jam_per_action: 0.0, silence_per_hour: 0.0, ..FaultRates::default() };
    let mut scene = Scene::with(RoomConfig { faults, ..config(74, 10, Naive::default()) });
    scene.begin("bad", BAD_WITH_LOAD, |spec| {
        two_first(spec);
        spec.exposure_tasks = Some(12);
        spec.exposure_within = seconds(1_800);
    });
    // Work never ends while it is judged.
    let (mut goes_back, mut next_ms) = (false, 0);
    while !goes_back {
        scene.work(12);
        next_ms = scene.room.now_ms().max(next_ms) + 60_000;
        scene.until("the roll-out to go back, or a minute to pass", |room| {
            let row = room.observer.lock().changes().rollout("bad").map(|row| row.phase.goes_back());
            goes_back = row == Some(true);
            goes_back || room.now_ms() >= next_ms
        });
    }
    let at_abort = scene.activations();
    let row = scene.ends("bad");
    assert_eq!(row.phase, Phase::Aborted);
    let abort = row.abort.as_ref().expect("a reason");
    assert_eq!((abort.reason.code, abort.hard), (Code::FailureAmongFew, false), "{row:?}");
    assert!((1..=2).contains(&abort.touched), "{abort:?}");
    let verdict = row.verdicts.last().expect("evidence");
    assert_eq!((verdict.outcome, verdict.wave), (Outcome::Aborted, 0), "{verdict:?}");
    assert!(verdict.robots.outcomes.failed >= 1 && verdict.attempted == abort.touched, "{verdict:?}");
    let (trial, control) = (&verdict.tasks.trial, &verdict.tasks.control);
    let all = |tally: &TaskTally| tally.succeeded + tally.failed;
    assert!(trial.failed * all(control) > control.failed * all(trial), "tasks fail more often with it: {verdict:?}");
    scene.comes_to_rest();
    scene.all_run(None);
    // A permission that was alive at the abort may still be used: then its robot is among the touched.
    let touched = u64::from(abort.touched);
    assert!(at_abort <= scene.activations() && scene.activations() <= touched, "{at_abort} at the abort, {abort:?}");
}
