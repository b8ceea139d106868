//! Old STATUS beside the session: one lane with it, stored before it is answered, and for nobody but the session in charge.

use crate::disk::Disk;
use crate::world::{Otherwise, Result, Robot, World, clock, status_samples as samples, world_with};
use midshift_core::ids::RobotId;
use midshift_core::robot::Lane;
use midshift_core::robot_events::InboxItem;
use midshift_proto::link::v1;
use midshift_proto::link::v1::replay_service_client::ReplayServiceClient;
use midshift_proto::session::{Downlink, LaneAck, LaneBatch, Previous, StatusReplay};
use midshift_store::{FrameLog, MemoryFrames};
use prost::Message;
use std::sync::Arc;
use tokio::task::JoinHandle;
use tonic::{Code, Status};

async fn on_disk() -> Result<(Arc<Disk>, World)> {
    let disk = Disk::over(MemoryFrames::new(clock(), 1 << 20));
    let world = world_with(Otherwise { frames: Some(disk.clone()), ..Otherwise::default() }).await?;
    Ok((disk, world))
}

fn replay(proof: &Previous, items: Vec<InboxItem>) -> Result<v1::ReplayStatusRequest> {
    let batch = LaneBatch { lane: Lane::Status, items };
    let (session_epoch, session_secret) = (proof.session_epoch, proof.secret.clone());
    let robot_id = RobotId::parse("r1")?;
    Ok((&StatusReplay { robot_id, session_epoch, session_secret, batch }).into())
}

type Answer = std::result::Result<LaneAck, Status>;

/// Asks, beside what the test does next.
fn ask(world: &World, request: v1::ReplayStatusRequest) -> JoinHandle<Answer> {
    let mut client = ReplayServiceClient::new(world.channel.clone());
    tokio::spawn(async move {
        let answer = client.replay_status(request).await?.into_inner();
        midshift_proto::parse(answer).map_err(|refusal| midshift_proto::status(&refusal, None))
    })
}

async fn asked(world: &World, proof: &Previous, items: Vec<InboxItem>) -> Result<Answer> {
    Ok(ask(world, replay(proof, items)?).await?)
}

const fn kept(seq: u64) -> LaneAck {
    LaneAck { lane: Lane::Status, seq, expect: None }
}

fn acked(down: &Downlink) -> Option<u64> {
    down.acks.iter().find(|a| a.lane == Lane::Status && a.expect.is_none()).map(|a| a.seq)
}

/// Numbers of all samples as they are stored.
async fn stored(disk: &Disk) -> Result<Vec<u64>> {
    let mut all = Vec::new();
    for stored in disk.read(0, usize::MAX).await? {
        let batch = v1::LaneBatch::decode(&*stored.frame.bytes)?;
        all.extend(batch.samples.iter().map(|s| s.seq));
    }
    Ok(all)
}

