//! Places that robots say they are in without a grant of ours: which of them are believed, and until when.

use crate::harness::{Seen, World};
use crate::places::claim;
use midshift_core::fleet::rows::HolderState;
use midshift_core::ids::{AttemptId, PlaceId, Subject, WaypointId};
use midshift_core::limits;
use midshift_core::robot::WorkState;
use midshift_core::robot::{Pose, ReportedAttempt};
use midshift_core::robot_events::{PlaceNews, RobotEvent};
use midshift_core::rows::Record;
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::stop::Region;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

/// Every place of the site but the one that the robot stands in.
fn elsewhere(w: &World, stands: &str) -> Vec<String> {
    w.site.places().iter().map(|place| place.place_id.to_string()).filter(|id| id != stands).collect()
}

/// How many of these places the robot holds.
fn held(seen: &Seen, robot: &str, places: &[String]) -> usize {
    places.iter().filter(|id| seen.has(robot, id)).count()
}

/// The robot lists these places from now on, and says by events, if at all, that it entered each.
fn tell(w: &mut World, robot: &str, places: &[String], by_event: bool) {
    w.r(robot).claims = places.iter().map(|id| claim(id)).collect();
    for id in places.iter().filter(|_| by_event) {
        enters(w, robot, id, 0);
    }
}

fn enters(w: &mut World, robot: &str, place: &str, grant_id: u64) {
    let place_id = PlaceId::parse(place).expect("a place");
    w.r(robot).says(RobotEvent::Place { place_id, grant_id, news: PlaceNews::Entered });
}

#[tokio::test(start_paused = true)]
async fn of_places_without_a_grant_those_near_the_pose_come_first_however_they_are_told() {
    for by_event in [false, true] {
        let mut w = World::on(DEMO).await;
        w.robot("r1", "park-1").await;
        let at = w.site.waypoint(w.site.find(&WaypointId::parse("Q01").expect("an id")).expect("a waypoint"));
        let mm = |at: i64| i32::try_from(at).expect("a site's size");
        let pose = Pose { x_mm: mm(at.x_mm), y_mm: mm(at.y_mm), theta_mrad: 0 };
        let is_near = |id: &String| {
            let region = Region::of_zone(&w.site, &PlaceId::parse(id).expect("a place")).expect("a region");
            region.is_near(&pose, limits::CLAIMED_PLACE_MARGIN_MM)
        };
        let (near, far): (Vec<String>, Vec<String>) = elsewhere(&w, "park-1").into_iter().partition(is_near);
        assert!((1..8).contains(&near.len()), "{near:?}");
        w.r("r1").pose = Some(pose);
        w.pass(2).await;
        let told = [far, near.clone()].concat();
        tell(&mut w, "r1", &told, by_event);
        w.pass(5).await;
        let seen = w.seen().await;
        assert_eq!(held(&seen, "r1", &near), near.len(), "{by_event}");
        assert_eq!(held(&seen, "r1", &told), 7, "and park-1 makes eight");
        assert!(seen.has("r1", "park-1"), "what it held before");
        w.lawful().await;
    }
}

