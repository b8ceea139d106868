//! Lane STATUS: kept as it came, acknowledged in bulk, and never more of it under way than was allowed.

use crate::disk::Disk;
use crate::world::{Otherwise, Result, Robot, World, clock, hello, status_samples as samples, world_with};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot::Lane;
use midshift_core::robot_events::{Gap, InboxItem};
use midshift_proto::link::v1;
use midshift_proto::session::{CloseCode, Downlink, Hello, LaneBatch};
use midshift_store::{FrameLog, MemoryFrames};
use midshift_telemetry::{Bugs, SeededBug};
use prost::Message;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::{Instant, advance};

fn disk() -> Arc<Disk> {
    Disk::over(MemoryFrames::new(clock(), 1 << 20))
}

fn otherwise(disk: &Arc<Disk>) -> Otherwise {
    Otherwise { frames: Some(disk.clone()), ..Otherwise::default() }
}

fn acked(down: &Downlink) -> Option<u64> {
    down.acks.iter().find(|a| a.lane == Lane::Status && a.expect.is_none()).map(|a| a.seq)
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_ignores_its_credit_while_the_disk_is_slow_is_let_go() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    disk.stick(true);
    let mut robot = Robot::attach(&world, None).await?;
    let credit = robot.welcome.status_credit_bytes as usize;
    assert_eq!(credit, limits::STATUS_IN_FLIGHT_BYTES);
    let batch = limits::SAMPLES_PER_MESSAGE as u64;
    // A sample takes at least ten bytes: far beyond any slack. What is sent after the end is nobody's.
    for first in (0..(credit as u64)).step_by(limits::SAMPLES_PER_MESSAGE) {
        if robot.status(samples(first + 1..=first + batch)).await.is_err() {
            break;
        }
    }
    assert_eq!(robot.closes().await?.code, CloseCode::TooSlow);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_within_its_credit_is_acknowledged_when_the_disk_comes_back() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    disk.stick(true);
    let mut robot = Robot::attach(&world, None).await?;
    for first in [1, 101, 201] {
        robot.status(samples(first..=first + 99)).await?;
    }
    robot.beat().await?;
    assert_eq!(robot.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    disk.stick(false);
    while robot.hears(acked).await? < 300 {}
    Ok(())
}

fn expected(down: &Downlink) -> Option<u64> {
    down.acks.iter().find(|a| a.lane == Lane::Status).and_then(|a| a.expect)
}

#[tokio::test(start_paused = true)]
async fn what_was_lost_while_the_disk_refused_is_written_down_as_a_gap_before_it_is_acknowledged() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    disk.fill(true);
    let mut robot = Robot::attach(&world, None).await?;
    robot.status(samples(1..=3)).await?;
    assert_eq!(robot.hears(expected).await?, 1);
    // The ring had to make room meanwhile, and the disk still refuses: the gap is not acknowledged either.
    let reason = Code::Overflow.into();
    let gap = InboxItem::Gap(Gap { lane: Lane::Status, from_seq: 1, to_seq: 2, reason });
    let rest: Vec<InboxItem> = std::iter::once(gap).chain(samples(3..=4)).collect();
    robot.status(rest.clone()).await?;
    assert_eq!(robot.hears(expected).await?, 1);
    assert!(disk.refused() >= 2 && disk.gaps(None, 10).await?.is_empty());
    disk.fill(false);
    robot.status(rest).await?;
    assert_eq!(robot.hears(acked).await?, 4);
    let gaps = disk.gaps(None, 10).await?;
    let said: Vec<_> = gaps.iter().map(|g| (&*g.lane, g.from_seq, g.to_seq, &*g.reason)).collect();
    assert_eq!(said, [("STATUS", 1, 2, "OVERFLOW")]);
    Ok(())
}

/// STATUS that is acknowledged while the disk stands still.
async fn acked_without_a_disk(bugs: Bugs) -> Result<bool> {
    let disk = disk();
    let world = world_with(Otherwise { bugs, ..otherwise(&disk) }).await?;
    disk.stick(true);
    let mut robot = Robot::attach(&world, None).await?;
    robot.status(samples(1..=100)).await?;
    robot.beat().await?;
    // What it hears before the echo was said before it.
    let acked = std::cell::Cell::new(false);
    let listen = |down: &Downlink| {
        acked.set(acked.get() || self::acked(down).is_some());
        down.echo
    };
    robot.hears(listen).await?;
    Ok(acked.get())
}

#[tokio::test(start_paused = true)]
async fn status_is_acknowledged_once_it_is_written_and_a_rule_that_does_so_on_arrival_would_lose_it() -> Result<()> {
    assert!(!acked_without_a_disk(Bugs::default()).await?);
    assert!(acked_without_a_disk(Bugs::seeded(&[SeededBug::StatusAckBeforeWrite])).await?);
    Ok(())
}

/// As [`Robot::attach`], of this name.
async fn attach(world: &World, name: &str) -> Result<Robot> {
    Robot::attach_saying(world, Hello { robot_id: RobotId::parse(name)?, ..hello(None)? }).await
}

