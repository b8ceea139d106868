//! Several gateways over one store: what is echoed when, who is in charge, and where robots go.

use crate::world::{Result, Robot, World, clock, serve};
use async_trait::async_trait;
use midshift_core::desired_state::DesiredWork;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::{Expect, Item};
use midshift_core::reason::Code;
use midshift_core::rows::Writer;
use midshift_core::time::Clock;
use midshift_proto::session::CloseCode;
use midshift_store::{
    Error, FrameLog, HeartbeatLog, LiveBoard, MemoryFrames, MemoryHeartbeats, MemoryStore, SavedHeartbeats, Store,
    StoreId, StoredHeartbeat, follow_heartbeats,
};
use midshift_telemetry::{Bugs, Parts};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The log in memory, behind a network that can be cut, and a fleet that decides at the last moment.
struct Wire {
    log: Arc<MemoryHeartbeats>,
    store: Arc<dyn Store>,
    is_cut: AtomicBool,
    decides: AtomicBool,
}

#[async_trait]
impl HeartbeatLog for Wire {
    async fn save_newest(&self, heard: Vec<StoredHeartbeat>) -> std::result::Result<SavedHeartbeats, Error> {
        self.reach()?;
        if self.decides.swap(false, Ordering::SeqCst) {
            let mut item = Item::new(Writer::Fleet, "fleet");
            item.put_row(&work(), Expect::Absent, "work.desired");
            assert!(self.store.commit(vec![item]).await.iter().all(std::result::Result::is_ok));
        }
        self.log.save_newest(heard).await
    }
    async fn position(&self) -> std::result::Result<u64, Error> {
        self.reach()?;
        self.log.position().await
    }
    async fn read(&self, after: u64) -> std::result::Result<(Vec<StoredHeartbeat>, u64), Error> {
        self.reach()?;
        self.log.read(after).await
    }
}

impl Wire {
    fn reach(&self) -> std::result::Result<(), Error> {
        let cut = || Error::Unavailable(Arc::new(std::io::Error::other("cut")));
        if self.is_cut.load(Ordering::SeqCst) { Err(cut()) } else { Ok(()) }
    }
}

