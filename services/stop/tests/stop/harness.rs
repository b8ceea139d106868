//! A stop service as it is served, on a runtime of its own that can be ended like a process; and a robot's end of a line.

use midshift_core::identity::{Caller, TokenId};
use midshift_core::ids::{RobotId, StopId};
use midshift_core::limits;
use midshift_core::robot::StopLevel;
use midshift_core::site::Site;
use midshift_core::stop::ladder::{Around, Stage};
use midshift_core::stop::{Latch, Stop};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_proto::GoAwayNotice;
use midshift_proto::convert::stop::{CheckIn, FromStop, ToStop};
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_stop::{Error, Parts, StopService, announce_first_start, serve};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_util::sync::CancellationToken;
use tonic::service::InterceptorLayer;
use tonic::transport::Channel;
use tonic::{Code, Request, Status, Streaming};

/// Whatever is waited for comes within this, or the test fails.
pub const WITHIN: Duration = Duration::from_secs(20);

/// All servers of the test program have one wall.
fn elapsed_us() -> u64 {
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_micros() as u64
}

/// Header in which a test says who asks; without it everybody may do everything, as at a port without login.
pub const AS: &str = "as";

/// As a port finds out who asks: `robot:r1`, or `name role@area ...` for the holder of a token.
fn known(mut request: Request<()>) -> Result<Request<()>, Status> {
    request.extensions_mut().insert(Caller::local());
    if let Some(said) = request.metadata().get(AS).map(|said| said.to_str().unwrap().to_owned()) {
        let mut words = said.split(' ');
        let name = words.next().unwrap();
        let caller = match name.strip_prefix("robot:") {
            Some(robot_id) => Caller::robot(RobotId::parse(robot_id).unwrap()),
            None => {
                let grants = words.map(|grant| grant.to_owned().into()).collect();
                Caller::holder(TokenId::new("t1").unwrap(), name.into(), grants, false)
            }
        };
        request.extensions_mut().insert(caller);
    }
    Ok(request)
}

/// A request of this caller.
pub fn asked_as<T>(who: &str, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.metadata_mut().insert(AS, who.parse().unwrap());
    request
}

pub struct Server {
    runtime: Option<Runtime>,
    serving: JoinHandle<Result<(), Error>>,
    shutdown: CancellationToken,
    pub address: SocketAddr,
    /// As whoever runs it has it.
    pub service: StopService,
    ahead_us: Arc<AtomicU64>,
    /// What requests that come now are told of their connection.
    go_away: Arc<Mutex<GoAwayNotice>>,
}

impl Server {
    pub async fn start(folder: &Path) -> Self {
        Self::with_site(folder, None).await
    }

    pub async fn with_site(folder: &Path, site: Option<Arc<Site>>) -> Self {
        let ahead_us = Arc::new(AtomicU64::new(0));
        let ahead = ahead_us.clone();
        let clock = ScaledClock::new(move || elapsed_us() + ahead.load(Relaxed), Utc(1_780_000_000_000), 1000);
        let clock: Arc<dyn Clock> = Arc::new(clock);
        let shutdown = CancellationToken::new();
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let service = eventually(async || {
            let parts = Parts { folder: folder.to_owned(), site: site.clone(), clock: clock.clone() };
            match StopService::open(parts, shutdown.clone()) {
                // The one before has not let go of it yet.
                Err(Error::Latch(midshift_latch::Error::Held { .. })) => None,
                opened => Some(opened.unwrap()),
            }
        })
        .await;
        let (address, incoming) = runtime
            .spawn(async {
                let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
                (listener.local_addr().unwrap(), TcpListenerStream::new(listener))
            })
            .await
            .unwrap();
        let go_away = Arc::new(Mutex::new(GoAwayNotice::default()));
        let told = go_away.clone();
        let asked = move |mut request: Request<()>| {
            request.extensions_mut().insert(told.lock().unwrap().clone());
            known(request)
        };
        let served = service.clone();
        let serving = runtime.spawn(async move {
            let service = served;
            let (routes, drained) = (service.routes().await?, service.drained());
            let port = tonic::transport::Server::builder()
                .accept_http1(true)
                .layer(InterceptorLayer::new(asked))
                .add_routes(routes)
                .serve_with_incoming_shutdown(incoming, drained.clone().cancelled_owned());
            let cut = async {
                drained.cancelled().await;
                tokio::time::sleep(Duration::from_millis(limits::HARD_DRAIN.as_ms())).await;
            };
            let port = async {
                tokio::select! {
                    served = port => served,
                    () = cut => Ok(()),
                }
            };
            serve(service, port).await.map(|served| served.unwrap())
        });
        Self { runtime: Some(runtime), serving, shutdown, address, service, ahead_us, go_away }
    }

