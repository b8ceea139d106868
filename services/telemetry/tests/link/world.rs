//! Telemetry over a real gRPC connection in memory, and a robot that says what a test wants.

use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::identity::{Caller, Digest, TokenId};
use midshift_core::ids::{RobotId, SiteId, WaypointId};
use midshift_core::robot::{Lane, Mode, ReportedState, Vitals};
use midshift_core::robot_events::{InboxItem, RobotEvent, Sample, SampleBody};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_proto::GoAwayNotice;
use midshift_proto::link::v1::link_service_client::LinkServiceClient;
use midshift_proto::link::v1::{SessionRequest, SessionResponse};
use midshift_proto::session::{
    ClockSample, Close, Downlink, FromRobot, Heartbeat, Hello, LaneBatch, Previous, ToRobot, Uplink, Welcome,
};
use midshift_store::{FrameLog, LiveBoard, MemoryFrames, MemoryStore, Store, StoreId};
use midshift_telemetry::{Bugs, Parts, TelemetryService};
use std::sync::{Arc, Mutex};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::service::{InterceptorLayer, Routes};
use tonic::transport::{Channel, Endpoint, Server};
use tonic::{Request, Status, Streaming};

pub type Result<T> = std::result::Result<T, Box<dyn std::error::Error + Send + Sync>>;

pub struct World {
    pub store: Arc<dyn Store>,
    pub channel: Channel,
    pub service: TelemetryService,
    pub board: Arc<LiveBoard<NewestHeartbeat>>,
    /// Ends the service.
    pub end: CancellationToken,
    go_away: GoAwayNotices,
    pipes: Pipes,
}

/// What requests that come now are told of their connection.
type GoAwayNotices = Arc<Mutex<GoAwayNotice>>;
type Pipes = mpsc::Sender<std::io::Result<tokio::io::DuplexStream>>;

impl World {
    /// All connections that there are now are old.
    pub fn age(&self) {
        std::mem::take(&mut *self.go_away.lock().expect("not poisoned")).begin();
    }
    /// Another connection.
    pub async fn dial(&self) -> Result<Channel> {
        dial(self.pipes.clone()).await
    }
}

async fn dial(pipes: Pipes) -> Result<Channel> {
    let connector = tower::service_fn(move |_: tonic::transport::Uri| {
        let pipes = pipes.clone();
        async move {
            let (ours, theirs) = tokio::io::duplex(1 << 16);
            pipes.send(Ok(theirs)).await.map_err(std::io::Error::other)?;
            Ok::<_, std::io::Error>(hyper_util::rt::TokioIo::new(ours))
        }
    });
    Ok(Endpoint::from_static("http://memory").connect_with_connector(connector).await?)
}

/// What a world may have otherwise.
#[derive(Default)]
pub struct Otherwise {
    pub bugs: Bugs,
    /// Instead of one in memory.
    pub frames: Option<Arc<dyn FrameLog>>,
}

pub fn clock() -> Arc<dyn Clock> {
    let started = tokio::time::Instant::now();
    let micros = move || started.elapsed().as_micros() as u64;
    Arc::new(ScaledClock::new(micros, Utc(1_800_000_000_000), 1000))
}

pub async fn world() -> Result<World> {
    world_with(Otherwise::default()).await
}

pub async fn world_with(otherwise: Otherwise) -> Result<World> {
    let clock = clock();
    let store: Arc<dyn Store> =
        Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let frames = otherwise.frames.unwrap_or_else(|| Arc::new(MemoryFrames::new(clock.clone(), 1 << 20)));
    serve(Parts { store, frames, board: LiveBoard::new(), heard: None, clock, bugs: otherwise.bugs }).await
}

/// A world whose service has read nothing before `read`.
pub async fn world_after(read: impl Future<Output = ()> + Send + 'static) -> Result<World> {
    let clock = clock();
    let store = Arc::new(MemoryStore::new(SiteId::parse("s")?, StoreId(Arc::from("store-1")), clock.clone()));
    let frames = Arc::new(MemoryFrames::new(clock.clone(), 1 << 20));
    let bugs = Bugs::default();
    serve_after(Parts { store, frames, board: LiveBoard::new(), heard: None, clock, bugs }, read).await
}

/// The service of these parts, and a way to it.
pub async fn serve(parts: Parts) -> Result<World> {
    serve_after(parts, std::future::ready(())).await
}

