//! Rows with a word of a newer version: what they are about gets nothing new, and everything else goes on.

use crate::stops::{copied, hears, record};
use crate::world::{Result, Robot, World, hello, world};
use midshift_core::desired_state::DesiredWork;
use midshift_core::ids::RobotId;
use midshift_core::item::{Expect, Item, RowChange, Write};
use midshift_core::presence::Presence;
use midshift_core::presence::PresenceRow;
use midshift_core::rows::{Record, Writer};
use midshift_core::stop::Scope;
use midshift_proto::session::{Hello, StopFacts};
use midshift_store::load;
use std::time::Duration;

/// Commits a new record with `new` in the place of `old`.
async fn newer<R: Record>(world: &World, writer: Writer, record: &R, (old, new): (&str, &str)) {
    let body = record.body();
    assert!(body.contains(old), "{body}");
    let write = Write::Put { index: record.index(), body: body.replace(old, new).into() };
    let mut item = Item::new(writer, "tests");
    item.rows.push(RowChange { key: record.key(), expect: Expect::Absent, write, kind: "tests.newer" });
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
}

fn work(robot_id: &RobotId) -> DesiredWork {
    DesiredWork {
        robot_id: robot_id.clone(),
        generation: 7,
        assignment: None,
        grants: Vec::new(),
        held: true,
        resume: None,
        closed: Vec::new(),
        maintenance: None,
        resumed: Vec::new(),
        load_word: None,
    }
}

async fn goes_on() -> Result<()> {
    let world = world().await?;
    let (first, other) = (RobotId::parse("r1")?, RobotId::parse("r2")?);
    let presence = PresenceRow::new(other.clone(), Presence::Online, 1);
    newer(&world, Writer::Telemetry, &presence, ("\"online\"", "\"dreaming\"")).await;
    newer(&world, Writer::Fleet, &work(&other), ("\"held\":true", "\"held\":\"hovering\"")).await;
    newer(&world, Writer::Stop, &record(1, Scope::Fleet)?, ("\"halt\"", "\"hover\"")).await;
    let second = record(2, Scope::Fleet)?;
    copied(&world, &second, Expect::Absent).await;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    assert_eq!(hears(&mut robot).await?, StopFacts { stops: vec![second.stop], resets: vec![] });
    // While the session stands.
    newer(&world, Writer::Stop, &record(3, Scope::Fleet)?, ("\"fleet\"", "\"orbit\"")).await;
    let fourth = record(4, Scope::Fleet)?;
    copied(&world, &fourth, Expect::Absent).await;
    assert_eq!(hears(&mut robot).await?, StopFacts { stops: vec![fourth.stop], resets: vec![] });
    let mut item = Item::new(Writer::Fleet, "fleet");
    item.put_row(&work(&first), Expect::Absent, "work.desired");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(robot.hears(|down| down.work.clone()).await?, work(&first));
    // The other one is served, and is told nothing of the work that nobody here can read.
    let mut silent = Robot::attach_saying(&world, Hello { robot_id: other, ..hello(None)? }).await?;
    silent.beat().await?;
    let is_told =
        silent.hears(|down| (down.work.is_some() || down.echo.is_some()).then_some(down.work.is_some())).await?;
    assert!(!is_told);
    // Both fall silent: it is written of the one, and the row of the other stays as it is.
    let mut wake = world.store.wake();
    loop {
        wake.mark_unchanged();
        let row = load::<PresenceRow>(world.store.as_ref(), "r1").await?;
        if row.is_some_and(|(row, _)| row.presence == Presence::Suspect) {
            break;
        }
        wake.changed().await?;
    }
    let kept = world.store.get(vec![presence.key()]).await?.pop().ok_or("its row")?;
    assert!(kept.body.contains("dreaming"), "{}", kept.body);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn rows_of_a_newer_version_are_left_out_and_everything_else_goes_on() -> Result<()> {
    tokio::time::timeout(Duration::from_secs(60), goes_on()).await?
}
