//! Rows about rings that are gone have an end.

use crate::world::{Result, Robot, world};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::rows::{Item, Writer};
use midshift_core::time::{Clock, Now, Utc};
use midshift_core::work::{LaneMark, Session};
use midshift_store::load;

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
    assert_eq!(midshift_telemetry::prune(&*world.store, &At(now)).await?, 1);
    let mut left = Vec::new();
    for (ring, _) in marks {
        left.push(load::<LaneMark>(&*world.store, &format!("r1/{ring}")).await?.is_some());
    }
    assert_eq!(left, [true, false, true]);
    Ok(())
}
