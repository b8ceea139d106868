//! Fleet stop as a service: stops are engaged at once, kept in files of its own, told to every robot, and shown as each robot itself confirms them.
//!
//! An operational stop request: not a safety function, no performance level. The independent emergency stop is the hardware of the robot's maker and
//! integrator, whose state midshift shows and never replaces; midshift is not suitable as part of a safety system.
//!
//! Called by its program, [`program`], and by `dev`: [`StopService::open`], [`StopService::routes`], [`StopService::run`] and [`serve`]. Invariant: nothing of the store, the task
//! queue or another service lies on its way; an engage waits for no robot, and for the disk only with its answer; a folder without its memory, or one that
//! cannot be read, begins with the fleet stopped. Absent on purpose: who may come in: that is the port's, and is told here only so that it can be recorded.

mod acts;
pub mod audit;
mod confirm;
mod disk;
mod face;
mod first;
mod frames;
mod ground;
mod grpc;
mod holder;
mod law;
mod line;
mod opening;
mod outbox;
pub mod port;
pub mod program;
mod proof;
mod robots;
mod snapshot;
mod status;

pub use first::{FIRST, announce_first_start, withdraw_first_start};
pub use holder::{HOLDER, NotEnded, end_holder, is_held};
pub use snapshot::{Copied, Principals, Roster};

use audit::{Action, Broken, Note, Verified};
use disk::{Disk, Writer};
use face::LinkFace;
use ground::Ground;
use law::{Kept, Law};
use midshift_core::Boxed;
use midshift_core::identity::Actor;
use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::site::Site;
use midshift_core::stop::Latch;
use midshift_core::time::{Clock, LinkTime, Now, Utc};
use midshift_proto::stop::v1::stop_service_server::StopServiceServer;
use proof::Key;
use robots::Robots;
use std::fs::DirBuilder;
use std::io;
use std::net::IpAddr;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// Messages on their way to one watcher.
const WATCH_MAX: usize = 4;
/// So often in a row something may come between the disk's turn and the end of a service that is followed.
const FOLLOW_TRIES: u32 = 100;
/// Names of the files that others look at.
const LATCH: &str = "latch";

/// What keeps the service from beginning, or ends it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The folder says no.
    #[error("opening the folder of stops {path}: {source}", path = path.display())]
    Folder {
        /// The folder of stops.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The latch cannot be held.
    #[error(transparent)]
    Latch(#[from] midshift_latch::Error),
    /// The descriptors of its own services cannot be read.
    #[error("building reflection: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// A part of it ended.
    #[error("a part of the stop service ended by itself")]
    Ended,
}

impl Error {
    /// Another process has the folder.
    pub fn is_held(&self) -> bool {
        matches!(self, Self::Latch(midshift_latch::Error::Held { .. }))
    }
}

/// What the service is built from.
#[derive(Clone)]
pub struct Parts {
    /// Latch, audit, key and roster; made with mode 0700. One process has it at a time.
    pub folder: PathBuf,
    /// Where areas and zones are. None: every part means everywhere.
    pub site: Option<Arc<Site>>,
    /// Where the time of the wall and of the link is read.
    pub clock: Arc<dyn Clock>,
}

pub(crate) struct Inner {
    clock: Arc<dyn Clock>,
    /// Which site's; none: there is no site file.
    site_id: Option<SiteId>,
    ground: Ground,
    key: Key,
    /// Taken before `law` by whoever changes it: lines hear of changes in their order.
    fan: Mutex<()>,
    law: Mutex<Law>,
    robots: Robots,
    disk: Disk,
    /// Counts what watchers may want to look at.
    changed: watch::Sender<u64>,
    watchers: Arc<Semaphore>,
    /// When who is known was last said to be what it is; unset: nobody looks.
    principals: OnceLock<watch::Receiver<Utc>>,
    started: LinkTime,
    /// It was asked to end.
    shutdown: CancellationToken,
    /// Streams end.
    ended: CancellationToken,
}

impl Inner {
    fn touch(&self) {
        self.changed.send_modify(|n| *n += 1);
    }
}

/// A lock whose holder panicked holds what it held: the latch only ever adds up.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Work with files, off the threads that answer.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done,
        Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
        // The runtime goes away, and with it whoever waits.
        Err(_) => std::future::pending().await,
    }
}