    /// All connections that there are now are old.
    pub fn age(&self) {
        std::mem::take(&mut *self.go_away.lock().unwrap()).begin();
    }

    /// The link clock and the wall of this server go ahead.
    pub fn ahead(&self, ms: u64) {
        self.ahead_us.fetch_add(ms * 1000, Relaxed);
    }

    pub fn ask_to_end(&self) {
        self.shutdown.cancel();
    }

    /// Ends in order.
    pub async fn end(mut self) {
        self.shutdown.cancel();
        (&mut self.serving).await.unwrap().unwrap();
    }

    /// Is gone from one moment to the next.
    pub fn kill(mut self) {
        self.runtime.take().unwrap().shutdown_background();
    }

    pub async fn channel(&self) -> Channel {
        Channel::from_shared(format!("http://{}", self.address)).unwrap().connect().await.unwrap()
    }

    pub async fn client(&self) -> StopServiceClient<Channel> {
        StopServiceClient::new(self.channel().await)
    }

    pub async fn status(&self) -> v1::Status {
        let answer = self.client().await.get_status(v1::GetStatusRequest {}).await.unwrap();
        answer.into_inner().status.unwrap()
    }

    pub async fn engaged(&self) -> Vec<String> {
        self.status().await.stops.into_iter().map(|stop| stop.stop.unwrap().stop_id).collect()
    }

    /// Engages, and leaves after the first message.
    pub async fn engage(&self, request: v1::EngageRequest) -> Result<v1::EngageResponse, Status> {
        let mut stream = self.client().await.engage(request).await?.into_inner();
        Ok(stream.message().await?.unwrap())
    }

