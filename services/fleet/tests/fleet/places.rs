//! Places: who waits, who goes, and what a reconnect does to a permission.

use crate::harness::World;
use midshift_core::fleet::rows::HolderState;
use midshift_core::ids::PlaceId;
use midshift_core::robot::HeldPlace;
use midshift_core::robot_events::{PlaceNews, RobotEvent};
use midshift_core::site::{CORRIDOR, DEMO};
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;

#[tokio::test(start_paused = true)]
async fn the_second_robot_waits_before_an_exclusive_passage_and_goes_when_the_first_has_left() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.submit_with("T1", "A", "charge", |raw| {
        raw.robot_id = "r1".to_owned();
        raw.stall_ms = Some(3_600_000);
    })
    .await;
    w.until("r1 has the corridor", |s| s.has("r1", "corridor")).await;
    w.r("r1").drives = false;
    w.submit_with("T2", "B", "A", |raw| raw.robot_id = "r2".to_owned()).await;
    w.until("r2 stands before it", |s| s.holders("wait-b") == [("r2".to_owned(), HolderState::Inside)]).await;
    w.pass_while(100, "one robot at a time", |s| s.has("r1", "corridor") && !s.has("r2", "corridor")).await;
    let waits = v1::ListPlacesRequest { in_use: true, ..Default::default() };
    let listed = w.fleet.list_places(local(waits)).await.expect("places").into_inner().places;
    let corridor = listed.iter().find(|p| p.place_id == "corridor").expect("the corridor");
    assert!(!corridor.holders.is_empty() && format!("{corridor:?}").contains("r2"), "{corridor:?}");
    w.r("r1").drives = true;
    w.until("r1 has left", |s| !s.has("r1", "corridor")).await;
    w.until("r2 has it", |s| s.has("r2", "corridor")).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn who_stands_for_a_place_for_a_minute_is_written_down_each_minute() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    for (task, robot, from) in [("T1", "r1", "A"), ("T2", "r2", "B")] {
        w.submit_with(task, from, "charge", |raw| {
            (raw.robot_id, raw.stall_ms) = (robot.to_owned(), Some(3_600_000));
        })
        .await;
        w.until("it has its way, or stands for it", |s| s.has("r1", "corridor")).await;
        w.r("r1").drives = false;
    }
    // Nobody needs its place, so it goes to no bay.
    w.until("r2 stands at B", |s| s.holders("B") == [("r2".to_owned(), HolderState::Inside)]).await;
    w.pass_while(30, "not yet a minute", |s| s.control("r2").waited_for_place.is_none()).await;
    let seen = w.until("it is written down", |s| s.control("r2").waited_for_place.is_some()).await;
    let first = seen.control("r2").waited_for_place;
    w.until("it is written down again", |s| s.control("r2").waited_for_place > first).await;
    assert_eq!(w.seen().await.control("r1").waited_for_place, None);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn who_does_not_drive_the_way_that_it_has_does_not_stand_for_a_place_behind_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r2", "B").await;
    w.robot("r1", "park-a").await;
    w.r("r2").drives = false;
    w.r("r1").drives = false;
    w.submit_with("T1", "B", "A", |raw| (raw.robot_id, raw.stall_ms) = ("r1".to_owned(), Some(3_600_000))).await;
    w.until("it has its way to the corridor", |s| s.has("r1", "wait-a")).await;
    w.pass_while(300, "it stands where it is", |s| s.has("r1", "park-a") && !s.has("r1", "corridor")).await;
    assert_eq!(w.seen().await.control("r1").waited_for_place, None);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_place_that_a_robot_says_it_is_in_is_nobody_elses_though_no_heartbeat_has_said_so_yet() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    // As a robot that has just come: its event is here, and no heartbeat since that counts.
    w.robot("r2", "park-b").await;
    w.r("r2").talks = false;
    let place_id = PlaceId::parse("charge").expect("a place");
    w.r("r2").says(RobotEvent::Place { place_id, grant_id: 0, news: PlaceNews::Entered });
    w.r("r1").battery_permille = 150;
    w.pass_while(30, "r1 does not get the charger", |s| !s.has("r1", "charge")).await;
    assert_eq!(w.seen().await.holders("charge"), [("r2".to_owned(), HolderState::Inside)]);
    let left = PlaceId::parse("charge").expect("a place");
    w.r("r2").says(RobotEvent::Place { place_id: left, grant_id: 0, news: PlaceNews::Left });
    w.until("r1 has the charger", |s| s.has("r1", "charge")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_area_fills_to_its_last_seat_while_all_inside_can_still_leave() {
    // The room at B: three seats, two of them taken.
    let room = ["b-in", "b-out", "b-far", "B", "park-b", "charge"];
    let mut site = CORRIDOR.replacen("]\n\nwaypoint", "  { id = \"room\" },\n]\n\nwaypoint", 1);
    for id in room {
        site = site.replace(&format!("{{ id = \"{id}\", at"), &format!("{{ id = \"{id}\", area = \"room\", at"));
    }
    let mut w = World::on(site.leak()).await;
    w.robot("r1", "park-b").await;
    w.robot("r2", "charge").await;
    w.robot("r3", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| (raw.robot_id, raw.stall_ms) = ("r3".to_owned(), Some(3_600_000))).await;
    let is_inside = |s: &crate::harness::Seen, robot: &str, place: &str| {
        s.holders(place) == [(robot.to_owned(), HolderState::Inside)]
    };
    let r3_inside = |s: &crate::harness::Seen| is_inside(s, "r3", "B");
    w.until("all three are inside", |s| r3_inside(s) && is_inside(s, "r1", "park-b") && is_inside(s, "r2", "charge"))
        .await;
    w.submit_with("T2", "A", "park-a", |raw| raw.robot_id = "r1".to_owned()).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_lost_its_way_out_of_a_passage_gets_it_before_those_who_wait_to_get_in() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "A").await;
    w.robot("r2", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| (raw.robot_id, raw.stall_ms) = ("r1".to_owned(), Some(3_600_000))).await;
    w.until("r1 is in the corridor", |s| s.holders("corridor") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.r("r1").drives = false;
    w.submit_with("T2", "A", "B", |raw| (raw.robot_id, raw.priority) = ("r2".to_owned(), Some(0))).await;
    let r2_inside = ("r2".to_owned(), HolderState::Inside);
    let before = w.until("r2 stands before it", |s| s.holders("wait-a").contains(&r2_inside)).await;
    let grant_of = |s: &crate::harness::Seen| s.place("B").holders.first().map(|h| h.grant_id);
    let first = grant_of(&before).expect("B is granted with the corridor");
    w.r("r1").gives_back("B", first);
    w.until("r1 has it again", |s| s.has("r1", "B") && grant_of(s) != Some(first)).await;
    w.r("r1").drives = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_task_ended_inside_a_passage_is_served_before_those_who_wait_for_the_passage() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "A").await;
    w.submit_with("T1", "B", "A", |raw| (raw.robot_id, raw.stall_ms) = ("r1".to_owned(), Some(3_600_000))).await;
    w.until("r1 is in the corridor", |s| s.holders("corridor") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.r("r1").drives = false;
    w.submit_with("T2", "B", "A", |raw| (raw.robot_id, raw.priority) = ("r2".to_owned(), Some(0))).await;
    let r2_inside = ("r2".to_owned(), HolderState::Inside);
    w.until("r2 stands before it", |s| s.holders("wait-a").contains(&r2_inside)).await;
    w.submit_with("T3", "B", "A", |raw| raw.robot_id = "r1".to_owned()).await;
    w.cancel("T1", false).await;
    w.until_phase("T1", Phase::Canceled).await;
    w.r("r1").drives = true;
    w.until_phase("T3", Phase::Succeeded).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_permission_to_enter_is_anchored_again_after_a_reconnect() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    let seen = w.until("A is granted", |s| s.has("r1", "A")).await;
    let entry = |s: &crate::harness::Seen| {
        s.work("r1").grants.into_iter().find(|g| g.place_id.as_str() == "A").and_then(|g| g.entry)
    };
    let first = entry(&seen).expect("an entry");
    let grant_id = seen.place("A").holders[0].grant_id;
    w.r("r1").cut();
    w.pass(5).await;
    w.r("r1").mend();
    w.connect("r1").await;
    let session = w.r("r1").session_epoch();
    assert!(session > first.session_epoch);
    let seen = w.until("anchored anew", |s| entry(s).is_some_and(|e| e.session_epoch == session)).await;
    assert_eq!(seen.place("A").holders[0].grant_id, grant_id, "the same grant");
    w.r("r1").drives = true;
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_permission_that_is_not_used_stays_fresh() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit_with("T1", "A", "B", |raw| raw.stall_ms = Some(3_600_000)).await;
    let entry = |s: &crate::harness::Seen| {
        s.work("r1").grants.into_iter().find(|g| g.place_id.as_str() == "A").and_then(|g| g.entry)
    };
    let first = entry(&w.until("A is granted", |s| s.has("r1", "A")).await).expect("an entry");
    w.pass(60).await;
    let now = entry(&w.seen().await).expect("an entry");
    assert!(now.hb > first.hb + 40, "{first:?} {now:?}");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_place_nobody_reports_is_cleared_by_a_person_and_not_while_a_heard_robot_stands_in_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").works = false;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    let clear = |etag: String| v1::ClearPlaceRequest {
        place_id: "A".to_owned(),
        reason: "I looked".to_owned(),
        etag,
        ..Default::default()
    };
    let etag = |w: &World| {
        let fleet = w.fleet.clone();
        async move {
            let listed = fleet.list_places(local(v1::ListPlacesRequest::default())).await.expect("places");
            listed.into_inner().places.into_iter().find(|p| p.place_id == "A").expect("A").etag
        }
    };
    let seen = etag(&w).await;
    let refused = w.fleet.clear_place(local(clear(seen))).await.expect_err("a robot stands in it");
    assert_eq!(refused.code(), tonic::Code::FailedPrecondition);
    w.r("r1").cut();
    w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    let seen = etag(&w).await;
    w.fleet.clear_place(local(clear(seen))).await.expect("a person may");
    assert!(w.seen().await.holders("A").is_empty());
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_place_that_a_robot_may_still_enter_is_not_cleared_before_its_permission_is_over() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.r("r1").drives = false;
    w.submit("T1", "A", "B").await;
    let granted = [("r1".to_owned(), HolderState::Granted)];
    w.until("it may enter A", |s| s.holders("A") == granted).await;
    let clear = |w: &World, etag: u64| {
        let (fleet, etag) = (w.fleet.clone(), etag.to_string());
        let (place_id, reason) = ("A".to_owned(), "I looked".to_owned());
        async move {
            let request = v1::ClearPlaceRequest { place_id, reason, etag, ..Default::default() };
            fleet.clear_place(local(request)).await.map_err(|status| status.code())
        }
    };
    let etag = |s: &crate::harness::Seen| s.revision("place_grant", "A");
    let seen = w.seen().await;
    assert_eq!(clear(&w, etag(&seen)).await.err(), Some(tonic::Code::FailedPrecondition), "it is heard");
    w.r("r1").cut();
    w.pass(5).await;
    let seen = w.seen().await;
    assert_eq!(clear(&w, etag(&seen)).await.err(), Some(tonic::Code::FailedPrecondition), "it may be on its way");
    w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    let seen = w.seen().await;
    clear(&w, etag(&seen)).await.expect("its permission is over");
    let told = w.written().await.into_iter().find(|e| &*e.kind == "place.judged_clear").expect("is written");
    assert!(told.body.expect("a body").contains("I looked"), "with what the person saw");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn robots_that_stand_in_each_others_goals_step_aside_and_both_arrive() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "A").await;
    w.robot("r2", "B").await;
    w.pass(2).await;
    w.submit_with("T1", "A", "B", |raw| raw.robot_id = "r1".to_owned()).await;
    w.submit_with("T2", "B", "A", |raw| raw.robot_id = "r2".to_owned()).await;
    w.until_phase("T1", Phase::Succeeded).await;
    w.until_phase("T2", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn robots_that_wait_for_a_full_station_do_not_keep_those_inside_from_leaving_it() {
    let mut w = World::on(DEMO).await;
    // Three seats, and one way in and out: the crossing. Those inside end their tasks there and are given the next; the others wait in bays.
    for (n, at) in ["park-2", "park-2", "park-4", "park-4", "park-6", "park-6"].iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    for n in 0..3 {
        let robot_id = format!("r{n}");
        w.submit_with(&format!("T{n}"), "A03", "P01", |raw| raw.robot_id = robot_id.clone()).await;
        w.until("it loads", |s| s.has(&format!("r{n}"), "A03")).await;
        w.submit_with(&format!("U{n}"), "B03", "L2-out", |raw| raw.robot_id = robot_id).await;
    }
    w.until("they are inside", |s| s.holders("P01").iter().filter(|h| h.1 == HolderState::Inside).count() == 3).await;
    for n in 0..3 {
        w.r(&format!("r{n}")).works = false;
    }
    for n in 3..6 {
        w.submit_with(&format!("T{n}"), "P01", "B02", |raw| raw.robot_id = format!("r{n}")).await;
    }
    w.pass(2).await;
    for n in 0..3 {
        w.r(&format!("r{n}")).works = true;
    }
    for id in ["T3", "T4", "T5", "U0", "U1", "U2"] {
        w.until_phase(id, Phase::Succeeded).await;
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn ten_robots_on_the_demo_floor_all_get_their_work_done() {
    let mut w = World::on(DEMO).await;
    let stands = ["park-1", "park-1", "park-2", "park-2", "park-3", "park-3", "park-4", "park-4", "hold-a", "hold-b"];
    for (n, at) in stands.iter().enumerate() {
        w.robot(&format!("r{n}"), at).await;
    }
    let goals = ["D01", "A01", "L1-in", "C01", "B03", "Q01", "P02", "D03", "L2-out", "A02"];
    for n in 0..40 {
        w.submit(&format!("T{n}"), goals[n % 10], goals[(n * 3 + 1) % 10]).await;
    }
    for n in 0..40 {
        w.until_phase(&format!("T{n}"), Phase::Succeeded).await;
    }
    w.lawful().await;
}

pub fn claim(place: &str) -> HeldPlace {
    HeldPlace { place_id: PlaceId::parse(place).expect("a place"), grant_id: 0, inside: true }
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_says_it_is_everywhere_gets_eight_places_and_no_work_until_it_says_something_plausible() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    w.pass(2).await;
    let all: Vec<String> = w.site.places().iter().map(|p| p.place_id.to_string()).collect();
    assert!(all.len() > 30);
    w.r("r1").claims = all.iter().filter(|id| *id != "park-1").map(|id| claim(id)).collect();
    w.pass(5).await;
    let held = |s: &crate::harness::Seen| all.iter().filter(|id| s.has("r1", id)).count();
    let seen = w.seen().await;
    assert_eq!(held(&seen), 8);
    assert!(seen.has("r1", "park-1"), "what it held before");
    assert_eq!(seen.open_incidents("PLACES_IMPLAUSIBLE").len(), 1);
    w.submit_with("T1", "D01", "D02", |raw| raw.robot_id = "r1".to_owned()).await;
    w.pass_while(30, "it gets no work", |s| s.phase("T1") == Phase::Queued).await;
    w.r("r1").claims.clear();
    w.until_phase("T1", Phase::Succeeded).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn two_robots_inside_one_place_are_one_incident_and_each_explanation_names_the_other() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.robot("r3", "wait-a").await;
    w.pass(2).await;
    w.r("r2").claims = vec![claim("park-a")];
    let seen = w.until("they are seen", |s| !s.open_incidents("EXCLUSION_BROKEN").is_empty()).await;
    w.submit_with("T3", "A", "park-a", |raw| (raw.robot_id, raw.stall_ms) = ("r3".to_owned(), Some(3_600_000))).await;
    let of = |s: &crate::harness::Seen| s.open_incidents("EXCLUSION_BROKEN").len();
    assert_eq!(of(&seen), 1);
    w.pass_while(30, "one incident, and nobody else is let in", |s| of(s) == 1 && !s.has("r3", "park-a")).await;
    for (robot, other) in [("r1", "r2"), ("r2", "r1")] {
        let ask = v1::ExplainRobotRequest { robot_id: robot.to_owned() };
        let told = w.fleet.explain_robot(local(ask)).await.expect("told").into_inner();
        let told = format!("{:?}", told.explanation.expect("told").verdict);
        assert!(told.contains("EXCLUSION_BROKEN") && told.contains(other), "{robot}: {told}");
    }
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn robots_that_all_say_that_they_are_in_one_place_are_one_incident() {
    let mut w = World::on(DEMO).await;
    let seats = w.site.starting_places(12);
    let names: Vec<String> = seats.iter().map(|seat| w.site.name_of(*seat).to_string()).collect();
    for (n, waypoint) in names.iter().enumerate() {
        w.robot(&format!("r{n}"), waypoint).await;
    }
    w.pass(2).await;
    for n in 1..names.len() {
        w.r(&format!("r{n}")).claims = vec![claim(&names[0])];
    }
    let seen = w.until("all are seen", |s| s.holders(&names[0]).len() == names.len()).await;
    let open = seen.open_incidents("EXCLUSION_BROKEN");
    assert_eq!(open.len(), 1, "{open:?}");
    let facts = &open[0].reason.metadata;
    assert_eq!((facts["place_id"].as_str(), facts["inside"].as_str()), (names[0].as_str(), "12"));
    assert_eq!(facts["robots"].split(' ').count(), 8);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_entry_on_a_grant_that_nobody_gave_is_an_incident() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(600).await;
    let place_id = PlaceId::parse("charge").expect("a place");
    w.r("r1").says(RobotEvent::Place { place_id, grant_id: 4_711, news: PlaceNews::Entered });
    w.pass(3).await;
    assert_eq!(w.seen().await.open_incidents("GRANT_UNKNOWN").len(), 1);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_lies_about_its_generation_excuses_no_other_robot() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("liar", "park-a").await;
    w.robot("r2", "park-b").await;
    w.pass(5).await;
    w.r("liar").applied = w.clock.now().wall.0 as u64 + 86_400_000;
    w.connect("liar").await;
    w.until("it is noticed", |s| !s.open_incidents("STORE_BEHIND_ROBOT").is_empty()).await;
    for (robot, place) in [("liar", "charge"), ("r2", "wait-b")] {
        let place_id = PlaceId::parse(place).expect("a place");
        w.r(robot).says(RobotEvent::Place { place_id, grant_id: 4_711, news: PlaceNews::Entered });
    }
    let attempt = elsewhere();
    w.r("r2").lists = vec![attempt.clone()];
    w.pass(3).await;
    let blamed: Vec<_> = w.seen().await.open_incidents("GRANT_UNKNOWN").into_iter().map(|i| i.robot_id).collect();
    assert_eq!(blamed, [Some(w.r("r2").id.clone())]);
    let disown = v1::DisownAttemptRequest {
        robot_id: "r2".to_owned(),
        subject: attempt.attempt.subject.to_string(),
        epoch: attempt.attempt.epoch,
        reason: "I looked".to_owned(),
        ..Default::default()
    };
    w.fleet.disown_attempt(local(disown)).await.expect("it is no robot that knows more than the store");
    w.lawful().await;
}

/// An attempt that nobody gave here.
fn elsewhere() -> midshift_core::robot::ReportedAttempt {
    let task_id = midshift_core::ids::TaskId::parse("T-elsewhere").expect("an id");
    midshift_core::robot::ReportedAttempt {
        attempt: midshift_core::ids::AttemptId { subject: midshift_core::ids::Subject::Task(task_id), epoch: 3 },
        state: midshift_core::robot::WorkState::Executing,
        step_index: 1,
        progress: 1,
        route_index: 0,
        opened: false,
    }
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_invents_grants_without_end_opens_a_few_incidents_the_last_of_which_stands_for_the_rest() {
    let mut w = World::on(DEMO).await;
    w.robot("r1", "park-1").await;
    w.pass(600).await;
    let all: Vec<PlaceId> = w.site.places().iter().map(|p| p.place_id.clone()).collect();
    for (n, place_id) in (4_711..).zip(all) {
        w.r("r1").says(RobotEvent::Place { place_id, grant_id: n, news: PlaceNews::Entered });
    }
    w.pass(3).await;
    let open = w.seen().await.open_incidents("GRANT_UNKNOWN");
    assert_eq!(open.len(), 8);
    assert_eq!(open.iter().filter(|i| i.reason.metadata.contains_key("further")).count(), 1);
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_waits_for_a_place_is_told_who_has_it() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.robot("r2", "park-b").await;
    w.r("r1").works = false;
    w.submit_with("T1", "A", "B", |raw| (raw.robot_id, raw.stall_ms) = ("r1".to_owned(), Some(3_600_000))).await;
    w.until("r1 is in A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.submit_with("T2", "A", "B", |raw| (raw.robot_id, raw.stall_ms) = ("r2".to_owned(), Some(3_600_000))).await;
    w.pass(120).await;
    let ask = v1::ExplainTaskRequest { task_id: "T2".to_owned() };
    let told = w.fleet.explain_task(local(ask)).await.expect("told").into_inner();
    let verdict = told.explanation.expect("told").verdict.expect("a reason");
    assert_eq!(verdict.metadata.get("held_by").map(String::as_str), Some("r1"), "{verdict:?}");
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn an_attempt_that_the_server_does_not_know_is_an_incident_after_a_minute() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(600).await;
    w.r("r1").lists = vec![elsewhere()];
    w.pass_while(55, "it may be about to let it go", |s| s.open_incidents("ATTEMPT_UNKNOWN").is_empty()).await;
    let seen = w.until("a person is told", |s| !s.open_incidents("ATTEMPT_UNKNOWN").is_empty()).await;
    assert!(seen.work("r1").assignment.is_none());
    let ask = v1::ExplainRobotRequest { robot_id: "r1".to_owned() };
    let told = w.fleet.explain_robot(local(ask)).await.expect("told").into_inner();
    let told = format!("{:?}", told.explanation.expect("told").verdict);
    assert!(told.contains("ATTEMPT_UNKNOWN") && told.contains("T-elsewhere/3"), "{told}");
    w.lawful().await;
}

/// Closed places that people are told of, with how many seats of each.
fn told_closed(seen: &crate::harness::Seen) -> Vec<(String, String)> {
    let open = seen.open_incidents("PLACE_QUARANTINED").into_iter().map(|i| i.reason.metadata);
    open.map(|facts| (facts["place_id"].clone(), facts["seats"].clone())).collect()
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_fell_silent_before_it_entered_keeps_its_seat_and_the_other_seats_are_given() {
    let narrow = r#"{ id = "B", at = [18000, 3000], kind = "station" }"#;
    let wide = r#"{ id = "B", at = [18000, 3000], kind = "station", capacity = 3 }"#;
    assert!(CORRIDOR.contains(narrow));
    let mut w = World::on(CORRIDOR.replace(narrow, wide).leak()).await;
    w.robot("r1", "park-a").await;
    w.submit_with("T1", "A", "B", |raw| raw.stall_ms = Some(3_600_000)).await;
    let granted = ("r1".to_owned(), HolderState::Granted);
    w.until("it may enter B", |s| s.holders("B") == [granted.clone()]).await;
    w.r("r1").drives = false;
    w.r("r1").cut();
    w.until("nobody knows", |s| s.is_uncertain("T1")).await;
    w.pass(298).await;
    let seen = w.until_phase("T1", Phase::NeedsOperator).await;
    assert!(seen.place("B").quarantine.is_none() && seen.place("corridor").quarantine.is_some());
    w.robot("r2", "park-b").await;
    w.r("r2").works = false;
    w.submit_with("T2", "B", "park-b", |raw| (raw.robot_id, raw.stall_ms) = ("r2".to_owned(), Some(3_600_000))).await;
    let inside = ("r2".to_owned(), HolderState::Inside);
    let both = [granted.clone(), inside.clone()];
    w.until("r2 is beside the closed seat", |s| s.holders("B") == both).await;
    let seen = w.until("a person is told", |s| told_closed(s).iter().any(|(id, _)| id == "B")).await;
    let of_b: Vec<_> = told_closed(&seen).into_iter().filter(|(id, _)| id == "B").collect();
    assert_eq!(of_b, [("B".to_owned(), "1".to_owned())]);
    let clear = |w: &World, seen: &crate::harness::Seen| {
        let (fleet, etag) = (w.fleet.clone(), seen.revision("place_grant", "B").to_string());
        let (place_id, reason) = ("B".to_owned(), "r1 is not there".to_owned());
        let request = v1::ClearPlaceRequest { place_id, reason, etag, ..Default::default() };
        async move { fleet.clear_place(local(request)).await }
    };
    clear(&w, &seen).await.expect("r1 is not heard");
    let seen = w.until("B has a seat more", |s| s.holders("B") == [inside.clone()]).await;
    let refused = clear(&w, &seen).await.expect_err("r2 is heard");
    assert_eq!(refused.code(), tonic::Code::FailedPrecondition);
    assert!(refused.message().contains("r2"), "{refused:?}");
    w.until("its incident is over", |s| told_closed(s).iter().all(|(id, _)| id != "B")).await;
    w.lawful().await;
}

#[tokio::test(start_paused = true)]
async fn a_closed_place_has_one_incident_through_restarts_until_its_robot_is_heard() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until("it stands in A", |s| s.holders("A") == [("r1".to_owned(), HolderState::Inside)]).await;
    w.r("r1").cut();
    w.cancel("T1", false).await;
    let of_a = |s: &crate::harness::Seen| told_closed(s).into_iter().filter(|(id, _)| id == "A").count();
    w.until("a person is told", |s| of_a(s) == 1).await;
    w.stop_fleet().await;
    w.pass(5).await;
    w.start_fleet();
    w.pass_while(90, "told once", |s| of_a(s) == 1).await;
    let all = w.seen().await.all::<midshift_core::fleet::rows::Incident>();
    assert_eq!(all.iter().filter(|i| i.reason.metadata.get("place_id").is_some_and(|id| id == "A")).count(), 1);
    w.r("r1").mend();
    w.connect("r1").await;
    w.until("it closes by itself", |s| told_closed(s).is_empty()).await;
    w.lawful().await;
}
