//! A changed map: what people are told of it.

use crate::harness::World;
use midshift_core::fleet::maps::{MapChange, Obstacle};
use midshift_core::ids::{PlaceId, RobotId, TaskId};
use midshift_core::robot::Mode;
use midshift_core::site::CORRIDOR;

fn obstacles() -> Vec<Obstacle> {
    vec![
        Obstacle::Task(TaskId::parse("T1").expect("an id")),
        Obstacle::Robot(RobotId::parse("r1").expect("an id")),
        Obstacle::Place(PlaceId::parse("park-a").expect("an id")),
    ]
}

async fn started_with(w: &mut World, map: MapChange) {
    w.map = map;
    w.stop_fleet().await;
    w.start_fleet();
    w.pass(2).await;
}

#[tokio::test(start_paused = true)]
async fn a_map_that_is_not_taken_is_one_incident_which_closes_once_it_is() {
    let mut w = World::on(CORRIDOR).await;
    let waits = MapChange::NotTaken { version: "2".to_owned(), obstacles: obstacles() };
    for _ in 0..2 {
        started_with(&mut w, waits.clone()).await;
        let open = w.seen().await.open_incidents("MAP_NOT_TAKEN");
        assert_eq!(open.len(), 1);
        let said = |key: &str| open[0].reason.metadata.get(key).map(String::as_str);
        assert_eq!((said("map_version"), said("stored")), (Some("2"), Some("1")));
        assert_eq!((said("tasks"), said("robots"), said("places")), (Some("T1"), Some("r1"), Some("park-a")));
    }
    started_with(&mut w, MapChange::Taken).await;
    assert!(w.seen().await.open_incidents("MAP_NOT_TAKEN").is_empty());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_map_that_is_forced_is_an_incident_of_each_thing_that_was_in_its_way() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    started_with(&mut w, MapChange::Forced { obstacles: obstacles() }).await;
    // The projection is read anew after an outage: nobody is told again.
    w.shaky.fail(true);
    w.r("r1").set_mode(Mode::Manual);
    w.pass(2).await;
    assert!(w.shaky.failed() > 0, "the fault happened");
    w.shaky.fail(false);
    w.pass(2).await;
    let open = w.seen().await.open_incidents("MAP_FORCED");
    assert_eq!(open.len(), 3);
    assert!(open.iter().any(|i| i.task_id.is_some()) && open.iter().any(|i| i.robot_id.is_some()));
    assert!(open.iter().any(|i| i.reason.metadata.get("place_id").is_some_and(|id| id == "park-a")));
    w.lawful().await;
}
