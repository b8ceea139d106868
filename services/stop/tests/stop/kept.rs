//! What is engaged stays engaged: over ends of the service, lost files and repeated calls.

use crate::harness::{Folder, Robot, Server, code, eventually, fleet, halt, id_of, scope, told};
use midshift_core::limits;
use midshift_core::robot::StopLevel;
use midshift_core::site::{DEMO, text};
use midshift_core::time::{ScaledClock, Utc};
use midshift_proto::access::local;
use midshift_proto::convert::WireEnum;
use midshift_proto::refusal_of;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_proto::stop::v1::stop_service_server::StopService as Face;
use midshift_stop::{Parts, StopService, announce_first_start};
use std::fs;
use std::sync::Arc;
use tokio_util::sync::CancellationToken;
use tonic::Code;

#[tokio::test]
async fn what_was_answered_as_durable_is_in_the_file() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let answer = server.engage(fleet()).await.unwrap();
    assert!(answer.durable);
    // Whatever comes after the answer, also nothing at all.
    let (_, kept) = midshift_latch::read::<serde_json::Value>(&folder.path().join("latch")).unwrap();
    assert!(kept["latch"]["stops"].get(id_of(&answer)).is_some(), "{kept}");
    let reset = server.reset(&id_of(&answer)).await;
    assert!(reset.durable && reset.was_engaged);
    let (_, kept) = midshift_latch::read::<serde_json::Value>(&folder.path().join("latch")).unwrap();
    assert!(kept["latch"]["resets"].get(id_of(&answer)).is_some(), "{kept}");
}

#[tokio::test]
async fn a_kill_keeps_stops_and_the_names_of_those_that_were_reset() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let over = id_of(&server.engage(fleet()).await.unwrap());
    let stands = id_of(&server.engage(scope(W::RobotId("r1".to_owned()))).await.unwrap());
    robot.until(|robot| robot.knows(&over) && robot.knows(&stands)).await;
    let (was_told, generation) = (told(&robot, &over), robot.generation);
    drop(robot);
    server.reset(&over).await;
    server.kill();

    let server = Server::start(&folder.path()).await;
    assert_eq!(server.engaged().await, std::slice::from_ref(&stands));
    // It was away when its stop was reset, and brings it back.
    let robot = Robot::dial(&server, "r1", vec![was_told]).await.synced().await;
    assert_eq!(robot.effective(), [stands]);
    assert!(robot.generation > generation, "generations rise");
}

#[tokio::test]
async fn a_late_reset_of_an_old_stop_leaves_a_newer_one() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let older = id_of(&server.engage(fleet()).await.unwrap());
    let newer = id_of(&server.engage(fleet()).await.unwrap());
    assert_ne!(older, newer);
    assert!(server.reset(&older).await.was_engaged);
    assert_eq!(server.engaged().await, [newer]);
}

#[tokio::test]
async fn the_first_reset_is_answered_and_one_that_comes_before_its_stop_counts() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let id = id_of(&server.engage(fleet()).await.unwrap());
    robot.until(|robot| robot.knows(&id)).await;
    let was_told = told(&robot, &id);
    let first = server.reset(&id).await;
    let again = server.reset(&id).await;
    assert_eq!((again.was_engaged, again.is_unknown, again.reset), (false, false, first.reset));
    let unknown = server.reset("STOP-OF-ANOTHER").await;
    assert!(unknown.is_unknown && !unknown.was_engaged && unknown.durable, "it is taken all the same");
    let known_by_a_robot_only = midshift_core::stop::Stop { stop_id: "STOP-OF-ANOTHER".parse().unwrap(), ..was_told };
    let robot = Robot::dial(&server, "r2", vec![known_by_a_robot_only]).await.synced().await;
    assert!(robot.effective().is_empty());
}