#[tokio::test(start_paused = true)]
async fn of_a_robot_without_a_pose_eight_places_are_taken_as_its_events_tell_them() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    w.pass(2).await;
    let mut told = elsewhere(&w, "park-1");
    told.reverse();
    tell(&mut w, "r1", &told, true);
    w.pass(5).await;
    let seen = w.seen().await;
    assert_eq!(held(&seen, "r1", &told[..7]), 7, "the first, beside park-1");
    assert_eq!(held(&seen, "r1", &told), 7, "and no more");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_held_before_it_said_too_much_stays_held() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    let all = elsewhere(&w, "park-1");
    let (before, others) = all.split_at(3);
    tell(&mut w, "r1", before, false);
    w.until("it holds them", |s| held(s, "r1", before) == 3).await;
    tell(&mut w, "r1", others, false);
    w.until("it has said too much", |s| s.open_incidents("PLACES_IMPLAUSIBLE").len() == 1).await;
    w.pass_while(30, "they stay held", |s| held(s, "r1", before) == 3 && held(s, "r1", &all) == 7).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_works_once_a_person_has_closed_the_incident_until_it_says_that_it_is_in_other_places() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    w.r("r1").drives = false;
    let all = elsewhere(&w, "park-1");
    let (told, others) = all.split_at(12);
    let open = |s: &Seen| s.open_incidents("PLACES_IMPLAUSIBLE");
    tell(&mut w, "r1", told, false);
    let seen = w.until("a person is told", |s| open(s).len() == 1).await;
    w.submit_with("T1", "D01", "D02", |raw| raw.robot_id = "r1".to_owned()).await;
    w.pass_while(10, "it gets no work", |s| s.phase("T1") == Phase::Queued).await;
    let (incident_id, reason) = (open(&seen)[0].id(), "a wrong map in it, and it stands in park-1".to_owned());
    let close = v1::CloseIncidentRequest { incident_id, reason, ..Default::default() };
    w.fleet.close_incident(local(close)).await.expect("closed");
    w.until("it gets work", |s| s.phase("T1") != Phase::Queued).await;
    w.pass_while(10, "nobody is told again", |s| open(s).is_empty()).await;
    tell(&mut w, "r1", others, false);
    w.until("a person is told of the others", |s| open(s).len() == 1).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_entry_on_a_grant_that_nobody_gave_is_an_incident_though_the_robot_holds_the_place() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.until("it is there", |s| s.holders("park-a") == [("r1".to_owned(), HolderState::Inside)]).await;
    enters(&mut w, "r1", "park-a", 4_711);
    w.pass(3).await;
    let seen = w.seen().await;
    assert_eq!(seen.open_incidents("GRANT_UNKNOWN").len(), 1);
    assert_eq!(seen.holders("park-a"), [("r1".to_owned(), HolderState::Inside)], "it keeps the place");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn for_ten_minutes_after_a_restore_unknown_grants_are_no_incident_and_no_attempt_is_disowned() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    w.r("r1").applied = w.clock.now().wall.0 as u64 + 86_400_000;
    w.connect("r1").await;
    w.until("the store is behind", |s| s.open_incidents("STORE_BEHIND_ROBOT").len() == 1).await;
    let attempt = AttemptId { subject: Subject::parse("T-elsewhere").expect("a subject"), epoch: 3 };
    let state = WorkState::Executing;
    let listed = ReportedAttempt { attempt, state, step_index: 1, progress: 1, route_index: 0, opened: false };
    w.r("r1").lists = vec![listed];
    enters(&mut w, "r1", "charge", 4_711);
    w.pass(3).await;
    let ask = v1::DisownAttemptRequest {
        robot_id: "r1".to_owned(),
        subject: "T-elsewhere".to_owned(),
        epoch: 3,
        reason: "a leftover".to_owned(),
        ..Default::default()
    };
    let refused = w.fleet.disown_attempt(local(ask.clone())).await.expect_err("it may be ours");
    assert!(refused.message().contains("restored"), "{refused}");
    assert!(w.seen().await.open_incidents("GRANT_UNKNOWN").is_empty());
    w.pass(600).await;
    enters(&mut w, "r1", "charge", 4_712);
    w.pass(3).await;
    assert_eq!(w.seen().await.open_incidents("GRANT_UNKNOWN").len(), 1);
    w.fleet.disown_attempt(local(ask)).await.expect("it is ignored");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_lost_its_memory_inside_a_passage_keeps_it_until_its_pose_lies_elsewhere() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let passage = w.site.places().iter().find(|place| place.waypoint().is_none()).expect("a passage").place_id.clone();
    let region = Region::of_zone(&w.site, &passage).expect("a region");
    let mm = |at: i64| i32::try_from(at).expect("a site's size");
    let poses = w.site.waypoints().iter().map(|at| Pose { x_mm: mm(at.x_mm), y_mm: mm(at.y_mm), theta_mrad: 0 });
    let (inside, outside): (Vec<Pose>, Vec<Pose>) = poses.partition(|pose| region.is_near(pose, 0));
    w.r("r1").pose = Some(inside[0]);
    let told = [passage.to_string()];
    tell(&mut w, "r1", &told, false);
    w.pass(3).await;
    assert_eq!(held(&w.seen().await, "r1", &told), 1, "it is inside");
    w.r("r1").claims.clear();
    w.pass_while(10, "it is there by its own pose", |seen| held(seen, "r1", &told) == 1).await;
    w.r("r1").pose = Some(outside[0]);
    w.until("it has driven away", |seen| held(seen, "r1", &told) == 0).await;
    w.lawful().await;
}
