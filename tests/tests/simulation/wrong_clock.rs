//! A shift in the middle of which the server's wall is thirty days ahead for a minute, from end to end: docs/runbooks/clock.md and record 0099.

use crate::directed::{Scene, waves};
use crate::software::GOOD;
use midshift_core::rollout::rows::{Pause, Phase};
use midshift_core::task::machine::Phase as TaskPhase;
use midshift_proto::ota::v1::rollout_wave::Size;
use std::collections::BTreeSet;

const MINUTE_MS: u64 = 60_000;
const MONTH_MS: i64 = 30 * 24 * 3_600_000;
const TASKS: usize = 4;
/// Robots that soak when the wall is set, and those whose roll-out begins while it is wrong.
const SOAKING: [usize; 2] = [0, 1];
const BEGUN: [usize; 2] = [2, 3];

/// Sessions that robots began so far.
fn sessions(scene: &Scene) -> u64 {
    scene.room.observer.lock().counts().get("session begun").copied().unwrap_or(0)
}

/// A shift of robots that have all had an update, so that they know what time it is; two soak in a second one. The server looks at its documents, once a
/// minute, a moment later.
fn shift(seed: u64) -> Scene {
    let mut scene = Scene::open(seed, 4);
    scene.begin("before", GOOD[0], |_| {});
    assert_eq!(scene.ends("before").phase, Phase::Completed);
    scene.begin_for("soaking", GOOD[1], &BTreeSet::from(SOAKING), false, |spec| {
        waves(spec, &[Size::Rest(true)]);
        spec.allow_full_push = true;
        spec.soak = Some(prost_types::Duration { seconds: 300, nanos: 0 });
    });
    scene.comes_to("soaking", Phase::Soaking);
    let past_ms = scene.room.now_ms() % MINUTE_MS;
    scene.pass((2 * MINUTE_MS - 2_000 - past_ms) % MINUTE_MS);
    scene.work(TASKS);
    scene
}

/// The wall is wrong for a minute, in which another roll-out begins. It is to be set right by whoever asks.
fn wrong_minute(scene: &mut Scene) {
    let end_ms = scene.room.now_ms() + MINUTE_MS;
    scene.room.wall.set(MONTH_MS);
    scene.pass(15_000);
    scene.begin_for("begun", GOOD[1], &BTreeSet::from(BEGUN), false, |_| {});
    scene.until("the minute to be over", |room| room.now_ms() >= end_ms);
}

#[test]
fn a_server_whose_wall_is_a_month_ahead_for_a_minute_ends_no_session_and_goes_on_with_updates() {
    let mut scene = shift(90);
    let before = (sessions(&scene), scene.activations());
    wrong_minute(&mut scene);
    for id in ["soaking", "begun"] {
        assert!(scene.row(id).pauses.contains(&Pause::Keyless), "{id} stands while the clock is in doubt");
    }
    assert_eq!(scene.row("soaking").phase, Phase::Soaking, "no soak is over by that");
    scene.room.wall.set(0);
    scene.pass(1_000);
    assert_eq!((sessions(&scene), scene.activations()), before, "no session ended, and nobody was told anything");
    assert_eq!(scene.ends("begun").phase, Phase::Completed);
    assert_eq!(scene.ends("soaking").phase, Phase::Completed);
    scene.begin("after", GOOD[2], |_| {});
    assert_eq!(scene.ends("after").phase, Phase::Completed);
    scene.until("all tasks to be done", |room| {
        let seen = room.observer.lock();
        seen.tasks().len() == TASKS && seen.tasks().values().all(|task| task.phase == TaskPhase::Succeeded)
    });
    scene.comes_to_rest();
    scene.all_run(Some(GOOD[2]));
}

#[test]
fn a_server_that_signs_by_any_wall_keeps_robots_from_updates_when_the_wall_is_right_again() {
    let mut scene = shift(91);
    scene.room.wall.believe();
    wrong_minute(&mut scene);
    assert!(scene.row("begun").pauses.is_empty(), "its robots are told by that wall");
    scene.room.wall.set(0);
    // By then the server has signed anew by the right time.
    scene.pass(2 * MINUTE_MS);
    scene.begin_for("after", GOOD[2], &scene.all(), true, |_| {});
    scene.pass(4 * MINUTE_MS);
    let wanted = scene.bundle(GOOD[2]);
    let is_behind = BEGUN.into_iter().any(|robot| scene.runs(robot) != wanted);
    assert!(is_behind, "one that was told by that wall believes that it is days later, and refuses what is signed now");
}
