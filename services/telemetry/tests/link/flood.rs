//! A robot that sends more events than it may: it is slowed, and loses nothing by it.

use crate::world::{Result, Robot, World, world};
use midshift_core::limits;
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxEntry, InboxItem};
use midshift_core::rows::{Log, Seq};
use midshift_proto::session::LaneAck;
use std::ops::RangeInclusive;
use std::time::Duration;
use tokio::time::Instant;

const BURST: u64 = limits::EVENTS_BURST as u64;
const PER_SECOND: u64 = limits::EVENTS_PER_SECOND as u64;
/// Events that an agent has under way at most.
const IN_FLIGHT: u64 = 1_024;

/// Messages of these events.
async fn says(robot: &Robot, seqs: RangeInclusive<u64>) -> Result<()> {
    let (mut first, last) = seqs.into_inner();
    while first <= last {
        let end = last.min(first + limits::SAMPLES_PER_MESSAGE as u64 - 1);
        robot.events(first..=end).await?;
        first = end + 1;
    }
    Ok(())
}

/// What the server says next of the robot's events.
async fn next_ack(robot: &mut Robot) -> Result<LaneAck> {
    robot
        .hears(|down| {
            let acks = || down.acks.iter().filter(|ack| ack.lane == Lane::Event);
            acks().find(|ack| ack.expect.is_some()).or_else(|| acks().next_back()).copied()
        })
        .await
}

/// Sends all events up to this number as an agent does, from what is acknowledged on, until the last one is.
async fn sends(robot: &mut Robot, acked: u64, last: u64) -> Result<()> {
    let (mut acked, mut said) = (acked, acked);
    while acked < last {
        let end = last.min(acked + IN_FLIGHT);
        says(robot, said + 1..=end).await?;
        let ack = next_ack(robot).await?;
        acked = ack.seq;
        said = ack.expect.map_or(end, |expect| expect - 1);
    }
    Ok(())
}

/// Numbers of the events that are kept, in their order.
async fn kept(world: &World) -> Result<Vec<u64>> {
    let (mut seqs, mut after) = (Vec::new(), Seq(0));
    loop {
        let page = world.store.feed(after, &[Log::RobotInbox], 1_000).await?;
        for body in page.entries.iter().filter_map(|entry| entry.body.as_deref()) {
            if let InboxItem::Sample(sample) = serde_json::from_str::<InboxEntry>(body)?.what {
                seqs.push(sample.seq);
            }
        }
        if page.next >= page.head {
            return Ok(seqs);
        }
        after = page.next;
    }
}

#[tokio::test(start_paused = true)]
async fn a_backlog_comes_at_once_and_a_robot_that_goes_on_like_that_is_slowed_and_loses_nothing() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let begun = Instant::now();
    sends(&mut robot, 0, BURST).await?;
    assert!(begun.elapsed() < Duration::from_secs(1), "{:?}", begun.elapsed());
    let (begun, many) = (Instant::now(), 10 * PER_SECOND);
    says(&robot, BURST + 1..=BURST + many).await?;
    robot.beat().await?;
    robot.hears(|down| down.echo.as_ref().map(|_| ())).await?;
    assert!(begun.elapsed() < Duration::from_secs(1), "a heartbeat waits for none of them: {:?}", begun.elapsed());
    while next_ack(&mut robot).await?.seq < BURST + many {}
    let slowed = begun.elapsed();
    assert!((Duration::from_secs(8)..Duration::from_secs(12)).contains(&slowed), "{slowed:?}");
    assert!(kept(&world).await?.into_iter().eq(1..=BURST + many), "each once, in order");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_dials_again_has_no_more_room_for_events_than_before() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    sends(&mut robot, 0, BURST).await?;
    let mut next = Robot::attach(&world, Some(robot.proof())).await?;
    robot.closes().await?;
    let begun = Instant::now();
    sends(&mut next, BURST, BURST + 4 * PER_SECOND).await?;
    assert!(begun.elapsed() > Duration::from_secs(2), "{:?}", begun.elapsed());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_found_no_room_is_asked_for_again_only_once_there_is_some() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    sends(&mut robot, 0, BURST).await?;
    let (last, mut asked) = (BURST + 3 * IN_FLIGHT, 0);
    says(&robot, BURST + 1..=last).await?;
    loop {
        let ack = next_ack(&mut robot).await?;
        if let Some(expect) = ack.expect {
            asked += 1;
            says(&robot, expect..=last).await?;
        } else if ack.seq == last {
            break;
        }
    }
    // Of 12 messages 8 found no room: asked for at once, each would have come in vain again and again.
    assert!((1..=5).contains(&asked), "{asked}");
    assert!(kept(&world).await?.into_iter().eq(1..=last));
    Ok(())
}
