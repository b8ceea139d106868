//! Starting places: what the site keeps for robots that have not been heard yet.

use crate::harness::World;
use midshift_core::fleet::rows::HolderState;
use midshift_core::reason::Code;
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

/// The corridor, where these robots start.
fn site(robots: &[(&str, &str)]) -> &'static str {
    let robots: Vec<String> = robots.iter().map(|(id, at)| format!("{{ id = \"{id}\", at = \"{at}\" }}")).collect();
    format!("{CORRIDOR}\nrobot = [{}]\n", robots.join(", ")).leak()
}

async fn awaited(w: &World, place: &str) -> Vec<String> {
    let listed = w.fleet.list_places(local(v1::ListPlacesRequest::default())).await.expect("places");
    let mut places = listed.into_inner().places.into_iter();
    places.find(|p| p.place_id == place).expect("a place").awaited_robot_ids
}

#[tokio::test(start_paused = true)]
async fn nobody_is_sent_to_rest_where_a_robot_starts_that_was_not_heard_yet() {
    let mut w = World::on(site(&[("r2", "park-a")])).await;
    w.robot("r1", "A").await;
    let seen = w.until("r1 is on its way to park", |s| s.errand("r1").is_some()).await;
    assert_ne!(seen.errand("r1").map(|(_, goal)| goal).as_deref(), Some("park-a"));
    w.until("r1 rests", |s| s.is_free("r1") && !s.has("r1", "A")).await;
    assert_eq!(awaited(&w, "park-a").await, ["r2"]);
    w.robot("r2", "park-a").await;
    w.until("r2 stands there", |s| s.holders("park-a") == [("r2".to_owned(), HolderState::Inside)]).await;
    assert!(awaited(&w, "park-a").await.is_empty());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_waits_for_a_place_that_is_kept_for_another_and_explain_says_for_whom() {
    let mut w = World::on(site(&[("r2", "charge")])).await;
    w.robot("r1", "A").await;
    w.submit_with("T1", "A", "charge", |raw| {
        (raw.robot_id, raw.stall_ms) = ("r1".to_owned(), Some(3_600_000));
    })
    .await;
    w.until("r1 has its item", |s| s.task("T1").opened_robot_id.is_some()).await;
    w.pass_while(100, "the charger is not given", |s| s.holders("charge").is_empty()).await;
    let told = w.fleet.explain_task(local(v1::ExplainTaskRequest { task_id: "T1".to_owned() })).await;
    let verdict = told.expect("an explanation").into_inner().explanation.and_then(|e| e.verdict).expect("a verdict");
    assert_eq!(verdict.code, Code::PlaceOccupied.as_str());
    assert_eq!(verdict.metadata.get("kept_for").map(String::as_str), Some("r2"), "{verdict:?}");
    w.robot("r2", "charge").await;
    w.pass(5).await;
    w.submit_with("T2", "B", "A", |raw| raw.robot_id = "r2".to_owned()).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_was_heard_once_has_no_place_kept_after_fleet_starts_again() {
    let mut w = World::on(site(&[("r1", "park-a"), ("r2", "park-b")])).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("r1 has left its place", |s| !s.has("r1", "park-a") && !s.holders("A").is_empty()).await;
    w.stop_fleet().await;
    w.start_fleet();
    assert!(awaited(&w, "park-a").await.is_empty());
    assert_eq!(awaited(&w, "park-b").await, ["r2"]);
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}