    pub async fn reset(&self, stop_id: &str) -> v1::ResetResponse {
        let request = v1::ResetRequest {
            stop_id: stop_id.to_owned(),
            reason: "looked, is clear".to_owned(),
            site_id: String::new(),
        };
        self.client().await.reset(request).await.unwrap().into_inner()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

pub fn fleet() -> v1::EngageRequest {
    scope(v1::scope::Scope::Fleet(v1::Fleet {}))
}

pub fn scope(scope: v1::scope::Scope) -> v1::EngageRequest {
    let scope = Some(v1::Scope { scope: Some(scope) });
    v1::EngageRequest { scope, reason: "drill".to_owned(), ..v1::EngageRequest::default() }
}

pub fn id_of(answer: &v1::EngageResponse) -> String {
    answer.stop.as_ref().unwrap().stop_id.clone()
}

/// Asks again and again until there is something, and fails if nothing comes.
pub async fn eventually<T>(mut look: impl AsyncFnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = look().await {
            return found;
        }
        assert!(begun.elapsed() < WITHIN, "it did not come");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

pub async fn within<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(WITHIN, future).await.expect("it did not come")
}

/// A robot's end of a line. It takes over what it is told, and says only what the test says.
pub struct Robot {
    pub robot_id: RobotId,
    up: mpsc::Sender<v1::AttendRequest>,
    pub down: Streaming<v1::AttendResponse>,
    pub latch: Latch,
    pub generation: u64,
    pub is_synced: bool,
    nonce: u64,
    pub answered: u64,
    pub is_moved: bool,
}

impl Robot {
    pub async fn dial(server: &Server, name: &str, stops: Vec<Stop>) -> Self {
        Self::start(server, name, "boot", stops).await.unwrap()
    }

    pub async fn start(server: &Server, name: &str, boot: &str, stops: Vec<Stop>) -> Result<Self, Status> {
        Self::attend(server, name, boot, (stops, Vec::new())).await
    }

    /// One that brings names alone.
    pub async fn bringing(server: &Server, name: &str, more: Vec<StopId>) -> Self {
        Self::attend(server, name, "boot", (Vec::new(), more)).await.unwrap()
    }

    async fn attend(
        server: &Server,
        name: &str,
        boot: &str,
        (stops, more): (Vec<Stop>, Vec<StopId>),
    ) -> Result<Self, Status> {
        let robot_id = RobotId::parse(name).unwrap();
        let (up, sent) = mpsc::channel(4);
        let latch = stops.iter().fold(Latch::default(), |mut latch, stop| {
            latch.engage(stop.clone());
            latch
        });
        let attend = ToStop::Attend { robot_id: robot_id.clone(), boot_id: boot.to_owned(), stops, more };
        up.send((&attend).into()).await.unwrap();
        let mut client = StopLinkServiceClient::new(server.channel().await);
        let down = client.attend(ReceiverStream::new(sent)).await?.into_inner();
        let (generation, nonce, answered) = (0, 0, 0);
        Ok(Self { robot_id, up, down, latch, generation, is_synced: false, nonce, answered, is_moved: false })
    }

    /// Reads one message. None: the line is over.
    pub async fn read(&mut self) -> Result<bool, Status> {
        let Some(message) = within(self.down.message()).await? else { return Ok(false) };
        match midshift_proto::parse(message).unwrap() {
            FromStop::Facts { stops, resets, generation } => {
                for stop in stops {
                    self.latch.engage(stop);
                }
                for reset in resets {
                    self.latch.reset(reset);
                }
                self.generation = self.generation.max(generation);
            }
            FromStop::Synced { generation, .. } => {
                self.generation = self.generation.max(generation);
                self.is_synced = true;
            }
            FromStop::CheckInAnswer { nonce, generation } => {
                assert_eq!(generation, self.generation, "an answer never overtakes what it speaks of");
                self.answered = nonce;
            }
            FromStop::MoveOver => self.is_moved = true,
        }
        Ok(true)
    }

    pub async fn until(&mut self, mut is_so: impl FnMut(&Self) -> bool) {
        while !is_so(self) {
            assert!(self.read().await.unwrap(), "the line ended");
        }
    }

    pub async fn synced(mut self) -> Self {
        self.until(|robot| robot.is_synced).await;
        self
    }

    /// Says that it obeys all it knows of, standing or not.
    pub fn obeying(&self, is_still: bool) -> CheckIn {
        let inside: Vec<StopId> = self.latch.over(&self.robot_id, None).map(|stop| stop.stop_id.clone()).collect();
        CheckIn {
            nonce: 0,
            generation: self.generation,
            is_durable: true,
            level: self.latch.level(&self.robot_id, None),
            is_still,
            awaiting: inside.clone(),
            inside,
            stage: Stage::Heard,
            around: Around::People,
        }
    }

    pub async fn say(&mut self, said: CheckIn) {
        self.nonce += 1;
        let said = ToStop::CheckIn(CheckIn { nonce: self.nonce, ..said });
        self.up.send((&said).into()).await.unwrap();
    }

    /// Checks in and waits for the answer.
    pub async fn check_in(&mut self, said: CheckIn) {
        self.say(said).await;
        let nonce = self.nonce;
        self.until(|robot| robot.answered == nonce).await;
    }

    pub fn effective(&self) -> Vec<String> {
        self.latch.effective().map(|stop| stop.stop_id.to_string()).collect()
    }

    pub fn knows(&self, stop_id: &str) -> bool {
        self.latch.stop(&StopId::parse(stop_id).unwrap()).is_some()
    }
}

/// A stop as the service told it to a robot.
pub fn told(robot: &Robot, stop_id: &str) -> Stop {
    robot.latch.stop(&StopId::parse(stop_id).unwrap()).unwrap().clone()
}

pub fn code(result: Result<impl Sized, Status>) -> Code {
    result.err().map_or(Code::Ok, |status| status.code())
}

pub fn slow() -> i32 {
    use midshift_proto::convert::WireEnum;
    StopLevel::Slow.to_wire()
}

pub fn halt() -> i32 {
    use midshift_proto::convert::WireEnum;
    StopLevel::Halt.to_wire()
}

pub struct Folder(tempfile::TempDir);

impl Folder {
    /// Of a site that is new.
    pub fn new() -> Self {
        let folder = Self(tempfile::tempdir().unwrap());
        assert!(announce_first_start(&folder.path()).unwrap());
        folder
    }
    pub fn path(&self) -> PathBuf {
        self.0.path().join("stop")
    }
}