#[tokio::test(start_paused = true)]
async fn what_comes_beside_the_session_and_on_it_is_one_lane_stored_in_order_and_once() -> Result<()> {
    let (disk, world) = on_disk().await?;
    let mut robot = Robot::attach(&world, None).await?;
    let proof = robot.proof();
    assert_eq!(asked(&world, &proof, samples(1..=256)).await??, kept(256));
    assert_eq!(asked(&world, &proof, samples(257..=300)).await??, kept(300));
    robot.status(samples(301..=303)).await?;
    assert_eq!(robot.hears(acked).await?, 303);
    // An answer that was lost: what is known is answered, and not stored again.
    assert_eq!(asked(&world, &proof, samples(257..=300)).await??, kept(303));
    assert_eq!(stored(&disk).await?, (1..=303).collect::<Vec<_>>());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_sends_on_its_session_what_went_beside_it_hears_that_it_is_known() -> Result<()> {
    let (disk, world) = on_disk().await?;
    let mut robot = Robot::attach(&world, None).await?;
    asked(&world, &robot.proof(), samples(1..=256)).await??;
    robot.status(samples(1..=85)).await?;
    assert_eq!(robot.hears(acked).await?, 256);
    assert_eq!(stored(&disk).await?, (1..=256).collect::<Vec<_>>());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_hole_is_said_in_the_answer_and_nothing_of_it_is_taken() -> Result<()> {
    let (disk, world) = on_disk().await?;
    let robot = Robot::attach(&world, None).await?;
    let hole = LaneAck { lane: Lane::Status, seq: 0, expect: Some(1) };
    assert_eq!(asked(&world, &robot.proof(), samples(5..=9)).await??, hole);
    assert!(stored(&disk).await?.is_empty());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn nobody_but_the_session_in_charge_is_listened_to() -> Result<()> {
    let (disk, world) = on_disk().await?;
    let robot = Robot::attach(&world, None).await?;
    let proof = robot.proof();
    let observed = Robot::attach(&world, None).await?;
    assert!(observed.welcome.observed);
    let wrong = [
        Previous { secret: "guessed".into(), ..proof.clone() },
        Previous { session_epoch: proof.session_epoch + 1, ..proof.clone() },
        observed.proof(),
    ];
    for wrong in &wrong {
        let refused = asked(&world, wrong, samples(1..=3)).await?.expect_err("is refused");
        assert_eq!(refused.code(), Code::FailedPrecondition, "{wrong:?}");
    }
    let next = Robot::attach(&world, Some(proof.clone())).await?;
    let refused = asked(&world, &proof, samples(1..=3)).await?.expect_err("is fenced");
    assert_eq!(refused.code(), Code::FailedPrecondition);
    let other = v1::ReplayStatusRequest { robot_id: "r2".into(), ..replay(&next.proof(), samples(1..=3))? };
    assert_eq!(ask(&world, other).await?.expect_err("has none").code(), Code::FailedPrecondition);
    assert!(stored(&disk).await?.is_empty());
    assert_eq!(asked(&world, &next.proof(), samples(1..=3)).await??, kept(3));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_session_that_ends_takes_its_replay_with_it_and_the_next_one_is_told_the_rest() -> Result<()> {
    let (disk, world) = on_disk().await?;
    disk.stick(true);
    let mut robot = Robot::attach(&world, None).await?;
    let proof = robot.proof();
    let waiting = ask(&world, replay(&proof, samples(1..=3))?);
    robot.is_taken().await?;
    assert!(!waiting.is_finished(), "nothing is answered before it is durable");
    let next = Robot::attach(&world, Some(proof)).await?;
    assert_eq!(waiting.await?.expect_err("its session is over").code(), Code::FailedPrecondition);
    disk.stick(false);
    assert_eq!(asked(&world, &next.proof(), samples(1..=4)).await??, kept(4));
    assert_eq!(stored(&disk).await?, [1, 2, 3, 4]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn while_a_replay_waits_for_the_disk_the_session_goes_on_and_only_one_more_may_wait() -> Result<()> {
    let (disk, world) = on_disk().await?;
    disk.stick(true);
    let mut robot = Robot::attach(&world, None).await?;
    let proof = robot.proof();
    let mut waiting = Vec::new();
    for last in [100, 200, 300] {
        waiting.push(ask(&world, replay(&proof, samples(last - 99..=last))?));
        robot.is_taken().await?;
        robot.is_taken().await?;
    }
    let refused = waiting.pop().ok_or("was asked")?.await?.expect_err("too many");
    assert_eq!(refused.code(), Code::ResourceExhausted);
    robot.events(1..=1).await?;
    let event = |down: &Downlink| down.acks.iter().find(|a| a.lane == Lane::Event).map(|a| a.seq);
    assert_eq!(robot.hears(event).await?, 1, "an event is acknowledged meanwhile");
    disk.stick(false);
    for (answer, last) in waiting.into_iter().zip([100, 200]) {
        assert_eq!(answer.await??, kept(last));
    }
    assert_eq!(stored(&disk).await?, (1..=200).collect::<Vec<_>>());
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn what_the_disk_refuses_is_not_answered_as_stored_and_may_come_again() -> Result<()> {
    let (disk, world) = on_disk().await?;
    disk.fill(true);
    let robot = Robot::attach(&world, None).await?;
    let refused = asked(&world, &robot.proof(), samples(1..=3)).await?.expect_err("is not stored");
    assert_eq!((refused.code(), disk.refused()), (Code::Unavailable, 1));
    disk.fill(false);
    assert_eq!(asked(&world, &robot.proof(), samples(1..=3)).await??, kept(3));
    assert_eq!(stored(&disk).await?, [1, 2, 3]);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_request_that_breaks_its_shape_is_told_every_field() -> Result<()> {
    let (_, world) = on_disk().await?;
    let refused = ask(&world, v1::ReplayStatusRequest::default()).await?.expect_err("is empty");
    assert_eq!(refused.code(), Code::InvalidArgument);
    let said = midshift_proto::refusal_of(&refused).violations.len();
    assert_eq!(said, 4, "{refused:?}");
    Ok(())
}
