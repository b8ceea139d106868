//! Fleet stops by their second way: what a session says of the site's copy of them.

use crate::world::{Result, Robot, World, world};
use midshift_core::ids::{RobotId, StopId};
use midshift_core::item::{Expect, Item};
use midshift_core::robot::StopLevel;
use midshift_core::rows::{Revision, Writer};
use midshift_core::stop::record::StopRecord;
use midshift_core::stop::{Reset, Scope, Stop};
use midshift_core::time::Utc;
use midshift_proto::session::StopFacts;

pub fn record(n: u8, scope: Scope) -> Result<StopRecord> {
    let bare = Stop::new(StopId::parse(&format!("STOP-{n}"))?, scope, StopLevel::Halt, Utc(1));
    let (actor, reason) = ("anna".to_owned(), "a pallet fell".to_owned());
    Ok(StopRecord { stop: Stop { actor, reason, proof: vec![7; 64], ..bare }, reset: None })
}

pub async fn copied(world: &World, record: &StopRecord, expect: Expect) {
    let mut item = Item::new(Writer::Stop, "stop");
    item.put_row(record, expect, "stop.engaged");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
}

pub async fn hears(robot: &mut Robot) -> Result<StopFacts> {
    robot.hears(|down| down.stops.clone()).await
}

#[tokio::test(start_paused = true)]
async fn a_stop_of_the_copy_goes_down_every_session_whole_and_once_with_its_reset() -> Result<()> {
    let world = world().await?;
    let first = record(1, Scope::Fleet)?;
    copied(&world, &first, Expect::Absent).await;
    let mut robot = Robot::attach(&world, None).await?;
    assert_eq!(hears(&mut robot).await?, StopFacts { stops: vec![first.stop.clone()], resets: vec![] });
    // While the session stands: one for another robot alone is not said, and nothing is said twice.
    copied(&world, &record(2, Scope::Robot(RobotId::parse("r2")?))?, Expect::Absent).await;
    let third = record(3, Scope::Robot(RobotId::parse("r1")?))?;
    copied(&world, &third, Expect::Absent).await;
    assert_eq!(hears(&mut robot).await?, StopFacts { stops: vec![third.stop], resets: vec![] });
    let (actor, reason) = ("bert".to_owned(), "clear".to_owned());
    let bare = Reset::new(first.stop.stop_id.clone(), Utc(2));
    let reset = Reset { actor, reason, proof: vec![8; 64], ..bare };
    copied(&world, &StopRecord { reset: Some(reset.clone()), ..first }, Expect::At(Revision(1))).await;
    assert_eq!(hears(&mut robot).await?, StopFacts { stops: vec![], resets: vec![reset] });
    Ok(())
}
