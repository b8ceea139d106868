//! A robot's session: welcome, acknowledgements, desired state, succession, clones.

use crate::world::{Otherwise, Result, Robot, World, clock, hello, serve, world, world_with};
use midshift_core::desired_state::DesiredWork;
use midshift_core::fleet::REPORT_TOO_LONG;
use midshift_core::ids::{PlaceId, RobotId, SiteId};
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot::{HeldPlace, Lane, Mode, ReportedState};
use midshift_core::robot_events::{InboxItem, RobotEvent, Sample, SampleBody};
use midshift_core::rows::{Log, Seq, Writer};
use midshift_core::session::Session;
use midshift_core::time::{Clock, Utc};
use midshift_core::wall_clock::WallClock;
use midshift_proto::session::{ClockSample, CloseCode, Downlink, Heartbeat, LaneAck, LaneBatch, Uplink};
use midshift_store::{LiveBoard, MemoryFrames, MemoryStore, StoreId, load};
use midshift_telemetry::{Bugs, Parts, SeededBug};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};
use std::time::Duration;

async fn inbox(world: &World) -> Result<usize> {
    Ok(world.store.feed(Seq(0), &[Log::RobotInbox], 1_000).await?.entries.len())
}

#[tokio::test(start_paused = true)]
async fn events_are_durable_when_they_are_acknowledged_and_stored_once() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.events(1..=3).await?;
    let acked = |down: &Downlink| {
        down.acks.iter().find(|a| a.lane == Lane::Event && a.expect.is_none()).map(|a| a.seq).filter(|seq| *seq > 0)
    };
    assert_eq!(robot.hears(acked).await?, 3);
    assert_eq!(inbox(&world).await?, 3);
    robot.events(2..=4).await?;
    assert_eq!(robot.hears(|down| acked(down).filter(|seq| *seq > 3)).await?, 4);
    assert_eq!(inbox(&world).await?, 4);
    robot.events(6..=6).await?;
    assert_eq!(robot.hears(|down| down.acks.iter().find_map(|a| a.expect)).await?, 5);
    Ok(())
}

/// What a robot hears that sent the events 1 to 2 and 5, since 3 and 4 were lost on the way: an acknowledgement of all, or which one is missing.
async fn lost_on_the_way(bugs: Bugs) -> Result<(u64, Option<u64>)> {
    let world = world_with(Otherwise { bugs, frames: None }).await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.events(1..=2).await?;
    robot.events(5..=5).await?;
    let told = |ack: &LaneAck| ack.lane == Lane::Event && (ack.seq == 5 || ack.expect.is_some());
    robot.hears(|down| down.acks.iter().find(|ack| told(ack)).map(|ack| (ack.seq, ack.expect))).await
}