#[tokio::test]
async fn a_robot_that_dials_later_hears_everything_that_is_engaged() {
    let folder = Folder::new();
    let site = Arc::new(text::parse(DEMO).unwrap());
    let server = Server::with_site(&folder.path(), Some(site.clone())).await;
    let mut engaged = Vec::new();
    for n in 0..60 {
        let zone = &site.places()[n % site.places().len()];
        engaged.push(id_of(&server.engage(scope(W::Zone(zone.place_id.to_string()))).await.unwrap()));
    }
    engaged.push(id_of(&server.engage(scope(W::AreaId(site.areas()[0].area_id.to_string()))).await.unwrap()));
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    engaged.sort_unstable();
    assert_eq!(robot.effective(), engaged);
    assert!(robot.latch.effective().all(|stop| stop.region.is_some()), "it can tell whether it lies inside");
    for id in &engaged {
        server.reset(id).await;
    }
    robot.until(|robot| robot.effective().is_empty()).await;
}

#[tokio::test]
async fn a_stop_of_its_own_that_the_service_has_lost_comes_back_from_a_robot() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let id = id_of(&server.engage(fleet()).await.unwrap());
    robot.until(|robot| robot.knows(&id)).await;
    let was_told = told(&robot, &id);
    server.kill();
    fs::remove_file(folder.path().join("latch")).unwrap();

    let server = Server::start(&folder.path()).await;
    let because_it_is_gone = server.engaged().await;
    assert_eq!(because_it_is_gone.len(), 1, "nobody knows what was engaged");
    let mut other = Robot::dial(&server, "r2", vec![]).await.synced().await;
    let _robot = Robot::dial(&server, "r1", vec![was_told]).await.synced().await;
    assert!(server.engaged().await.contains(&id));
    other.until(|robot| robot.knows(&id)).await;
    eventually(async || server.status().await.durable.then_some(())).await;
    server.kill();
    let server = Server::start(&folder.path()).await;
    assert!(server.engaged().await.contains(&id), "and is kept again");
}

#[tokio::test]
async fn a_stop_of_another_make_is_shown_and_not_taken_up_and_its_reset_reaches_its_robot() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let id = id_of(&server.engage(scope(W::RobotId("r1".to_owned()))).await.unwrap());
    robot.until(|robot| robot.knows(&id)).await;
    let was_told = told(&robot, &id);
    drop(server);
    fs::remove_dir_all(folder.path()).unwrap();
    announce_first_start(&folder.path()).unwrap();

    // Another service, with another key; and an own stop that somebody made wider.
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![was_told]).await.synced().await;
    assert!(server.engaged().await.is_empty());
    assert_eq!(server.status().await.robots[0].foreign_stops, std::slice::from_ref(&id));
    assert_eq!(robot.effective(), std::slice::from_ref(&id), "the robot goes on obeying");
    server.reset(&id).await;
    robot.until(|robot| robot.effective().is_empty()).await;
    assert!(server.status().await.robots[0].foreign_stops.is_empty());
    let own = id_of(&server.engage(scope(W::RobotId("r1".to_owned()))).await.unwrap());
    robot.until(|robot| robot.knows(&own)).await;
    let wider = midshift_core::stop::Stop {
        scope: midshift_core::stop::Scope::Fleet,
        stop_id: "STOP-WIDER".parse().unwrap(),
        ..told(&robot, &own)
    };
    let _robot = Robot::dial(&server, "r3", vec![wider]).await.synced().await;
    assert_eq!(server.engaged().await, [own]);
}

#[tokio::test]
async fn a_latch_that_cannot_be_read_begins_with_the_fleet_stopped_and_the_broken_file_kept() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    server.end().await;
    let broken = vec![7; 4096];
    fs::write(folder.path().join("latch"), &broken).unwrap();
    for _ in 0..2 {
        let server = Server::start(&folder.path()).await;
        let status = server.status().await;
        let stop = status.stops[0].stop.clone().unwrap();
        assert_eq!((status.stops.len(), stop.actor.as_str(), stop.level), (1, "midshift", halt()));
        assert!(stop.reason.contains("could not be read") && stop.scope == fleet().scope);
        server.kill();
    }
    let names = fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path());
    let aside = names.filter(|path| path.to_string_lossy().contains("latch.broken-")).collect::<Vec<_>>();
    assert_eq!(aside.len(), 1);
    assert_eq!(fs::read(&aside[0]).unwrap(), broken);
    // It is one stop like any other.
    let server = Server::start(&folder.path()).await;
    let id = server.engaged().await.remove(0);
    assert!(server.reset(&id).await.was_engaged);
    assert!(server.engaged().await.is_empty());
}