fn work() -> DesiredWork {
    DesiredWork {
        robot_id: RobotId::parse("r1").expect("an id"),
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

/// What gateways share.
struct Site {
    clock: Arc<dyn Clock>,
    store: Arc<dyn Store>,
    frames: Arc<dyn FrameLog>,
    log: Arc<MemoryHeartbeats>,
}

impl Site {
    fn new() -> Result<Self> {
        let clock = clock();
        let store: Arc<dyn Store> =
            Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
        let log = Arc::new(MemoryHeartbeats::new(store.clone()));
        Ok(Self { frames: Arc::new(MemoryFrames::new(clock.clone(), 1 << 20)), clock, store, log })
    }

    async fn gateway(&self) -> Result<(World, Arc<Wire>)> {
        let (is_cut, decides) = (AtomicBool::new(false), AtomicBool::new(false));
        let wire = Arc::new(Wire { log: self.log.clone(), store: self.store.clone(), is_cut, decides });
        let board = LiveBoard::new();
        tokio::spawn(follow_heartbeats(wire.clone(), board.clone(), self.clock.clone()));
        let parts = Parts {
            store: self.store.clone(),
            frames: self.frames.clone(),
            board,
            heard: Some(wire.clone()),
            clock: self.clock.clone(),
            bugs: Bugs::default(),
        };
        Ok((serve(parts).await?, wire))
    }
}

#[tokio::test(start_paused = true)]
async fn what_was_decided_before_a_heartbeat_was_kept_goes_down_before_its_echo() -> Result<()> {
    let site = Site::new()?;
    let (gateway, wire) = site.gateway().await?;
    let mut robot = Robot::attach(&gateway, None).await?;
    wire.decides.store(true, Ordering::SeqCst);
    robot.beat().await?;
    let told = std::cell::Cell::new(false);
    let echoed = robot
        .hears(|down| {
            told.set(told.get() || down.work.is_some());
            down.echo.map(|echo| echo.hb)
        })
        .await?;
    assert_eq!((echoed, told.get()), (1, true), "what the echo gives authority for is known by then");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_gateway_that_is_cut_off_echoes_nothing_and_its_robot_works_on_at_another() -> Result<()> {
    let site = Site::new()?;
    let ((first, wire), (second, _)) = (site.gateway().await?, site.gateway().await?);
    let mut robot = Robot::attach(&first, None).await?;
    robot.beat().await?;
    assert_eq!(robot.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    wire.is_cut.store(true, Ordering::SeqCst);
    robot.beat().await?;
    let proof = robot.proof();
    let close = robot.closes_unechoed().await?;
    assert_eq!(close.code, CloseCode::MoveOver);
    let mut cut_off = first.service.cut_off().ok_or("a gateway among several")?;
    assert!(*cut_off.borrow_and_update());
    assert!(Robot::attach(&first, Some(proof.clone())).await.is_err(), "it would ask a database that is away");
    let mut next = Robot::attach(&second, Some(proof)).await?;
    assert!(!next.welcome.observed);
    next.beat().await?;
    assert_eq!(next.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    wire.is_cut.store(false, Ordering::SeqCst);
    cut_off.wait_for(|cut_off| !cut_off).await?;
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_gateway_that_is_cut_off_sends_its_robots_away_for_no_longer_than_a_moment() -> Result<()> {
    let site = Site::new()?;
    let (gateway, wire) = site.gateway().await?;
    let mut robot = Robot::attach(&gateway, None).await?;
    wire.is_cut.store(true, Ordering::SeqCst);
    robot.beat().await?;
    let close = robot.closes().await?;
    assert_eq!((close.code, close.reason.code), (CloseCode::MoveOver, Code::StoreUnavailable));
    assert!(close.retry_after_ms <= 1_000, "its authority goes on ending meanwhile: {close:?}");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_session_ends_when_its_robot_proves_itself_at_another_gateway() -> Result<()> {
    let site = Site::new()?;
    let ((first, _), (second, _)) = (site.gateway().await?, site.gateway().await?);
    let mut old = Robot::attach(&first, None).await?;
    old.beat().await?;
    old.hears(|down| down.echo).await?;
    let mut new = Robot::attach(&second, Some(old.proof())).await?;
    assert!(new.welcome.session_epoch > old.welcome.session_epoch && !new.welcome.observed);
    assert_eq!(old.closes().await?.code, CloseCode::Fenced);
    new.beat().await?;
    assert_eq!(new.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_session_without_proof_is_only_observed_while_another_gateway_hears_the_robot() -> Result<()> {
    let site = Site::new()?;
    let ((first, _), (second, _)) = (site.gateway().await?, site.gateway().await?);
    let mut robot = Robot::attach(&first, None).await?;
    // Whoever reads others' heartbeats has begun to, and has this one.
    while robot_at(&second).await?.is_none() {
        robot.beat().await?;
        robot.hears(|down| down.echo).await?;
    }
    let mut clone = Robot::attach_saying(&second, crate::second::started("boot-2", None)?).await?;
    assert!(clone.welcome.observed);
    while crate::second::told(&second).await?.is_empty() {
        crate::second::a_second_passes(&mut robot).await?;
    }
    // It falls silent: the other is asked to come back, and then it is in charge.
    assert_eq!(clone.closes().await?.code, CloseCode::MoveOver);
    assert!(!Robot::attach(&second, None).await?.welcome.observed);
    Ok(())
}

/// The number of the heartbeat that a gateway tells people of.
async fn robot_at(world: &World) -> Result<Option<u64>> {
    use midshift_proto::telemetry::v1::{GetRobotRequest, telemetry_service_client::TelemetryServiceClient};
    let request = GetRobotRequest { robot_id: "r1".to_owned() };
    let answer = TelemetryServiceClient::new(world.channel.clone()).get_robot(request).await;
    let robot = answer.ok().and_then(|answer| answer.into_inner().robot);
    Ok(robot.and_then(|robot| robot.reported).map(|reported| reported.hb))
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_restarts_without_proof_where_it_was_is_in_charge_at_once() -> Result<()> {
    let site = Site::new()?;
    let (gateway, _) = site.gateway().await?;
    let mut robot = Robot::attach(&gateway, None).await?;
    robot.beat().await?;
    robot.hears(|down| down.echo).await?;
    let epoch = robot.welcome.session_epoch;
    drop(robot);
    while gateway.service.sessions() > 0 {
        tokio::task::yield_now().await;
    }
    let again = Robot::attach(&gateway, None).await?;
    assert!(!again.welcome.observed && again.welcome.session_epoch > epoch);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_gateway_that_ends_takes_nobody_new_and_waits_until_its_robots_are_elsewhere() -> Result<()> {
    let site = Site::new()?;
    let ((first, _), (second, _)) = (site.gateway().await?, site.gateway().await?);
    let mut old = Robot::attach(&first, None).await?;
    old.beat().await?;
    old.hears(|down| down.echo).await?;
    let ending = tokio::spawn({
        let service = first.service.clone();
        async move { service.move_over().await }
    });
    old.moves_over().await?;
    assert!(Robot::attach(&first, Some(old.proof())).await.is_err(), "no new session here");
    old.beat().await?;
    assert_eq!(old.hears(|down| down.echo.map(|e| e.hb)).await?, 2, "until then it is served");
    let new = Robot::attach(&second, Some(old.proof())).await?;
    assert!(!new.welcome.observed);
    assert_eq!(old.closes().await?.code, CloseCode::MoveOver);
    drop(old);
    ending.await?;
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn status_that_one_gateway_kept_is_known_to_the_next() -> Result<()> {
    let site = Site::new()?;
    let ((first, _), (second, _)) = (site.gateway().await?, site.gateway().await?);
    let mut robot = Robot::attach(&first, None).await?;
    robot.status(crate::world::status_samples(1..=4)).await?;
    let status = midshift_core::robot::Lane::Status;
    let acked = robot.hears(|down| down.acks.iter().find(|a| a.lane == status && a.seq > 0).map(|a| a.seq)).await?;
    assert_eq!(acked, 4);
    let next = Robot::attach(&second, Some(robot.proof())).await?;
    let known = next.welcome.acks.iter().find(|a| a.lane == status).map(|a| a.seq);
    assert_eq!(known, Some(4));
    Ok(())
}
