//! Places that people block for a while, and ways around places that are closed.

use crate::harness::World;
use midshift_core::fleet::WAITS_FOR;
use midshift_core::fleet::rows::{HolderState, PlaceBlock};
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::common::v1::Reason;
use midshift_proto::convert::duration;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use tonic::Code;

/// The corridor, and a longer one beside it.
fn two_corridors() -> &'static str {
    let site = CORRIDOR
        .replace("waypoint = [", "waypoint = [\n{ id = \"c-3\", at = [7000, -9000] },\n{ id = \"c-4\", at = [13000, -9000] },")
        .replace(
            "lane = [",
            "lane = [\n{ path = [\"wait-a\", \"c-3\"] },\n{ path = [\"c-3\", \"a-in\"] },\n\
             { path = [\"c-3\", \"c-4\"], ways = \"two\" },\n{ path = [\"c-4\", \"b-in\"] },\n{ path = [\"wait-b\", \"c-4\"] },",
        )
        .replace(
            "passage = [",
            "passage = [\n{ id = \"around\", rule = \"exclusive\", waypoints = [\"c-3\", \"c-4\"] },",
        );
    Box::leak(site.into_boxed_str())
}

async fn block(w: &World, place_id: &str, lasts_ms: Option<u64>) -> v1::Place {
    let request = v1::BlockPlaceRequest {
        place_id: place_id.to_owned(),
        reason: "a spill".to_owned(),
        lasts: lasts_ms.map(duration),
        ..Default::default()
    };
    w.fleet.block_place(local(request)).await.expect("blocked").into_inner().place.expect("the place")
}

async fn unblock(w: &World, place_id: &str) -> Result<v1::Place, tonic::Status> {
    let (place_id, reason) = (place_id.to_owned(), "it is dry".to_owned());
    let request = v1::UnblockPlaceRequest { place_id, reason, ..Default::default() };
    Ok(w.fleet.unblock_place(local(request)).await?.into_inner().place.expect("the place"))
}

async fn why_robot(w: &World, robot_id: &str) -> Reason {
    let request = v1::ExplainRobotRequest { robot_id: robot_id.to_owned() };
    let told = w.fleet.explain_robot(local(request)).await.expect("told").into_inner();
    told.explanation.and_then(|told| told.verdict).unwrap_or_default()
}