#[tokio::test]
async fn a_repeated_request_engages_one_stop_and_another_body_is_refused() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let request = v1::EngageRequest { request_id: "call-1".to_owned(), ..fleet() };
    let id = id_of(&server.engage(request.clone()).await.unwrap());
    assert_eq!(id_of(&server.engage(request.clone()).await.unwrap()), id);
    server.kill();
    let server = Server::start(&folder.path()).await;
    assert_eq!(id_of(&server.engage(request.clone()).await.unwrap()), id, "also after a kill");
    let spelled_out = v1::EngageRequest { level: halt(), ..request.clone() };
    assert_eq!(id_of(&server.engage(spelled_out).await.unwrap()), id);
    let other = v1::EngageRequest { reason: "another".to_owned(), ..request.clone() };
    assert_eq!(code(server.engage(other).await), Code::AlreadyExists);
    assert_eq!(server.engaged().await, std::slice::from_ref(&id));
    server.reset(&id).await;
    // To be shown a stop that nobody obeys any more would be a lie.
    assert_eq!(code(server.engage(request).await), Code::FailedPrecondition);
    assert!(server.engaged().await.is_empty());
}

#[tokio::test]
async fn what_cannot_be_engaged_is_refused_with_every_reason_and_nothing_is_engaged() {
    let folder = Folder::new();
    let site = Arc::new(text::parse(DEMO).unwrap());
    let server = Server::with_site(&folder.path(), Some(site)).await;
    for level in [99, StopLevel::None.to_wire()] {
        let (reason, request_id) = ("x".repeat(257), "with spaces".to_owned());
        let bad = v1::EngageRequest { level, reason, request_id, ..v1::EngageRequest::default() };
        let answer = refusal_of(&server.engage(bad).await.unwrap_err());
        let fields: Vec<&str> = answer.violations.iter().map(|v| v.field.as_str()).collect();
        assert_eq!(fields, ["level", "reason", "request_id", "scope"], "{level}");
    }
    let refused = server.engage(scope(W::Zone("nowhere".to_owned()))).await.unwrap_err();
    assert_eq!(refused.code(), Code::NotFound);
    assert!(refused.message().contains("A01"), "{}", refused.message());
    let request = v1::ResetRequest { stop_id: "STOP-1".to_owned(), reason: "  ".to_owned(), site_id: String::new() };
    assert_eq!(code(server.client().await.reset(request).await), Code::InvalidArgument);
    assert!(server.engaged().await.is_empty());
}

#[tokio::test]
async fn nothing_is_engaged_or_reset_for_whoever_means_another_site() {
    let folder = Folder::new();
    let site = Arc::new(text::parse(DEMO).unwrap());
    let own = site.site_id().to_string();
    let server = Server::with_site(&folder.path(), Some(site)).await;
    let other = v1::EngageRequest { site_id: "elsewhere".to_owned(), ..fleet() };
    let refused = server.engage(other).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains(&format!("of site {own}, not of elsewhere")), "{}", refused.message());
    assert!(server.engaged().await.is_empty());
    let engaged = server.engage(v1::EngageRequest { site_id: own.clone(), ..fleet() }).await.unwrap();
    assert_eq!((engaged.site_id.as_str(), server.status().await.site_id.as_str()), (own.as_str(), own.as_str()));
    let stop_id = id_of(&engaged);
    let (reason, site_id) = ("all clear".to_owned(), "elsewhere".to_owned());
    let reset = v1::ResetRequest { stop_id: stop_id.clone(), reason, site_id };
    assert_eq!(code(server.client().await.reset(reset).await), Code::FailedPrecondition);
    assert_eq!(server.engaged().await, [stop_id]);
}

