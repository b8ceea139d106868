//! What people are shown of robots is what robots have said themselves.

use crate::harness::{Folder, Robot, Server, eventually, fleet, id_of, scope, within};
use midshift_core::ids::{RobotId, StopId};
use midshift_core::robot::StopLevel;
use midshift_core::site::{DEMO, text};
use midshift_core::stop::Reset;
use midshift_core::stop::ladder::Around;
use midshift_core::time::{Jump, Utc};
use midshift_core::wall_clock::WallClock;
use midshift_proto::convert::stop::CheckIn;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::Confirmation as C;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_proto::stop::v1::stop_service_server::StopService as Face;
use midshift_stop::{Parts, Roster, StopService};
use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};
use tokio_util::sync::CancellationToken;
use tonic::{Code, Request, Streaming};

/// Reads until a robot is shown so.
async fn until(stream: &mut Streaming<v1::EngageResponse>, robot_id: &str, shown: C) -> v1::RobotStop {
    loop {
        let message = within(stream.message()).await.unwrap().expect("the stream goes on");
        let found = message.robots.into_iter().find(|r| r.robot_id == robot_id && r.confirmation() == shown);
        if let Some(found) = found {
            return found;
        }
    }
}

#[tokio::test]
async fn standing_is_shown_when_the_robot_says_so_and_not_before() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let said = robot.obeying(true);
    robot.check_in(said).await;
    let mut stream = server.client().await.engage(fleet()).await.unwrap().into_inner();
    let first = stream.message().await.unwrap().unwrap();
    assert_eq!(first.robots[0].confirmation(), C::Requested, "it stood before, and does not obey yet");
    let id = id_of(&first);
    robot.until(|robot| robot.knows(&id)).await;
    let said = robot.obeying(false);
    robot.check_in(said).await;
    until(&mut stream, "r1", C::Acked).await;
    // It stands, and obeys less than was asked for.
    let said = CheckIn { level: StopLevel::Slow, ..robot.obeying(true) };
    robot.check_in(said).await;
    let said = robot.obeying(true);
    robot.check_in(said).await;
    let standing = until(&mut stream, "r1", C::StandstillConfirmed).await;
    assert_eq!(standing.obeys, crate::harness::halt());
    assert_eq!(within(stream.message()).await.unwrap(), None, "nothing more is to come");
    let status = server.status().await;
    assert_eq!(status.stops[0].counts.unwrap().standstill_confirmed, 1);
    assert_eq!(status.robots[0].awaiting_resume, [id]);
}

#[tokio::test]
async fn a_robot_that_knows_of_a_reset_which_the_service_has_lost_is_not_shown_as_elsewhere() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let id = id_of(&server.engage(fleet()).await.unwrap());
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    robot.latch.reset(Reset::new(StopId::parse(&id).unwrap(), Utc(2)));
    let said = robot.obeying(false);
    assert!(said.inside.is_empty());
    robot.check_in(said).await;
    let counts = server.status().await.stops[0].counts.unwrap();
    assert_eq!(counts, v1::Counts { requested: 1, ..v1::Counts::default() });
}

#[tokio::test]
async fn a_robot_elsewhere_is_shown_as_outside_and_slow_is_done_when_it_is_known() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut here = Robot::dial(&server, "here", vec![]).await.synced().await;
    let mut there = Robot::dial(&server, "there", vec![]).await.synced().await;
    let slow = v1::EngageRequest { level: crate::harness::slow(), ..scope(W::RobotId("here".to_owned())) };
    let mut stream = server.client().await.engage(slow).await.unwrap().into_inner();
    // With the word of the one that is meant the stream is over.
    for robot in [&mut there, &mut here] {
        robot.until(|robot| !robot.latch.effective().count() != 0 && robot.effective().len() == 1).await;
        let said = robot.obeying(false);
        robot.check_in(said).await;
    }
    let mut last = None;
    while let Some(message) = within(stream.message()).await.unwrap() {
        last = message.counts;
    }
    assert_eq!(last, Some(v1::Counts { acked: 1, outside: 1, ..v1::Counts::default() }));
}

