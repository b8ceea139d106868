//! A second machine with a robot's name: a restart of it, or a copy of its key.

use crate::world::{Result, Robot, World, asked_as, hello, world};
use midshift_core::desired_state::DesiredPolicy;
use midshift_core::item::{Expect, Item};
use midshift_core::limits;
use midshift_core::rows::{Log, Seq, Writer};
use midshift_proto::session::{CloseCode, Hello, Previous};
use serde_json::{Value, json};
use std::time::Duration;

/// The Hello of another start of the agent.
pub fn started(boot_id: &str, previous: Option<Previous>) -> Result<Hello> {
    Ok(Hello { boot_id: boot_id.to_owned(), ..hello(previous)? })
}

/// What fleet was told of second machines.
pub async fn told(world: &World) -> Result<Vec<Value>> {
    let facts = world.store.feed(Seq(0), &[Log::Telemetry], 1_000).await?.entries;
    let seen = facts.iter().filter(|fact| &*fact.kind == midshift_core::fleet::CLONE_SEEN);
    seen.map(|fact| Ok(serde_json::from_str(fact.body.as_deref().unwrap_or_default())?)).collect()
}

/// A second passes, and the robot is heard in it.
pub async fn a_second_passes(robot: &mut Robot) -> Result<()> {
    tokio::time::advance(Duration::from_millis(limits::HEARTBEAT.as_ms())).await;
    robot.beat().await?;
    robot.hears(|down| down.echo).await?;
    Ok(())
}

async fn attach(world: &World, who: &str, hello: Hello) -> Result<Robot> {
    let ask = asked_as(who, ())?;
    Robot::attach_asking(world, hello, move |stream| ask.map(|()| stream)).await
}

#[tokio::test(start_paused = true)]
async fn a_copied_key_with_the_secret_beside_it_is_observed_and_told_of_once_while_the_original_works_on() -> Result<()>
{
    let world = world().await?;
    let mut robot = attach(&world, "robot:r1#0a", started("boot-1", None)?).await?;
    a_second_passes(&mut robot).await?;
    let mut copy = attach(&world, "robot:r1#0b", started("boot-2", Some(robot.proof()))?).await?;
    assert!(copy.welcome.observed, "all that lies in the folder was copied, and proves nothing");
    copy.events(1..=1).await?;
    for _ in 0..6 {
        a_second_passes(&mut robot).await?;
    }
    let expected = json!({"robot_id": "r1", "boot_id": "boot-2", "certificate": "0b", "code": "CLONE_SEEN"});
    assert_eq!(told(&world).await?, [expected]);
    let inbox = world.store.feed(Seq(0), &[Log::RobotInbox], 1_000).await?.entries;
    assert!(inbox.is_empty(), "an observed session writes nothing");
    // What is desired of the robot goes to the original alone.
    let policy = DesiredPolicy { robot_id: "r1".parse()?, generation: 7, areas: Vec::new() };
    let mut item = Item::new(Writer::Fleet, "fleet");
    item.put_row(&policy, Expect::Absent, "policy.desired");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(robot.hears(|down| down.policy.clone()).await?, policy);
    drop(robot);
    assert!(copy.hears(|_| Some(())).await.is_err(), "not a word but the end");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_restarts_while_its_old_connection_looks_open_takes_charge_without_an_alarm() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach_saying(&world, started("boot-1", None)?).await?;
    a_second_passes(&mut robot).await?;
    // Its power was cut: nobody closes the connection.
    let mut next = Robot::attach_saying(&world, started("boot-2", Some(robot.proof()))?).await?;
    assert!(next.welcome.observed, "nobody knows yet");
    // What was on its way comes late.
    robot.beat().await?;
    assert_eq!(next.closes().await?.code, CloseCode::MoveOver);
    let previous = Some(next.proof());
    assert!(!Robot::attach_saying(&world, started("boot-2", previous)?).await?.welcome.observed);
    assert_eq!(told(&world).await?, [json!(null); 0]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_lost_the_answer_to_its_hello_takes_charge_without_an_alarm() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach_saying(&world, started("boot-1", None)?).await?;
    a_second_passes(&mut robot).await?;
    let proof = robot.proof();
    // The Welcome of this one never arrives, and neither does the end of its connection.
    let _lost = Robot::attach_saying(&world, started("boot-1", Some(proof.clone()))?).await?;
    let mut again = Robot::attach_saying(&world, started("boot-1", Some(proof))?).await?;
    assert!(again.welcome.observed);
    assert_eq!(again.closes().await?.code, CloseCode::MoveOver);
    assert!(!Robot::attach_saying(&world, started("boot-1", Some(again.proof()))?).await?.welcome.observed);
    assert_eq!(told(&world).await?, [json!(null); 0]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn an_observed_machine_takes_charge_when_the_other_one_is_silent() -> Result<()> {
    let world = world().await?;
    let mut first = Robot::attach_saying(&world, started("boot-1", None)?).await?;
    let mut second = Robot::attach_saying(&world, started("boot-2", None)?).await?;
    for _ in 0..4 {
        a_second_passes(&mut first).await?;
    }
    assert_eq!(told(&world).await?.len(), 1);
    assert_eq!(second.closes().await?.code, CloseCode::MoveOver);
    assert!(!Robot::attach_saying(&world, started("boot-2", None)?).await?.welcome.observed);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_machine_without_the_robots_memory_takes_charge_only_when_the_robots_authority_has_ended() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach_saying(&world, started("boot-1", None)?).await?;
    a_second_passes(&mut robot).await?;
    drop(robot);
    while world.service.sessions() > 0 {
        tokio::task::yield_now().await;
    }
    let other = Hello { ring: "another".to_owned(), ..started("boot-2", None)? };
    let mut second = Robot::attach_saying(&world, other.clone()).await?;
    assert!(second.welcome.observed, "the robot may be driving behind a gap in the network");
    let from = tokio::time::Instant::now();
    assert_eq!(second.closes().await?.code, CloseCode::MoveOver);
    let silent = from.elapsed();
    assert!(silent >= Duration::from_millis(limits::AUTHORITY.as_ms()), "{silent:?}");
    assert!(!Robot::attach_saying(&world, other).await?.welcome.observed);
    assert_eq!(told(&world).await?, [json!(null); 0], "one machine at a time");
    Ok(())
}