/// The same, of a service that has read nothing before `read`.
pub async fn serve_after(parts: Parts, read: impl Future<Output = ()> + Send + 'static) -> Result<World> {
    let (store, board) = (parts.store.clone(), parts.board.clone());
    let end = CancellationToken::new();
    let service = TelemetryService::new(parts, end.clone());
    let running = service.clone();
    tokio::spawn(async move {
        read.await;
        running.run().await
    });
    let (pipes, incoming) = mpsc::channel::<std::io::Result<tokio::io::DuplexStream>>(8);
    let go_away = GoAwayNotices::default();
    let told = go_away.clone();
    let layer = InterceptorLayer::new(move |mut request: Request<()>| {
        request.extensions_mut().insert(told.lock().expect("not poisoned").clone());
        known(request)
    });
    let server = Server::builder().layer(layer).add_routes(service.add_to(Routes::default()));
    tokio::spawn(server.serve_with_incoming(ReceiverStream::new(incoming)));
    let channel = dial(pipes.clone()).await?;
    Ok(World { store, channel, service, board, end, go_away, pipes })
}

/// Header in which a test says who asks; without it everybody may do everything, as at a port without login.
const AS: &str = "as";

/// As a port finds out who asks: `robot:r1`, `robot:r1#SERIAL` with the serial number of its certificate, `robot:r1#SERIAL#BYTE` with its key too, of 32 such bytes,
/// or `name role@area ...` for the holder of a token.
fn known(mut request: Request<()>) -> std::result::Result<Request<()>, Status> {
    request.extensions_mut().insert(Caller::local());
    if let Some(said) = request.metadata().get(AS).and_then(|said| said.to_str().ok()).map(str::to_owned) {
        let unreadable = || Status::internal("a test says who asks in words that mean nothing");
        let mut words = said.split(' ');
        let name = words.next().ok_or_else(unreadable)?;
        let caller = match name.strip_prefix("robot:") {
            Some(robot) => {
                let mut parts = robot.split('#');
                let robot_id = parts.next().ok_or_else(unreadable)?;
                let robot = Caller::robot(RobotId::parse(robot_id).map_err(|_| unreadable())?);
                let robot = robot.with_certificate(parts.next().map(Into::into));
                match parts.next().map(str::parse::<u8>) {
                    Some(byte) => robot.with_key(Digest([byte.map_err(|_| unreadable())?; 32])),
                    None => robot,
                }
            }
            None => {
                let grants = words.map(|grant| grant.to_owned().into()).collect();
                let token = TokenId::new("t1").ok_or_else(unreadable)?;
                Caller::holder(token, name.into(), grants, false)
            }
        };
        request.extensions_mut().insert(caller);
    }
    Ok(request)
}

/// A request of this caller.
pub fn asked_as<T>(who: &str, message: T) -> Result<Request<T>> {
    let mut request = Request::new(message);
    request.metadata_mut().insert(AS, who.parse()?);
    Ok(request)
}

/// STATUS of these numbers.
pub fn status_samples(seqs: std::ops::RangeInclusive<u64>) -> Vec<InboxItem> {
    let body = SampleBody::Status(Vitals { speed_mm_s: 1_500, battery_permille: 800, ..Vitals::default() });
    seqs.map(|seq| InboxItem::Sample(Sample { seq, robot_unix_ms: 1_800_000_000_000, body: body.clone() })).collect()
}

pub struct Robot {
    up: mpsc::Sender<SessionRequest>,
    down: Streaming<SessionResponse>,
    pub welcome: Welcome,
    pub hb: u64,
}

pub fn hello(previous: Option<Previous>) -> Result<Hello> {
    Ok(Hello { previous, ..Hello::new(RobotId::parse("r1")?, "boot", "ring") })
}