/// Moments of the link clock as people read them.
trait Times {
    /// UTC of the wall at a moment before or after now.
    fn wall_at(&self, at: LinkTime) -> Utc;
}

impl Times for Now {
    fn wall_at(&self, at: LinkTime) -> Utc {
        Utc(self.wall.0 + at.0.cast_signed() - self.link.0.cast_signed())
    }
}

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct StopService {
    inner: Arc<Inner>,
    folder: PathBuf,
    writer: Arc<Mutex<Option<Writer>>>,
}

impl StopService {
    /// Opens the folder. Nothing runs yet; [`StopService::run`] does, until `shutdown`.
    ///
    /// # Errors
    /// The folder cannot be used, or another process has it ([`midshift_latch::Error::Held`]).
    pub fn open(parts: Parts, shutdown: CancellationToken) -> Result<Self, Error> {
        let Parts { folder, site, clock } = parts;
        let failed = |source| Error::Folder { path: folder.clone(), source };
        let now = clock.now();
        DirBuilder::new().recursive(true).mode(0o700).create(&folder).map_err(failed)?;
        let opened = opening::open(&folder, now.wall)?;
        let ended = CancellationToken::new();
        let inner = Arc::new(Inner {
            site_id: site.as_deref().map(|site| site.site_id().clone()),
            ground: Ground::of(site.as_deref()),
            key: opened.key,
            fan: Mutex::new(()),
            law: Mutex::new(Law::begin(opened.kept, now.wall)),
            robots: Robots::default(),
            disk: Disk::default(),
            changed: watch::Sender::new(0),
            watchers: Arc::new(Semaphore::new(limits::STOP_WATCHERS_MAX)),
            principals: OnceLock::new(),
            started: now.link,
            clock,
            shutdown,
            ended,
        });
        opened.notes.into_iter().for_each(|note| inner.disk.note(note));
        snapshot::look_first(&inner, &folder);
        let engaged = lock(&inner.law).latch().effective().count();
        inner.disk.note(Note::own(now.wall, Action::Started).with("engaged", engaged));
        tracing::info!(engaged, "stop service opened");
        Ok(Self { inner, folder, writer: Arc::new(Mutex::new(Some(opened.writer))) })
    }