#[tokio::test]
async fn a_robot_that_falls_silent_is_shown_with_since_when_and_until_when_and_never_as_standing() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let said = robot.obeying(false);
    robot.check_in(said).await;
    let mut stream = server.client().await.engage(fleet()).await.unwrap().into_inner();
    until(&mut stream, "r1", C::Requested).await;
    server.ahead(3_000);
    let silent = until(&mut stream, "r1", C::Unreachable).await;
    assert!(silent.unreachable_since_unix_ms > 0);
    assert_eq!(silent.self_stop_by_unix_ms - silent.unreachable_since_unix_ms, 6_000, "people may be around it");
    // Past that moment nothing more is to come by itself.
    server.ahead(3_500);
    let mut rest = Vec::new();
    while let Some(message) = within(stream.message()).await.unwrap() {
        rest.extend(message.robots.iter().map(v1::RobotStop::confirmation));
    }
    assert!(rest.iter().all(|shown| *shown == C::Unreachable), "{rest:?}");
    assert_eq!(server.status().await.stops[0].counts.unwrap().unreachable, 1);
}

#[tokio::test]
async fn a_stop_of_one_robot_waits_for_the_word_of_no_other() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let away = Roster { robots: [RobotId::parse("away").unwrap()].into() };
    away.write(&folder.path()).unwrap();
    eventually(async || (server.status().await.robots.len() == 1).then_some(())).await;
    let mut here = Robot::dial(&server, "here", vec![]).await.synced().await;
    let slow = v1::EngageRequest { level: crate::harness::slow(), ..scope(W::RobotId("here".to_owned())) };
    let mut stream = server.client().await.engage(slow).await.unwrap().into_inner();
    here.until(|robot| robot.effective().len() == 1).await;
    let said = here.obeying(false);
    here.check_in(said).await;
    let mut last = None;
    while let Some(message) = within(stream.message()).await.unwrap() {
        last = message.counts;
    }
    let counts = v1::Counts { acked: 1, unreachable: 1, ..v1::Counts::default() };
    assert_eq!(last, Some(counts), "it is over, and the other is shown as it is");
}

#[tokio::test]
async fn a_stop_of_an_area_waits_for_no_robot_that_said_it_lies_elsewhere_and_for_one_that_said_nothing() {
    let folder = Folder::new();
    let site = Arc::new(text::parse(DEMO).unwrap());
    let hall = site.areas()[0].area_id.to_string();
    let server = Server::with_site(&folder.path(), Some(site)).await;
    let mut here = Robot::dial(&server, "here", vec![]).await.synced().await;
    let mut there = Robot::dial(&server, "there", vec![]).await.synced().await;
    let mut stream = server.client().await.engage(scope(W::AreaId(hall))).await.unwrap().into_inner();
    let id = id_of(&stream.message().await.unwrap().unwrap());
    for robot in [&mut here, &mut there] {
        robot.until(|robot| robot.knows(&id)).await;
    }
    let (level, around) = (StopLevel::None, Around::Robots);
    let said = CheckIn { inside: vec![], awaiting: vec![], level, around, ..there.obeying(false) };
    there.check_in(said).await;
    until(&mut stream, "there", C::Outside).await;
    server.ahead(3_000);
    let silent = until(&mut stream, "there", C::Unreachable).await;
    assert!(silent.elsewhere, "it obeys the stop wherever it drives");
    // Nobody has heard of the other one where it is: its word is waited for, and ends the stream.
    let said = here.obeying(true);
    here.check_in(said).await;
    let mut last = None;
    while let Some(message) = within(stream.message()).await.unwrap() {
        last = message.counts;
    }
    assert_eq!(last, Some(v1::Counts { standstill_confirmed: 1, unreachable: 1, ..v1::Counts::default() }));
}

#[tokio::test]
async fn a_stop_for_a_robot_that_nobody_knows_shows_it_as_unreachable() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let answer = server.engage(scope(W::RobotId("typo".to_owned()))).await.unwrap();
    assert_eq!(answer.robots[0].confirmation(), C::Unreachable);
    assert_eq!(answer.counts.unwrap().unreachable, 1);
}

