//! The robot's session over a real gRPC connection in memory: welcome, acknowledgements, desired state, succession, clones.

use midshift_core::ids::{RobotId, SiteId};
use midshift_core::robot::{Inventory, Lane, Mode, ReportedState};
use midshift_core::rows::{Expect, Item, Log, Seq, Writer};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_core::work::{DesiredWork, InboxItem, RobotEvent, Sample, SampleBody};
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::link::v1::{SessionRequest, SessionResponse};
use midshift_proto::session::{
    Close, CloseCode, Downlink, FromRobot, Heartbeat, Hello, LaneBatch, Previous, ToRobot, Uplink, Welcome,
};
use midshift_store::{LiveBoard, MemoryFrames, MemoryStore, Store, StoreId};
use midshift_telemetry::{Bugs, Parts, SeededBug, TelemetryService};
use std::collections::BTreeMap;
use std::sync::Arc;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::Streaming;
use tonic::transport::{Channel, Endpoint, Server};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

struct World {
    store: Arc<dyn Store>,
    channel: Channel,
}

async fn world() -> Result<World> {
    world_with(Bugs::default()).await
}

async fn world_with(bugs: Bugs) -> Result<World> {
    let started = tokio::time::Instant::now();
    let micros = move || started.elapsed().as_micros() as u64;
    let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(micros, Utc(1_800_000_000_000), 1000));
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let parts = Parts {
        store: store.clone(),
        frames: Arc::new(MemoryFrames::new(clock.clone(), 1 << 20)),
        board: LiveBoard::new(),
        clock,
        bugs,
    };
    let service = TelemetryService::new(parts, CancellationToken::new());
    tokio::spawn(service.clone().run());
    let (pipes, incoming) = mpsc::channel::<std::io::Result<tokio::io::DuplexStream>>(8);
    tokio::spawn(Server::builder().add_service(service.link()).serve_with_incoming(ReceiverStream::new(incoming)));
    let connector = tower::service_fn(move |_: tonic::transport::Uri| {
        let pipes = pipes.clone();
        async move {
            let (ours, theirs) = tokio::io::duplex(1 << 16);
            pipes.send(Ok(theirs)).await.map_err(std::io::Error::other)?;
            Ok::<_, std::io::Error>(hyper_util::rt::TokioIo::new(ours))
        }
    });
    let channel = Endpoint::from_static("http://memory").connect_with_connector(connector).await?;
    Ok(World { store, channel })
}

struct Robot {
    up: mpsc::Sender<SessionRequest>,
    down: Streaming<SessionResponse>,
    welcome: Welcome,
    hb: u64,
}

fn hello(previous: Option<Previous>) -> Result<Hello> {
    Ok(Hello {
        robot_id: RobotId::parse("r1")?,
        boot_id: "boot".into(),
        previous,
        inventory: Inventory::default(),
        reported: ReportedState::default(),
        ring: "ring".into(),
        lanes: BTreeMap::new(),
        store_id: String::new(),
        sent_unix_ms: 0,
        clock_rate_permille: 1000,
        protocol_versions: vec![1],
    })
}

impl Robot {
    async fn attach(world: &World, previous: Option<Previous>) -> Result<Self> {
        let (up, outbound) = mpsc::channel(16);
        up.send((&FromRobot::Hello(Box::new(hello(previous)?))).into()).await?;
        let mut down =
            LinkServiceClient::new(world.channel.clone()).session(ReceiverStream::new(outbound)).await?.into_inner();
        let first = down.message().await?.ok_or("no welcome")?;
        let ToRobot::Welcome(welcome) = midshift_proto::parse(first)? else { return Err("not a welcome".into()) };
        Ok(Self { up, down, welcome, hb: 0 })
    }
    fn proof(&self) -> Previous {
        Previous { session_epoch: self.welcome.session_epoch, secret: self.welcome.session_secret.clone() }
    }
    async fn say(&self, uplink: Uplink) -> Result<()> {
        Ok(self.up.send((&FromRobot::Uplink(uplink)).into()).await?)
    }
    async fn beat(&mut self) -> Result<()> {
        self.hb += 1;
        let reported =
            ReportedState { hb: self.hb, session_epoch: self.welcome.session_epoch, ..ReportedState::default() };
        self.say(Uplink { heartbeat: Some(Heartbeat { reported, sent_unix_us: 0, clock: None }), batches: Vec::new() })
            .await
    }
    async fn events(&self, seqs: std::ops::RangeInclusive<u64>) -> Result<()> {
        let body = SampleBody::Event(RobotEvent::Mode(Mode::Automatic));
        let items = seqs.map(|seq| InboxItem::Sample(Sample { seq, robot_unix_ms: 0, body: body.clone() })).collect();
        self.say(Uplink { heartbeat: None, batches: vec![LaneBatch { lane: Lane::Event, items }] }).await
    }
    /// The next downlink that says something of what is looked for.
    async fn hears<T>(&mut self, look: impl Fn(&Downlink) -> Option<T>) -> Result<T> {
        while let Some(message) = self.down.message().await? {
            if let ToRobot::Downlink(down) = midshift_proto::parse(message)?
                && let Some(found) = look(&down)
            {
                return Ok(found);
            }
        }
        Err("the session ended".into())
    }
    async fn closes(&mut self) -> Result<Close> {
        while let Some(message) = self.down.message().await? {
            if let ToRobot::Close(close) = midshift_proto::parse(message)? {
                return Ok(close);
            }
        }
        Err("the session ended without a word".into())
    }
}