impl Robot {
    pub async fn attach(world: &World, previous: Option<Previous>) -> Result<Self> {
        Self::attach_saying(world, hello(previous)?).await
    }
    pub async fn attach_saying(world: &World, hello: Hello) -> Result<Self> {
        Self::attach_asking(world, hello, Request::new).await
    }
    /// As somebody says who asks.
    pub async fn attach_asking(
        world: &World,
        hello: Hello,
        ask: impl FnOnce(ReceiverStream<SessionRequest>) -> Request<ReceiverStream<SessionRequest>>,
    ) -> Result<Self> {
        Self::attach_over(world.channel.clone(), hello, ask).await
    }
    /// Over a connection of its own.
    pub async fn attach_over(
        channel: Channel,
        hello: Hello,
        ask: impl FnOnce(ReceiverStream<SessionRequest>) -> Request<ReceiverStream<SessionRequest>>,
    ) -> Result<Self> {
        let (up, outbound) = mpsc::channel(16);
        up.send((&FromRobot::Hello(Box::new(hello))).into()).await?;
        let mut client = LinkServiceClient::new(channel);
        let mut down = client.session(ask(ReceiverStream::new(outbound))).await?.into_inner();
        let first = down.message().await?.ok_or("no welcome")?;
        let ToRobot::Welcome(welcome) = midshift_proto::parse(first)? else { return Err("not a welcome".into()) };
        Ok(Self { up, down, welcome, hb: 0 })
    }
    pub fn proof(&self) -> Previous {
        Previous { session_epoch: self.welcome.session_epoch, secret: self.welcome.session_secret.clone() }
    }
    pub async fn say(&self, uplink: Uplink) -> Result<()> {
        Ok(self.up.send((&FromRobot::Uplink(uplink)).into()).await?)
    }
    pub async fn beat(&mut self) -> Result<()> {
        self.beat_with(None).await
    }
    pub async fn beat_with(&mut self, clock: Option<ClockSample>) -> Result<()> {
        self.beat_at(None, clock).await
    }
    /// A heartbeat from a waypoint.
    pub async fn beat_at(&mut self, waypoint: Option<&str>, clock: Option<ClockSample>) -> Result<()> {
        let waypoint = waypoint.map(WaypointId::parse).transpose()?;
        let vitals = Vitals { waypoint, ..Vitals::default() };
        self.beat_saying(ReportedState { vitals, ..ReportedState::default() }, clock).await
    }
    /// A heartbeat that says this; its number and session are put in.
    pub async fn beat_saying(&mut self, reported: ReportedState, clock: Option<ClockSample>) -> Result<()> {
        self.hb += 1;
        let reported = ReportedState { hb: self.hb, session_epoch: self.welcome.session_epoch, ..reported };
        self.say(Uplink { heartbeat: Some(Heartbeat { reported, sent_unix_us: 0, clock }), batches: Vec::new() }).await
    }
    pub async fn events(&self, seqs: std::ops::RangeInclusive<u64>) -> Result<()> {
        let body = SampleBody::Event(RobotEvent::Mode(Mode::Automatic));
        let items = seqs.map(|seq| InboxItem::Sample(Sample { seq, robot_unix_ms: 0, body: body.clone() })).collect();
        self.say(Uplink { heartbeat: None, batches: vec![LaneBatch { lane: Lane::Event, items }] }).await
    }
    pub async fn status(&self, items: Vec<InboxItem>) -> Result<()> {
        self.say(Uplink { heartbeat: None, batches: vec![LaneBatch { lane: Lane::Status, items }] }).await
    }
    /// Waits until the server has taken what was sent on this session before.
    pub async fn is_taken(&mut self) -> Result<()> {
        self.beat().await?;
        self.hears(|down| down.echo).await?;
        Ok(())
    }
    /// The next downlink that says something of what is looked for.
    pub async fn hears<T>(&mut self, look: impl Fn(&Downlink) -> Option<T>) -> Result<T> {
        while let Some(message) = self.down.message().await? {
            if let ToRobot::Downlink(down) = midshift_proto::parse(message)?
                && let Some(found) = look(&down)
            {
                return Ok(found);
            }
        }
        Err("the session ended".into())
    }
    /// It is asked for its next session.
    pub async fn moves_over(&mut self) -> Result<()> {
        while let Some(message) = self.down.message().await? {
            if let ToRobot::MoveOver { .. } = midshift_proto::parse(message)? {
                return Ok(());
            }
        }
        Err("the session ended".into())
    }
    pub async fn closes(&mut self) -> Result<Close> {
        while let Some(message) = self.down.message().await? {
            if let ToRobot::Close(close) = midshift_proto::parse(message)? {
                return Ok(close);
            }
        }
        Err("the session ended without a word".into())
    }
    /// As [`Robot::closes`]; an error if a heartbeat was echoed before it.
    pub async fn closes_unechoed(&mut self) -> Result<Close> {
        while let Some(message) = self.down.message().await? {
            match midshift_proto::parse(message)? {
                ToRobot::Close(close) => return Ok(close),
                ToRobot::Downlink(down) if down.echo.is_some() => return Err(format!("echoed: {down:?}").into()),
                _ => {}
            }
        }
        Err("the session ended without a word".into())
    }
}
