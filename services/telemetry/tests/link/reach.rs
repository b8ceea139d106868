//! Who may speak for a robot, and who sees one: r1 is a robot in the hall that goes to the quality room.

use crate::world::{Result, Robot, World, asked_as, hello, world};
use midshift_core::fleet::rows::SiteRow;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Item;
use midshift_core::robot::Lane;
use midshift_core::rows::Writer;
use midshift_core::site::DEMO;
use midshift_proto::link::v1::replay_service_client::ReplayServiceClient;
use midshift_proto::refusal_of;
use midshift_proto::session::{Hello, LaneBatch, StatusReplay};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{self, WatchRobotsResponse};
use tonic::{Code, Status, Streaming};

const NOT_THIS_ROBOT: (Code, &str) = (Code::PermissionDenied, "NOT_THIS_ROBOT");

async fn attach(world: &World, who: &str, hello: Hello) -> Result<Robot> {
    let first = asked_as(who, ())?;
    Robot::attach_asking(world, hello, move |stream| first.map(|()| stream)).await
}

/// Why a session was not begun.
fn refused(result: Result<Robot>) -> Result<Status> {
    let error = result.err().ok_or("it was let in")?;
    Ok(*error.downcast::<Status>()?)
}

fn told(status: &Status) -> (Code, String) {
    (status.code(), refusal_of(status).reason)
}

#[tokio::test(start_paused = true)]
async fn a_certificate_of_another_robot_opens_no_session_and_leaves_the_one_in_charge_alone() -> Result<()> {
    let world = world().await?;
    let mut robot = attach(&world, "robot:r1", hello(None)?).await?;
    robot.beat().await?;
    let before = world.store.wake().borrow().to_owned();
    // It knows even the secret of the session.
    for previous in [None, Some(robot.proof())] {
        for who in ["robot:r2", "anna admin operator"] {
            let status = refused(attach(&world, who, hello(previous.clone())?).await)?;
            assert_eq!(told(&status), (NOT_THIS_ROBOT.0, NOT_THIS_ROBOT.1.to_owned()), "{who}");
        }
    }
    assert_eq!(*world.store.wake().borrow(), before, "nothing was written");
    robot.beat().await?;
    assert_eq!(robot.hears(|down| down.echo.as_ref().map(|echo| echo.hb)).await?, 1);
    assert_eq!(robot.hears(|down| down.echo.as_ref().map(|echo| echo.hb)).await?, 2);
    let again = attach(&world, "robot:r1", hello(Some(robot.proof()))?).await?;
    assert!(again.welcome.session_epoch > robot.welcome.session_epoch);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn old_status_is_taken_from_the_robot_alone() -> Result<()> {
    let world = world().await?;
    let robot = attach(&world, "robot:r1", hello(None)?).await?;
    let proof = robot.proof();
    let batch = LaneBatch { lane: Lane::Status, items: crate::world::status_samples(1..=3) };
    let (session_epoch, session_secret) = (proof.session_epoch, proof.secret);
    let replay = StatusReplay { robot_id: RobotId::parse("r1")?, session_epoch, session_secret, batch };
    let mut client = ReplayServiceClient::new(world.channel.clone());
    let status = client.replay_status(asked_as("robot:r2", (&replay).into())?).await.err().ok_or("it was taken")?;
    assert_eq!(told(&status), (NOT_THIS_ROBOT.0, NOT_THIS_ROBOT.1.to_owned()));
    client.replay_status(asked_as("robot:r1", (&replay).into())?).await?;
    Ok(())
}

/// A world whose map fleet keeps.
async fn mapped() -> Result<World> {
    let world = world().await?;
    let mut item = Item::new(Writer::Fleet, "fleet");
    let row = SiteRow { site_id: SiteId::parse("s")?, map_version: "1".to_owned(), text: DEMO.to_owned() };
    item.create(&row, "site.loaded");
    world.store.commit(vec![item]).await.pop().ok_or("no result")??;
    Ok(world)
}

/// Sees `r1` or not, by every way there is.
async fn sees(world: &World, who: &str) -> Result<bool> {
    let mut client = TelemetryServiceClient::new(world.channel.clone());
    let listed = client.list_robots(asked_as(who, v1::ListRobotsRequest::default())?).await?.into_inner().robots;
    let got = client.get_robot(asked_as(who, v1::GetRobotRequest { robot_id: "r1".to_owned() })?).await;
    let events = client.list_events(asked_as(who, v1::ListEventsRequest::default())?).await?.into_inner().events;
    let ways = [!listed.is_empty(), got.is_ok(), !events.is_empty()];
    if let Err(status) = &got {
        assert_eq!(told(status), (Code::NotFound, "ROBOT_NOT_FOUND".to_owned()));
    }
    assert!(ways.iter().all(|way| *way == ways[0]), "{who}: {ways:?}");
    Ok(ways[0])
}

async fn watched(world: &World, who: &str) -> Result<Streaming<WatchRobotsResponse>> {
    let mut client = TelemetryServiceClient::new(world.channel.clone());
    let request = v1::WatchRobotsRequest { period_ms: 50, ..Default::default() };
    Ok(client.watch_robots(asked_as(who, request)?).await?.into_inner())
}

#[tokio::test(start_paused = true)]
async fn a_robot_is_seen_by_whoever_sees_the_area_it_is_in_and_one_nobody_can_place_by_whoever_sees_the_site()
-> Result<()> {
    let world = mapped().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.events(1..=1).await?;
    robot.hears(|down| down.acks.iter().find(|ack| ack.lane == Lane::Event && ack.seq == 1).map(drop)).await?;
    let hall = "anna viewer@hall";
    assert_eq!([sees(&world, "anna viewer").await?, sees(&world, hall).await?], [true, false], "nobody can place it");
    let mut watch = watched(&world, hall).await?;
    let first = watch.message().await?.ok_or("the watch ended")?;
    assert_eq!((first.robots.len(), first.snapshot_complete), (0, true));
    robot.beat_at(Some("A01"), None).await?;
    let come = watch.message().await?.ok_or("the watch ended")?;
    assert_eq!(come.robots.len(), 1, "it is there now");
    assert_eq!([sees(&world, hall).await?, sees(&world, "anna viewer@quality operator@packing").await?], [true, false]);
    robot.beat_at(Some("Q01"), None).await?;
    let gone = watch.message().await?.ok_or("the watch ended")?;
    assert_eq!(gone.robots.len(), 1, "told once more as it leaves");
    assert_eq!([sees(&world, hall).await?, sees(&world, "anna viewer@quality").await?], [false, true]);
    robot.beat_at(Some("Q01"), None).await?;
    robot.beat_at(Some("A01"), None).await?;
    let back = watch.message().await?.ok_or("the watch ended")?;
    assert_eq!(back.robots.len(), 1, "and heard of again when it is back");
    Ok(())
}