#[tokio::test(start_paused = true)]
async fn samples_of_many_robots_share_a_write_and_are_acknowledged_beside_an_echo() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    let mut robots = Vec::new();
    for name in ["r1", "r2", "r3"] {
        let robot = attach(&world, name).await?;
        robot.status(samples(1..=1)).await?;
        robots.push(robot);
    }
    let mut acks = vec![None; robots.len()];
    while acks.contains(&None) {
        advance(Duration::from_secs(1)).await;
        for (robot, seq) in robots.iter_mut().zip(&mut acks) {
            robot.beat().await?;
            let down = robot.hears(|down| (down.echo.is_some() || !down.acks.is_empty()).then(|| down.clone())).await?;
            assert!(down.echo.is_some(), "nothing is said but in answer to a heartbeat: {down:?}");
            *seq = seq.or(acked(&down));
        }
    }
    assert_eq!(acks, [Some(1); 3]);
    assert_eq!(disk.written().await, 1);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_a_session_brings_again_that_the_one_before_handed_over_is_kept_once() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    disk.stick(true);
    let mut robot = Robot::attach(&world, None).await?;
    robot.status(samples(1..=2)).await?;
    robot.is_taken().await?;
    let mut next = Robot::attach(&world, Some(robot.proof())).await?;
    let reason = Code::Overflow.into();
    let gap = InboxItem::Gap(Gap { lane: Lane::Status, from_seq: 1, to_seq: 3, reason });
    next.status(std::iter::once(gap).chain(samples(4..=5)).collect()).await?;
    next.is_taken().await?;
    disk.stick(false);
    while next.hears(acked).await? < 5 {}
    let kept: Vec<_> = disk.read(0, 1 << 20).await?.iter().map(|f| (f.frame.first_seq, f.frame.last_seq)).collect();
    assert_eq!(kept, [(1, 2), (3, 5)]);
    let gaps: Vec<_> = disk.gaps(None, 10).await?.iter().map(|gap| (gap.from_seq, gap.to_seq)).collect();
    assert_eq!(gaps, [(3, 3)]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_silent_is_acknowledged_all_the_same() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.status(samples(1..=2)).await?;
    let begun = Instant::now();
    assert_eq!(robot.hears(acked).await?, 2);
    assert!(begun.elapsed() <= Duration::from_secs(3), "{:?}", begun.elapsed());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_comes_while_a_write_is_under_way_is_acknowledged_with_it() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.status(samples(1..=1)).await?;
    robot.is_taken().await?;
    robot.status(samples(2..=2)).await?;
    assert_eq!(robot.hears(acked).await?, 2);
    Ok(())
}

/// Sends as many samples behind `last` as take this share of the credit, percent; the last of them.
async fn spend(robot: &Robot, percent: usize, last: u64) -> Result<u64> {
    let items = samples(1_001..=1_100);
    let bytes = v1::LaneBatch::from(&LaneBatch { lane: Lane::Status, items }).encoded_len();
    let all = samples(last + 1..=last + (limits::STATUS_IN_FLIGHT_BYTES * percent / bytes) as u64);
    for items in all.chunks(limits::SAMPLES_PER_MESSAGE) {
        robot.status(items.to_vec()).await?;
    }
    Ok(last + all.len() as u64)
}

#[tokio::test(start_paused = true)]
async fn what_is_taken_and_not_kept_counts_as_spent_also_after_an_acknowledgement() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    let mut robot = Robot::attach(&world, None).await?;
    let kept = spend(&robot, 40, 0).await?;
    disk.has(kept).await?;
    disk.stick(true);
    let taken = spend(&robot, 8, kept).await?;
    assert_eq!(robot.hears(acked).await?, kept);
    spend(&robot, 45, taken).await?;
    robot.is_taken().await?;
    let begun = Instant::now();
    disk.stick(false);
    while robot.hears(acked).await? <= kept {}
    assert!(begun.elapsed() < Duration::from_millis(500), "{:?}", begun.elapsed());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_has_spent_half_of_its_credit_waits_neither_for_others_nor_for_an_echo() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    let mut robot = Robot::attach(&world, None).await?;
    let begun = Instant::now();
    let batch = limits::SAMPLES_PER_MESSAGE as u64;
    // A sample takes at least ten bytes.
    for first in (0..limits::STATUS_IN_FLIGHT_BYTES as u64 / 20).step_by(limits::SAMPLES_PER_MESSAGE) {
        robot.status(samples(first + 1..=first + batch)).await?;
    }
    assert!(robot.hears(acked).await? > 0);
    assert!(begun.elapsed() < Duration::from_millis(500), "{:?}", begun.elapsed());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_said_right_before_its_connection_was_lost_is_kept() -> Result<()> {
    let disk = disk();
    let world = world_with(otherwise(&disk)).await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.status(samples(1..=2)).await?;
    robot.is_taken().await?;
    drop(robot);
    disk.written().await;
    let kept: Vec<_> = disk.read(0, 1 << 20).await?.iter().map(|f| (f.frame.first_seq, f.frame.last_seq)).collect();
    assert_eq!(kept, [(1, 2)]);
    Ok(())
}