#[tokio::test(start_paused = true)]
async fn nobody_is_let_into_a_blocked_place_until_its_time_is_over_and_who_waits_is_told_why() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.has("r1", "A")).await;
    let place = block(&w, "corridor", Some(120_000)).await;
    let shown = place.block.expect("it is shown");
    assert_eq!((shown.reason.as_str(), shown.until.is_some()), ("a spill", true));
    w.r("r1").works = true;
    w.until("it stands before it", |s| s.holders("wait-a") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.pass_while(20, "it is not let in", |s| !s.has("r1", "corridor")).await;
    let told = why_robot(&w, "r1").await;
    assert_eq!((told.code.as_str(), told.metadata["blocked"].as_str()), ("PLACE_BLOCKED", "corridor"), "{told:?}");
    assert!(told.message.contains("a spill") && told.message.contains("zone unblock corridor"), "{told:?}");
    assert!(told.metadata.contains_key(WAITS_FOR), "{told:?}");
    let over = w.seen().await.all::<PlaceBlock>()[0].until.expect("an end");
    let seen = w.until("it is let in", |s| s.has("r1", "corridor")).await;
    assert!(seen.all::<PlaceBlock>().is_empty() && seen.place("corridor").holders[0].since >= over);
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn who_was_let_in_before_drives_through_and_the_next_waits_for_a_person() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.submit_with("T1", "A", "B", |raw| raw.robot_id = "r1".to_owned()).await;
    w.until("it is inside", |s| s.holders("corridor") == [("r1".to_owned(), HolderState::Inside)]).await;
    let place = block(&w, "corridor", None).await;
    assert_eq!(place.holders.len(), 1, "it says who is inside");
    w.until_phase("T1", Phase::Succeeded).await;
    w.submit_with("T2", "B", "A", |raw| raw.robot_id = "r2".to_owned()).await;
    w.pass_while(200, "it waits", |s| !s.has("r2", "corridor")).await;
    let listed = w.fleet.list_places(local(v1::ListPlacesRequest { in_use: true, ..Default::default() })).await;
    let listed = listed.expect("places").into_inner().places;
    assert!(listed.iter().any(|place| place.place_id == "corridor" && place.block.is_some()));
    assert_eq!(unblock(&w, "corridor").await.expect("opened").block, None);
    w.until_phase("T2", Phase::Succeeded).await;
    let again = unblock(&w, "corridor").await.expect_err("it is open");
    assert_eq!(again.code(), Code::FailedPrecondition);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_stands_before_a_blocked_place_drives_around_it_and_a_new_task_too() {
    let mut w = World::on(two_corridors()).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until("it stands in A", |s| s.has("r1", "A")).await;
    let leads = |work: &midshift_core::desired_state::DesiredWork, place: &str| {
        let route = &work.assignment.as_ref().expect("work").route;
        route.iter().any(|point| point.passages.iter().any(|passage| passage.as_str() == place))
    };
    assert!(leads(&seen.work("r1"), "corridor"), "the shorter way");
    block(&w, "corridor", None).await;
    w.r("r1").works = true;
    let seen = w.until("it drives around", |s| s.has("r1", "around")).await;
    assert!(leads(&seen.work("r1"), "around") && !leads(&seen.work("r1"), "corridor"));
    w.until_phase("T1", Phase::Succeeded).await;
    w.submit("T2", "B", "A").await;
    w.until("the next goes around as well", |s| s.has("r1", "around")).await;
    w.until_phase("T2", Phase::Succeeded).await;
    let entered =
        w.written().await.into_iter().filter(|entry| &*entry.subject == "corridor" && &*entry.kind == "place.granted");
    assert_eq!(entered.count(), 0, "nobody was let in");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_whose_goal_is_blocked_waits_and_says_so() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    block(&w, "A", None).await;
    w.submit("T1", "A", "B").await;
    w.pass_while(20, "it waits", |s| s.phase("T1") == Phase::Queued).await;
    let request = v1::ExplainTaskRequest { task_id: "T1".to_owned() };
    let told = w.fleet.explain_task(local(request)).await.expect("told").into_inner().explanation.expect("told");
    let candidate = told.candidates.first().and_then(|robot| robot.reason.clone()).expect("a reason");
    assert_eq!(candidate.code, "PLACE_BLOCKED", "{told:?}");
    unblock(&w, "A").await.expect("opened");
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn everything_that_is_wrong_with_a_block_is_told_at_once_and_nothing_is_kept() {
    let w = World::on(CORRIDOR).await;
    let wrong = v1::BlockPlaceRequest {
        place_id: "Not an id".to_owned(),
        lasts: Some(duration(999)),
        request_id: "no spaces".to_owned(),
        ..Default::default()
    };
    let refused = w.fleet.block_place(local(wrong)).await.expect_err("wrong");
    for field in ["place_id", "lasts", "request_id", "reason"] {
        assert!(format!("{refused:?}").contains(field), "{field}: {refused:?}");
    }
    let unknown =
        v1::BlockPlaceRequest { place_id: "nowhere".to_owned(), reason: "a spill".to_owned(), ..Default::default() };
    assert_eq!(w.fleet.block_place(local(unknown.clone())).await.expect_err("unknown").code(), Code::NotFound);
    let checked = v1::BlockPlaceRequest { place_id: "corridor".to_owned(), validate_only: true, ..unknown };
    w.fleet.block_place(local(checked)).await.expect("it would do");
    assert!(w.seen().await.all::<PlaceBlock>().is_empty());
}

#[tokio::test(start_paused = true)]
async fn nobody_is_sent_to_a_charger_that_only_a_blocked_way_reaches() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    block(&w, "corridor", None).await;
    w.r("r1").battery_permille = 150;
    w.pass_while(20, "it stays where it is", |s| s.errand("r1").is_none()).await;
    unblock(&w, "corridor").await.expect("opened");
    let seen = w.until("it goes to charge", |s| s.errand("r1").is_some()).await;
    assert_eq!(seen.errand("r1").map(|(_, goal)| goal), Some("charge".to_owned()));
    w.lawful().await;
}