#[tokio::test]
async fn whoever_watches_a_stop_hears_that_it_was_reset() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let _robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let mut stream = server.client().await.engage(fleet()).await.unwrap().into_inner();
    let first = stream.message().await.unwrap().unwrap();
    server.reset(&id_of(&first)).await;
    let end = loop {
        match within(stream.message()).await {
            Ok(Some(_)) => {}
            end => break end,
        }
    };
    assert_eq!(end.unwrap_err().code(), Code::FailedPrecondition);
}

#[tokio::test]
async fn leaving_early_takes_nothing_back() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let stream = server.client().await.engage(fleet()).await.unwrap();
    drop(stream);
    robot.until(|robot| robot.effective().len() == 1).await;
    assert_eq!(server.engaged().await.len(), 1);
}

#[tokio::test]
async fn the_roster_is_followed_and_a_broken_one_leaves_the_last_good_one() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let listed = |names: &[&str]| Roster { robots: names.iter().map(|n| RobotId::parse(n).unwrap()).collect() };
    let shown = async |server: &Server| -> Vec<String> {
        server.status().await.robots.into_iter().map(|robot| robot.robot_id).collect()
    };
    listed(&["r1", "r2"]).write(&folder.path()).unwrap();
    eventually(async || (shown(&server).await == ["r1", "r2"]).then_some(())).await;
    assert_eq!(server.engage(fleet()).await.unwrap().counts.unwrap().unreachable, 2, "never heard");
    fs::write(folder.path().join("roster.snapshot"), "{\"robots\": 7}").unwrap();
    let _robot = Robot::dial(&server, "r3", vec![]).await.synced().await;
    listed(&["r2"]).write(&folder.path()).unwrap();
    // Nobody knows where r1 is: it is shown until it stands by itself at the latest.
    eventually(async || {
        server.ahead(31_000);
        (shown(&server).await == ["r2", "r3"]).then_some(())
    })
    .await;
    server.kill();
    fs::write(folder.path().join("roster.snapshot"), "no json").unwrap();
    let server = Server::start(&folder.path()).await;
    assert_eq!(server.engaged().await.len(), 1, "it begins without a roster");
}

#[tokio::test]
async fn whoever_watches_the_whole_hears_of_each_change() {
    let folder = Folder::new();
    let server = Server::start(&folder.path()).await;
    let mut stream = server.client().await.watch_status(v1::WatchStatusRequest {}).await.unwrap().into_inner();
    let mut status = async || within(stream.message()).await.unwrap().unwrap().status.unwrap();
    assert!(status().await.stops.is_empty());
    let id = id_of(&server.engage(fleet()).await.unwrap());
    while status().await.stops.is_empty() {}
    let mut robot = Robot::dial(&server, "r1", vec![]).await.synced().await;
    let said = robot.obeying(true);
    robot.check_in(said).await;
    while status().await.robots.first().is_none_or(|robot| !robot.standstill) {}
    server.reset(&id).await;
    while !status().await.stops.is_empty() {}
}

#[tokio::test]
async fn a_jump_of_the_wall_clock_of_the_stop_service_itself_is_shown() {
    const BEGIN: i64 = 1_780_000_000_000;
    let (folder, wall) = (Folder::new(), Arc::new(AtomicI64::new(BEGIN)));
    let set = wall.clone();
    let clock = Arc::new(WallClock::new(|| 0, move || Utc(wall.load(Relaxed)), |_: &Jump| {}));
    let parts = Parts { folder: folder.path(), site: None, clock };
    let service = StopService::open(parts, CancellationToken::new()).unwrap();
    let shown = async || {
        let answer = Face::get_status(&service, Request::new(v1::GetStatusRequest {})).await.unwrap();
        let status = answer.into_inner().status.unwrap();
        (status.clock_jump_ms, status.clock_jumped_unix_ms)
    };
    assert_eq!(shown().await, (0, 0));
    set.store(BEGIN - 7_200_000, Relaxed);
    assert_eq!(shown().await, (-7_200_000, BEGIN - 7_200_000));
}