#[tokio::test(start_paused = true)]
async fn events_that_were_lost_on_the_way_are_missed_and_a_rule_that_takes_holes_acknowledges_them() -> Result<()> {
    assert_eq!(lost_on_the_way(Bugs::default()).await?.1, Some(3));
    assert_eq!(lost_on_the_way(Bugs::seeded(&[SeededBug::HolesAreTaken])).await?, (5, None));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_wall_that_jumps_for_a_minute_costs_no_session_and_what_it_tells_is_marked() -> Result<()> {
    let (steady, ahead_ms) = (clock(), Arc::<AtomicI64>::default());
    let (mono, jumping) = (steady.clone(), ahead_ms.clone());
    let wall = move || Utc(steady.now().wall.0 + jumping.load(Relaxed));
    let clock: Arc<dyn Clock> = Arc::new(WallClock::new(move || mono.now().link.0 * 1000, wall, |_| {}));
    let store = Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let frames = Arc::new(MemoryFrames::new(clock.clone(), 1 << 20));
    let (board, bugs) = (LiveBoard::new(), Bugs::default());
    let world = serve(Parts { store, frames, board, heard: None, clock, bugs }).await?;
    let mut robot = Robot::attach(&world, None).await?;
    let mut doubted = Vec::new();
    for step_ms in [0, 30 * 24 * 3_600_000, 0, -30 * 24 * 3_600_000] {
        ahead_ms.fetch_add(step_ms, Relaxed);
        tokio::time::sleep(Duration::from_secs(1)).await;
        robot.beat().await?;
        let hb = robot.hb;
        doubted.push(robot.hears(|down| down.echo.filter(|e| e.hb == hb).map(|e| e.is_clock_doubted)).await?);
    }
    assert_eq!(doubted, [false, true, true, false]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_heartbeat_is_echoed_and_new_desired_work_is_pushed() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    assert_eq!(robot.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    let work = DesiredWork {
        robot_id: RobotId::parse("r1")?,
        generation: 7,
        assignment: None,
        grants: Vec::new(),
        held: true,
        resume: None,
        closed: Vec::new(),
        maintenance: None,
        resumed: Vec::new(),
        load_word: None,
    };
    let mut item = Item::new(Writer::Fleet, "fleet");
    item.put_row(&work, Expect::Absent, "work.desired");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(robot.hears(|down| down.work.clone()).await?, work);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_proven_succession_ends_the_older_session() -> Result<()> {
    let world = world().await?;
    let mut old = Robot::attach(&world, None).await?;
    old.beat().await?;
    let new = Robot::attach(&world, Some(old.proof())).await?;
    assert!(new.welcome.session_epoch > old.welcome.session_epoch && !new.welcome.observed);
    let close = old.closes().await?;
    assert_eq!((close.code, close.retry_after_ms), (CloseCode::Fenced, 60_000));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_message_is_too_large_hears_so_before_its_session_ends() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.events(1..=200_000).await?;
    let close = robot.closes().await?;
    assert_eq!((close.code, close.reason.code), (CloseCode::Protocol, Code::MessageTooLarge));
    assert!(close.reason.text().ends_with("at most 1048576 are taken"), "{}", close.reason.text());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn without_the_fence_a_clone_takes_over_a_robot_that_is_heard() -> Result<()> {
    let world = world_with(Otherwise { bugs: Bugs::seeded(&[SeededBug::NoCloneFence]), frames: None }).await?;
    let mut first = Robot::attach(&world, None).await?;
    first.beat().await?;
    let clone = Robot::attach(&world, None).await?;
    assert!(!clone.welcome.observed, "two machines of one name, and the second has its work");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn robots_of_old_connections_move_over_again_and_again_and_none_is_taken_for_a_clone() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    for _ in 0..100 {
        robot.beat().await?;
        world.age();
        robot.moves_over().await?;
        robot.beat().await?;
        // Until the next session it is served.
        robot.hears(|down| down.echo.filter(|e| e.hb == 2)).await?;
        let next = Robot::attach(&world, Some(robot.proof())).await?;
        assert!(!next.welcome.observed);
        assert_eq!(robot.closes().await?.code, CloseCode::MoveOver);
        robot = next;
    }
    let facts = world.store.feed(Seq(0), &[Log::Telemetry], 1_000).await?.entries;
    assert!(facts.len() >= 100 && !facts.iter().any(|f| &*f.kind == "session.clone_seen"));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_stays_on_an_old_connection_is_told_to_go() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    world.age();
    robot.moves_over().await?;
    let close = robot.closes().await?;
    assert_eq!((close.code, close.retry_after_ms), (CloseCode::MoveOver, 0));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn of_a_storm_of_robots_some_are_put_off_with_a_time_and_all_come_in() -> Result<()> {
    let (read, reads) = tokio::sync::oneshot::channel::<()>();
    let world = crate::world::world_after(async move { drop(reads.await) }).await?;
    let mut storm = tokio::task::JoinSet::new();
    let mut channel = world.dial().await?;
    let mut attach = async |n: usize| -> Result<_> {
        // As many streams of one connection as any server takes.
        if n.is_multiple_of(100) {
            channel = world.dial().await?;
        }
        let robot_id = RobotId::parse(&format!("r{n}"))?;
        let hello = midshift_proto::session::Hello { robot_id, ..hello(None)? };
        Ok(Robot::attach_over(channel.clone(), hello, tonic::Request::new))
    };
    for n in 0..=limits::HELLOS_WAITING_MAX {
        storm.spawn(attach(n).await?);
    }
    let first = storm.join_next().await.ok_or("nobody")??;
    let refused = first.err().ok_or("welcome before anything was read")?;
    let refused = refused.downcast_ref::<tonic::Status>().ok_or("no status")?;
    let answer = midshift_proto::refusal_of(refused);
    assert_eq!((answer.grpc, answer.code), (tonic::Code::ResourceExhausted, Some(Code::Overloaded)));
    assert_eq!(answer.retry_after, Some(Duration::from_millis(limits::HELLO_AGAIN.as_ms())));
    read.send(()).map_err(|()| "it ended")?;
    let mut welcome = 0;
    while let Some(attached) = storm.join_next().await {
        attached??;
        welcome += 1;
    }
    assert_eq!(welcome, limits::HELLOS_WAITING_MAX);
    assert!(
        attach(limits::HELLOS_WAITING_MAX + 1).await?.await.is_ok(),
        "there is room again, and nothing was restarted"
    );
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_hello_that_waits_is_sent_elsewhere_as_soon_as_its_gateway_takes_nobody_more() -> Result<()> {
    let world = crate::world::world_after(std::future::pending()).await?;
    let begin = tokio::time::Instant::now();
    let waits = Robot::attach(&world, None);
    let leaves = async {
        tokio::time::sleep(Duration::from_millis(100)).await;
        world.service.move_over().await;
    };
    let (refused, ()) = tokio::join!(waits, leaves);
    let refused = refused.err().ok_or("a welcome of a gateway that takes nobody")?;
    let refused = refused.downcast_ref::<tonic::Status>().ok_or("no status")?;
    assert_eq!(midshift_proto::refusal_of(refused).code, Some(Code::ShuttingDown));
    assert!(begin.elapsed() < Duration::from_secs(1), "{:?}", begin.elapsed());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_new_session_remembers_the_clock_that_the_one_before_measured() -> Result<()> {
    let world = world().await?;
    let offset = async || -> Result<Option<i64>> {
        let row = load::<Session>(world.store.as_ref(), "r1").await?;
        Ok(row.ok_or("no session")?.0.clock_offset_ms)
    };
    let mut first = Robot::attach(&world, None).await?;
    assert_eq!(offset().await?, None);
    // Twelve milliseconds ahead, nothing lost on the wire.
    first.beat_with(Some(ClockSample { t1_us: 12_000, t2_us: 0, t3_us: 0, t4_us: 12_000 })).await?;
    first.hears(|down| down.echo).await?;
    let mut second = Robot::attach(&world, Some(first.proof())).await?;
    assert_eq!(offset().await?, Some(12));
    second.beat().await?;
    second.hears(|down| down.echo).await?;
    let _third = Robot::attach(&world, Some(second.proof())).await?;
    assert_eq!(offset().await?, Some(12), "a session that measured nothing forgets nothing");
    Ok(())
}

/// A heartbeat with a list that is too long.
fn too_long(robot: &Robot, hb: u64) -> Heartbeat {
    let place =
        |n: usize| HeldPlace { place_id: PlaceId::parse(&format!("P{n}")).expect("an id"), grant_id: 0, inside: true };
    let session_epoch = robot.welcome.session_epoch;
    let places = (0..257).map(place).collect();
    let reported = ReportedState { hb, session_epoch, places, ..ReportedState::default() };
    Heartbeat { reported, sent_unix_us: 0, clock: None }
}

/// Waits until a person was told of such heartbeats so many times.
async fn told_of_too_long(world: &World, times: usize) -> Result<()> {
    let mut wake = world.store.wake();
    let told = async {
        loop {
            wake.mark_unchanged();
            let entries = world.store.feed(Seq(0), &[Log::Telemetry], 1_000).await?.entries;
            let told = entries.iter().filter(|entry| &*entry.kind == REPORT_TOO_LONG).count();
            if told >= times {
                assert_eq!(told, times);
                return Ok(());
            }
            wake.changed().await?;
        }
    };
    tokio::time::timeout(Duration::from_secs(5), told).await?
}

#[tokio::test(start_paused = true)]
async fn heartbeats_that_are_too_long_are_told_again_after_one_that_was_not_and_when_they_go_on() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let says = async |robot: &mut Robot| {
        robot.hb += 1;
        let heartbeat = Some(too_long(robot, robot.hb));
        robot.say(Uplink { heartbeat, batches: Vec::new() }).await
    };
    says(&mut robot).await?;
    told_of_too_long(&world, 1).await?;
    robot.beat().await?;
    robot.hears(|down| down.echo).await?;
    says(&mut robot).await?;
    told_of_too_long(&world, 2).await?;
    tokio::time::advance(Duration::from_millis(limits::REPORT_TOO_LONG_TOLD_EVERY.as_ms())).await;
    says(&mut robot).await?;
    told_of_too_long(&world, 3).await
}

#[tokio::test(start_paused = true)]
async fn a_heartbeat_with_a_list_that_is_too_long_is_not_processed_and_its_samples_are() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let heartbeat = too_long(&robot, 1);
    let body = SampleBody::Event(RobotEvent::Mode(Mode::Automatic));
    let items = vec![InboxItem::Sample(Sample { seq: 1, robot_unix_ms: 0, body })];
    let batches = vec![LaneBatch { lane: Lane::Event, items }];
    robot.say(Uplink { heartbeat: Some(heartbeat.clone()), batches }).await?;
    robot.say(Uplink { heartbeat: Some(heartbeat), batches: Vec::new() }).await?;
    robot.hears(|down| down.acks.iter().any(|ack| ack.lane == Lane::Event && ack.seq == 1).then_some(())).await?;
    robot.hb = 1;
    robot.beat().await?;
    assert_eq!(
        robot.hears(|down| down.echo.as_ref().map(|echo| echo.hb)).await?,
        2,
        "the first echo is of the good one"
    );
    let told = world.store.feed(Seq(0), &[Log::Telemetry], 1_000).await?.entries;
    let told: Vec<_> = told.iter().filter(|e| &*e.kind == "session.report_too_long").collect();
    assert_eq!(told.len(), 1, "a person is told once");
    assert!(told[0].body.as_deref().is_some_and(|body| body.contains("places")));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn the_map_that_a_robot_drives_by_is_the_one_that_it_said_last() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let robot_id = RobotId::parse("r1")?;
    for (said, known) in [("", ""), ("7", "7"), ("", "7"), ("8", "8"), ("", "8")] {
        robot.hb += 1;
        let (hb, session_epoch, map_version) = (robot.hb, robot.welcome.session_epoch, said.to_owned());
        let reported = ReportedState { hb, session_epoch, map_version, ..ReportedState::default() };
        let heartbeat = Heartbeat { reported, sent_unix_us: 0, clock: None };
        robot.say(Uplink { heartbeat: Some(heartbeat), batches: Vec::new() }).await?;
        robot.hears(|down| down.echo.as_ref().filter(|echo| echo.hb == hb).map(|_| ())).await?;
        let live = world.board.get(&robot_id).ok_or("it is heard")?;
        assert_eq!(live.report.map_version, known, "after {said:?}");
    }
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn the_room_that_a_robot_has_for_software_is_what_it_said_last() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let robot_id = RobotId::parse("r1")?;
    for (free_bytes, known) in [(None, None), (Some(7), Some(7)), (None, Some(7)), (Some(0), Some(0)), (None, Some(0))]
    {
        robot.beat_saying(ReportedState { free_bytes, ..ReportedState::default() }, None).await?;
        let hb = robot.hb;
        robot.hears(|down| down.echo.as_ref().filter(|echo| echo.hb == hb).map(|_| ())).await?;
        let live = world.board.get(&robot_id).ok_or("it is heard")?;
        assert_eq!(live.report.free_bytes, known, "after {free_bytes:?}");
    }
    Ok(())
}