async fn inbox(world: &World) -> Result<usize> {
    Ok(world.store.feed(Seq(0), &[Log::RobotInbox], 1_000).await?.entries.len())
}

#[tokio::test(start_paused = true)]
async fn events_are_durable_when_they_are_acknowledged_and_stored_once() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.events(1..=3).await?;
    let acked = |down: &Downlink| {
        down.acks.iter().find(|a| a.lane == Lane::Event && a.expect.is_none()).map(|a| a.seq).filter(|seq| *seq > 0)
    };
    assert_eq!(robot.hears(acked).await?, 3);
    assert_eq!(inbox(&world).await?, 3);
    robot.events(2..=4).await?;
    assert_eq!(robot.hears(|down| acked(down).filter(|seq| *seq > 3)).await?, 4);
    assert_eq!(inbox(&world).await?, 4);
    robot.events(6..=6).await?;
    assert_eq!(robot.hears(|down| down.acks.iter().find_map(|a| a.expect)).await?, 5);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_heartbeat_is_echoed_and_new_desired_work_is_pushed() -> Result<()> {
    let world = world().await?;
    let mut robot = Robot::attach(&world, None).await?;
    robot.beat().await?;
    assert_eq!(robot.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    let work = DesiredWork {
        robot_id: RobotId::parse("r1")?,
        generation: 7,
        assignment: None,
        grants: Vec::new(),
        held: true,
        resume: None,
        closed: Vec::new(),
        maintenance: None,
    };
    let mut item = Item::new(Writer::Fleet, "fleet");
    item.put(&work, Expect::Absent, "work.desired");
    assert!(world.store.commit(vec![item]).await.iter().all(|applied| applied.is_ok()));
    assert_eq!(robot.hears(|down| down.work.clone()).await?, work);
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_proven_succession_ends_the_older_session() -> Result<()> {
    let world = world().await?;
    let mut old = Robot::attach(&world, None).await?;
    old.beat().await?;
    let new = Robot::attach(&world, Some(old.proof())).await?;
    assert!(new.welcome.session_epoch > old.welcome.session_epoch && !new.welcome.observed);
    let close = old.closes().await?;
    assert_eq!((close.code, close.retry_after_ms), (CloseCode::Fenced, 60_000));
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn without_the_fence_a_clone_takes_over_a_robot_that_is_heard() -> Result<()> {
    let world = world_with(Bugs::of(&[SeededBug::NoCloneFence])).await?;
    let mut first = Robot::attach(&world, None).await?;
    first.beat().await?;
    let clone = Robot::attach(&world, None).await?;
    assert!(!clone.welcome.observed, "two machines of one name, and the second has its work");
    Ok(())
}

#[tokio::test(start_paused = true)]
async fn a_session_without_proof_is_only_observed_while_the_older_one_is_heard() -> Result<()> {
    let world = world().await?;
    let mut first = Robot::attach(&world, None).await?;
    first.beat().await?;
    let mut clone = Robot::attach(&world, None).await?;
    assert!(clone.welcome.observed);
    clone.events(1..=1).await?;
    first.beat().await?;
    assert_eq!(first.hears(|down| down.echo.map(|e| e.hb)).await?, 1);
    assert_eq!(inbox(&world).await?, 0, "an observed session writes nothing");
    let facts = world.store.feed(Seq(0), &[Log::Telemetry], 100).await?.entries;
    assert!(facts.iter().any(|f| &*f.kind == "session.clone_seen"));
    // The older one falls silent: the clone is asked to come back, and then it is in charge.
    let close = clone.closes().await?;
    assert_eq!(close.code, CloseCode::MoveOver);
    assert!(!Robot::attach(&world, None).await?.welcome.observed);
    Ok(())
}