#[tokio::test]
async fn a_stop_of_an_unknown_robot_is_engaged_and_says_which_robots_may_be_meant() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let _robot = Robot::dial(&server, "rbt-04", Vec::new()).await.synced().await;
    let engaged = server.engage(scope(W::RobotId("rbt-4".to_owned()))).await.unwrap();
    assert!(engaged.robot_unknown && engaged.nearest_robot_ids == ["rbt-04"], "{engaged:?}");
    assert_eq!(server.engaged().await, [id_of(&engaged)]);
    let engaged = server.engage(scope(W::RobotId("rbt-04".to_owned()))).await.unwrap();
    assert!(!engaged.robot_unknown && engaged.nearest_robot_ids.is_empty(), "{engaged:?}");
}

#[tokio::test]
async fn the_last_stops_are_left_for_the_fleet() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut client = server.client().await;
    let one = scope(W::RobotId("r1".to_owned()));
    for _ in 0..240 {
        client.engage(one.clone()).await.unwrap();
    }
    let refused = client.engage(one.clone()).await.map(drop).unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted);
    assert!(refused.message().contains("engage the fleet"), "{}", refused.message());
    server.engage(fleet()).await.unwrap();
    // All of them reach a robot, in messages that any client takes.
    let robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    assert_eq!(robot.effective().len(), 241);
    let engaged = server.engaged().await;
    eventually(async || (server.status().await.durable).then_some(())).await;
    server.kill();
    let server = Server::start(&folder.path()).await;
    let mut again = server.engaged().await;
    let mut engaged = engaged;
    again.sort_unstable();
    engaged.sort_unstable();
    assert_eq!(again, engaged);
}

#[tokio::test]
async fn what_was_reset_a_quarter_ago_is_forgotten_without_anybody_doing_anything() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let over = id_of(&server.engage(fleet()).await.unwrap());
    server.reset(&over).await;
    let stands = id_of(&server.engage(fleet()).await.unwrap());
    server.end().await;
    let path = folder.path().join("latch");
    let read = || midshift_latch::read::<serde_json::Value>(&path).unwrap();
    {
        let none = serde_json::Value::Null;
        let (mut file, mut kept) = midshift_latch::LatchFile::open(&path, limits::STOP_LATCH_BYTES, none).unwrap();
        assert!(kept["latch"]["resets"][&over]["reset_unix_ms"].is_i64(), "{kept}");
        kept["latch"]["resets"][&over]["reset_unix_ms"] = 1.into();
        file.write(&kept).unwrap();
    }
    let (written, _) = read();

    let server = Server::start(&folder.path()).await;
    let (generation, kept) = eventually(async || {
        let (generation, kept) = read();
        kept["latch"]["stops"].get(&over).is_none().then_some((generation, kept))
    })
    .await;
    assert!(kept["latch"]["resets"].get(&over).is_none(), "{kept}");
    assert!(generation > written, "whoever copies it sees that it is another");
    assert_eq!(server.engaged().await, [stands]);
}

/// One that has opened its folder and does nothing else.
pub fn opened(folder: &Folder) -> (StopService, CancellationToken) {
    let shutdown = CancellationToken::new();
    let clock = Arc::new(ScaledClock::new(|| 0, Utc(1_780_000_000_000), 1000));
    let parts = Parts { folder: folder.path(), site: None, clock };
    (StopService::open(parts, shutdown.clone()).unwrap(), shutdown)
}

#[tokio::test]
async fn a_service_that_ends_takes_no_stop_and_no_reset_that_nobody_would_keep() {
    let folder = Folder::new();
    let (service, shutdown) = opened(&folder);
    shutdown.cancel();
    let refused = Face::engage(&service, local(fleet())).await.expect_err("a refusal");
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    let stop_id = "STOP-20260601-ABCDEFGHJK".to_owned();
    let reset = v1::ResetRequest { stop_id, reason: "all clear".to_owned(), site_id: String::new() };
    let refused = Face::reset(&service, local(reset)).await.expect_err("a refusal");
    assert_eq!(refused.code(), Code::Unavailable);
    assert_eq!(service.engaged(), 0);
}
