//! Rows about rings that are gone have an end.

use crate::world::{Result, Robot, clock, world};
use midshift_core::ids::RobotId;
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::rows::Writer;
use midshift_core::session::{LaneMark, Session};
use midshift_core::time::{Clock, Now, Utc};
use midshift_store::{Frame, FrameLog, MemoryFrames, load};
use std::collections::BTreeSet;
use std::sync::Arc;

struct At(Utc);

impl Clock for At {
    fn now(&self) -> Now {
        Now { wall: self.0, utc: self.0, ..Now::default() }
    }
    fn rate_permille(&self) -> u32 {
        1_000
    }
}

#[tokio::test(start_paused = true)]
async fn the_mark_of_a_replaced_ring_goes_after_a_month_and_that_of_the_newest_stays_however_old() -> Result<()> {
    let world = world().await?;
    let _robot = Robot::attach(&world, None).await?;
    let robot_id = RobotId::parse("r1")?;
    let (session, _) = load::<Session>(&*world.store, "r1").await?.expect("a session");
    let kept_ms = i64::try_from(limits::GONE_KEPT.as_ms())?;
    let now = Utc(4 * kept_ms);
    let marks = [(session.ring.as_str(), 1), ("replaced", now.0 - kept_ms - 1), ("replaced-late", now.0 - kept_ms)];
    let mut item = Item::new(Writer::Telemetry, "tests");
    for (ring, at_unix_ms) in marks {
        item.create(&LaneMark { event: 7, at_unix_ms, ..LaneMark::fresh(robot_id.clone(), ring) }, "lane.durable");
    }
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(midshift_telemetry::prune(&*world.store, &MemoryFrames::new(clock(), 1), &At(now)).await?, 1);
    let mut left = Vec::new();
    for (ring, _) in marks {
        left.push(load::<LaneMark>(&*world.store, &format!("r1/{ring}")).await?.is_some());
    }
    assert_eq!(left, [true, false, true]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn the_mark_of_status_goes_with_that_of_its_rings_events_and_that_of_the_newest_ring_stays() -> Result<()> {
    let world = world().await?;
    let _robot = Robot::attach(&world, None).await?;
    let (session, _) = load::<Session>(&*world.store, "r1").await?.expect("a session");
    let kept_ms = i64::try_from(limits::GONE_KEPT.as_ms())?;
    let now = Utc(4 * kept_ms);
    let mut item = Item::new(Writer::Telemetry, "tests");
    for (ring, at_unix_ms) in [("replaced", now.0 - kept_ms - 1), ("replaced-late", now.0 - kept_ms)] {
        let mark = LaneMark { event: 7, at_unix_ms, ..LaneMark::fresh(RobotId::parse("r1")?, ring) };
        item.create(&mark, "lane.durable");
    }
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    let frames = MemoryFrames::new(clock(), 1 << 20);
    let rings = [("gone", "ring"), ("r1", "replaced"), ("r1", "replaced-late"), ("r1", session.ring.as_str())];
    for (robot, ring) in rings {
        let (robot_id, ring, bytes) = (RobotId::parse(robot)?, Arc::from(ring), Arc::from([1_u8].as_slice()));
        frames.append(vec![Frame { robot_id, ring, first_seq: 1, last_seq: 7, bytes }]).await?;
    }
    assert_eq!(
        midshift_telemetry::prune(&*world.store, &frames, &At(now)).await?,
        3,
        "a mark of events, two of status"
    );
    let left = frames.marks().await?;
    let left: BTreeSet<&str> = left.iter().map(|mark| &*mark.ring).collect();
    assert_eq!(left, BTreeSet::from(["replaced-late", session.ring.as_str()]));
    Ok(())
}