    /// With both faces, that of people and programs and that of robots.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let face = StopServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes
            .add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
            .add_service(LinkFace(self.inner.clone()))
    }

    /// Stops that are engaged now.
    pub fn engaged(&self) -> usize {
        lock(&self.inner.law).latch().effective().count()
    }

    /// Both faces, health of both, and reflection of these and nothing else.
    ///
    /// # Errors
    /// The descriptors cannot be read: a fault of the build.
    pub fn routes(&self) -> Boxed<'_, Result<Routes, Error>> {
        Box::pin(async move {
            let reflection = || {
                let names =
                    ["midshift.stop.v1.StopService", "midshift.stop.v1.StopLinkService", "grpc.health.v1.Health"];
                let builder = tonic_reflection::server::Builder::configure()
                    .register_encoded_file_descriptor_set(midshift_proto::FILE_DESCRIPTOR_SET)
                    .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
                    .register_encoded_file_descriptor_set(tonic_types::pb::FILE_DESCRIPTOR_SET);
                names.into_iter().fold(builder, |builder, name| builder.with_service_name(name))
            };
            let (health, health_service) = tonic_health::server::health_reporter();
            health.set_serving::<StopServiceServer<Self>>().await;
            health.set_serving::<LinkFace>().await;
            let routes = Routes::new(health_service.max_decoding_message_size(limits::HEALTH_MESSAGE_BYTES))
                .add_service(reflection().build_v1()?.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
                .add_service(reflection().build_v1alpha()?.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES));
            Ok(self.add_to(routes))
        })
    }

    /// Shows when who is known was last written down, or said to be so still, as the port follows it. The first one counts.
    pub fn show_principals(&self, told: watch::Receiver<Utc>) {
        // A second one is a fault of whoever calls, and changes nothing.
        let _ = self.inner.principals.set(told);
    }

    /// Records that the port denied somebody something, unless too many are; `robot_id`: the robot that was named, if one was; `left_out`: so many that the port itself
    /// did not tell of.
    pub fn denied(
        &self,
        actor: &Actor,
        network: IpAddr,
        path: &str,
        robot_id: Option<&str>,
        code: Code,
        left_out: u64,
    ) {
        let note = Note::of(self.inner.clock.now().wall, Action::Denied, actor);
        let note = note.with("code", code).with("asked", path).with("network", network);
        let note = robot_id.iter().fold(note, |note, robot_id| note.with("robot_id", robot_id));
        self.inner.disk.denied(note, left_out);
    }

    /// Looks at what every stop and every check-in needs. One that hangs does not come back from here.
    pub fn look_at_locks(&self) {
        drop(lock(&self.inner.fan));
        drop(lock(&self.inner.law));
    }

    /// Records that another process is ready to follow this one, and ends. False: the disk does not hold that, or not all that is engaged and reset, so that this one
    /// goes on.
    pub fn is_followed(&self) -> Boxed<'_, bool> {
        Box::pin(async move {
            let inner = &self.inner;
            if !inner.disk.record(Note::own(inner.clock.now().wall, Action::Followed)).await {
                return false;
            }
            // What comes in between waits for the disk, and whoever asked for it for this service.
            for _ in 0..FOLLOW_TRIES {
                let version = lock(&inner.law).version();
                if !inner.disk.turn(version).await {
                    return false;
                }
                let _fan = lock(&inner.fan);
                if inner.disk.holds(lock(&inner.law).version()) {
                    inner.shutdown.cancel();
                    return true;
                }
            }
            false
        })
    }

    /// When its lines have ended, so that its port may close.
    pub fn drained(&self) -> CancellationToken {
        self.inner.ended.clone()
    }

    /// Keeps files and roster until shutdown; then tells robots to dial again and ends all streams, without waiting: whoever is to follow can begin only when this
    /// one has let go of the folder and the port, and robots are without a line for that long. Called once.
    ///
    /// # Errors
    /// A part ended by itself, or it was called before.
    pub fn run(self) -> Boxed<'static, Result<(), Error>> {
        Box::pin(async move {
            let inner = self.inner;
            let Some(writer) = lock(&self.writer).take() else { return Err(Error::Ended) };
            let (shutdown, ended) = (inner.shutdown.clone(), inner.ended.clone());
            let _end = ended.clone().drop_guard();
            let moving = async {
                shutdown.cancelled().await;
                let now = inner.clock.now().link;
                // A line that begins now sees that it is too late, or is among these.
                let _fan = lock(&inner.fan);
                inner.robots.lines().iter().for_each(|line| line.finish(now));
            };
            let following = async {
                tokio::select! {
                    () = shutdown.cancelled() => {}
                    () = snapshot::follow_files(&inner, self.folder.clone()) => {}
                }
            };
            tokio::join!(disk::keep(&inner, writer), moving, following);
            Ok(())
        })
    }
}

/// Runs the service behind `port`, which serves its routes until [`StopService::drained`] and then within its own bounds. What the port said at its end.
///
/// # Errors
/// The service ended by itself.
pub async fn serve<E>(service: StopService, port: impl Future<Output = Result<(), E>>) -> Result<Result<(), E>, Error> {
    let shutdown = service.inner.shutdown.clone();
    // However this ends, also in a panic: nothing goes on without the rest.
    let _end = shutdown.clone().drop_guard();
    let running = service.run();
    let serving = async {
        let served = port.await;
        shutdown.cancel();
        served
    };
    let (served, ran) = tokio::join!(serving, running);
    ran.map(|()| served)
}

/// Reads the whole audit in the folder of a stop service, also while it runs.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn verify(folder: &Path) -> Result<Verified, Broken> {
    let (_, kept) = midshift_latch::read::<Kept>(&folder.join(LATCH))?;
    audit::verify(folder, &kept.audit)
}

/// What the stop service in this folder keeps, and a number that rises with each change of it; also while it runs. None: none was ever started here.
///
/// # Errors
/// The latch cannot be read.
pub fn latch(folder: &Path) -> Result<Option<(u64, Latch)>, midshift_latch::Error> {
    let path = folder.join(LATCH);
    let there = path.try_exists();
    if !there.map_err(|source| midshift_latch::Error::Io { doing: "looking for", path: path.clone(), source })? {
        return Ok(None);
    }
    midshift_latch::read::<Kept>(&path).map(|(generation, kept)| Some((generation, kept.latch)))
}
