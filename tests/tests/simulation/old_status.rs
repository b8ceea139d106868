//! Old STATUS in the same room, directed: a robot that was away for long, and what breaks while it gives what it kept.

use crate::directed::Scene;
use crate::net::LineState;
use crate::run::steer;

/// A robot that made so many samples, at one in two seconds, while nobody heard it.
const AWAY_MS: u64 = 800_000;
const AWAY_SAMPLES: u64 = AWAY_MS / 2_000 * 9 / 10;
/// STATUS of a robot on its session that is not stored yet, samples.
const UNDER_WAY: u64 = 5;

fn backlog(scene: &Scene, robot: usize) -> u64 {
    let (stored, produced) = scene.room.observer.lock().status(&scene.room.robot_id(robot));
    produced - stored
}

fn stored(scene: &Scene, robot: usize) -> u64 {
    scene.room.observer.lock().status(&scene.room.robot_id(robot)).0
}

/// Robot 0 was away and is back.
fn back(seed: u64) -> Scene {
    let mut scene = Scene::open(seed, 2);
    steer(&mut scene.room, 0, LineState::Cut);
    scene.pass(AWAY_MS);
    assert!(backlog(&scene, 0) > AWAY_SAMPLES && backlog(&scene, 1) <= UNDER_WAY);
    steer(&mut scene.room, 0, LineState::Open);
    scene
}

fn some_of_it_comes(scene: &mut Scene) {
    let (robot_id, before) = (scene.room.robot_id(0), stored(scene, 0));
    scene.until("some of it", |room| room.observer.lock().status(&robot_id).0 > before + 100);
    assert!(backlog(scene, 0) > 100, "there is more");
}

fn all_of_it_comes(scene: &mut Scene) {
    let robot_id = scene.room.robot_id(0);
    scene.until("all of it", |room| {
        let (stored, produced) = room.observer.lock().status(&robot_id);
        produced - stored <= UNDER_WAY
    });
    // And it goes on live.
    scene.pass(20_000);
    assert!(backlog(scene, 0) <= UNDER_WAY);
    assert_eq!(scene.findings(), Vec::<String>::new());
}

#[test]
fn a_robot_that_was_away_gives_its_status_in_order_and_once() {
    all_of_it_comes(&mut back(90));
}

#[test]
fn a_way_that_breaks_in_the_middle_of_it_loses_nothing_and_brings_nothing_twice() {
    for (seed, way) in [(91, LineState::Cut), (92, LineState::CutDown), (93, LineState::CutUp), (94, LineState::Held)] {
        let mut scene = back(seed);
        some_of_it_comes(&mut scene);
        steer(&mut scene.room, 0, way);
        scene.pass(30_000);
        steer(&mut scene.room, 0, LineState::Open);
        all_of_it_comes(&mut scene);
    }
}

#[test]
fn a_server_and_an_agent_that_crash_in_the_middle_of_it_lose_nothing() {
    let mut scene = back(95);
    some_of_it_comes(&mut scene);
    scene.room.crash_server();
    scene.pass(5_000);
    scene.room.restart_server();
    all_of_it_comes(&mut scene);
    let mut scene = back(96);
    some_of_it_comes(&mut scene);
    scene.room.crash_agent(0, true);
    scene.pass(5_000);
    scene.room.restart_agent(0);
    all_of_it_comes(&mut scene);
}
