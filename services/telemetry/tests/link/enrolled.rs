//! A session's certificate against the robot's enrolment: who is not enrolled is observed, and another device key waits for a person.

use crate::machines::{installed, key};
use crate::world::{Result, Robot, World, asked_as, hello, world};
use midshift_bundle::installed::seal;
use midshift_core::fleet::NOT_ENROLLED_SEEN;
use midshift_core::identity::{Digest, Replace, RobotIdentity};
use midshift_core::item::{Expect, Item};
use midshift_core::rollout::rows::RobotSoftware;
use midshift_core::rows::{Log, Seq, Writer};
use midshift_core::session::Session;
use midshift_core::time::Utc;
use midshift_proto::session::{CloseCode, Hello, Previous};
use midshift_store::load;
use serde_json::{Value, json};

async fn attach(world: &World, who: &str, hello: Hello) -> Result<Robot> {
    let ask = asked_as(who, ())?;
    Robot::attach_asking(world, hello, move |stream| ask.map(|()| stream)).await
}

/// The robot with the key of these bytes, enrolled at that moment.
fn enrolled(key: u8, at: i64) -> Result<RobotIdentity> {
    let mut robot = RobotIdentity::new("r1".parse()?);
    robot.adopt(Digest([key; 32]), Replace::No, Utc(at), Utc(i64::MAX))?;
    Ok(robot)
}

async fn write(world: &World, robot: &RobotIdentity) -> Result<()> {
    let known = load::<RobotIdentity>(world.store.as_ref(), "r1").await?;
    let mut item = Item::new(Writer::Identity, "anna");
    item.put_row(robot, known.map_or(Expect::Absent, |(_, at)| Expect::At(at)), "robot.changed");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    Ok(())
}

/// What fleet was told of machines that are not enrolled, once it is something.
async fn told(world: &World) -> Result<Vec<Value>> {
    loop {
        let facts = world.store.feed(Seq(0), &[Log::Telemetry], 1_000).await?.entries;
        let seen = facts.iter().filter(|fact| &*fact.kind == NOT_ENROLLED_SEEN);
        let told: Vec<Value> = seen
            .map(|fact| serde_json::from_str(fact.body.as_deref().unwrap_or_default()))
            .collect::<std::result::Result<_, _>>()?;
        if !told.is_empty() {
            return Ok(told);
        }
        tokio::task::yield_now().await;
    }
}

#[tokio::test(start_paused = true)]
async fn a_machine_that_is_not_enrolled_is_observed_and_told_of_and_takes_charge_once_it_is() -> Result<()> {
    let world = world().await?;
    let mut robot = attach(&world, "robot:r1#0a#7", hello(None)?).await?;
    assert!(robot.welcome.observed, "the rows do not know it");
    let expected = json!({
        "robot_id": "r1", "certificate": "0a", "key": Digest([7; 32]).to_string(), "code": "ROBOT_NOT_ENROLLED",
    });
    assert_eq!(told(&world).await?, [expected]);
    assert!(load::<Session>(world.store.as_ref(), "r1").await?.is_none(), "it writes nothing");
    write(&world, &enrolled(7, 5)?).await?;
    assert_eq!(robot.closes().await?.code, CloseCode::MoveOver);
    assert!(!attach(&world, "robot:r1#0a#7", hello(None)?).await?.welcome.observed);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_machine_with_another_key_than_the_one_that_is_enrolled_is_observed() -> Result<()> {
    let world = world().await?;
    write(&world, &enrolled(7, 5)?).await?;
    assert!(attach(&world, "robot:r1#0b#8", hello(None)?).await?.welcome.observed);
    assert_eq!(told(&world).await?.len(), 1);
    assert!(!attach(&world, "robot:r1#0a#7", hello(None)?).await?.welcome.observed, "nobody is in charge yet");
    Ok(())
}

/// A Hello that says what is installed, signed by this device key; the session, and its row.
async fn says(world: &World, previous: Option<Previous>, seed: u8) -> Result<(Robot, Session)> {
    let hello = Hello { installed: seal(installed()?, &key(seed)), ..hello(previous)? };
    let robot = attach(world, "robot:r1#0a#7", hello).await?;
    let (row, _) = load::<Session>(world.store.as_ref(), "r1").await?.ok_or("no row")?;
    assert_eq!((row.session_epoch, robot.welcome.observed), (robot.welcome.session_epoch, false));
    Ok((robot, row))
}

#[tokio::test(start_paused = true)]
async fn another_device_key_is_taken_when_a_person_says_so_or_the_machine_was_enrolled_since() -> Result<()> {
    let world = world().await?;
    write(&world, &enrolled(7, 5)?).await?;
    let (robot, row) = says(&world, None, 1).await?;
    assert_eq!((row.device_key, row.enrolled_unix_ms), (Some(key(1).public().hex()), Some(5)));
    let (mut robot, row) = says(&world, Some(robot.proof()), 2).await?;
    let other = key(2).public().hex();
    assert_eq!((row.other_device_key.as_ref(), row.installed.is_some()), (Some(&other), false));
    // A person takes it: the robot is asked to come again, and is believed.
    let mut item = Item::new(Writer::Ota, "anna");
    let taken = RobotSoftware { device_key: Some(other.clone()), ..RobotSoftware::new("r1".parse()?) };
    item.create(&taken, "robot.device_key_accepted");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(robot.closes().await?.code, CloseCode::MoveOver);
    let (robot, row) = says(&world, Some(robot.proof()), 2).await?;
    let believed = (row.other_device_key, row.device_key, row.installed.is_some());
    assert_eq!(believed, (None, Some(other), true));
    // It is enrolled anew: whatever key it has then.
    let (robot, row) = says(&world, Some(robot.proof()), 3).await?;
    assert!(row.other_device_key.is_some());
    write(&world, &enrolled(7, 6)?).await?;
    let (_, row) = says(&world, Some(robot.proof()), 3).await?;
    assert_eq!((row.other_device_key, row.device_key), (None, Some(key(3).public().hex())));
    Ok(())
}
