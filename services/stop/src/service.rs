//! The service as its program and `dev` have it: opened, served, followed by another one, ended.
//!
//! Invariant: it ends for another one only when the disk holds all that it knows.

use crate::audit::{Action, Note};
use crate::disk::Disk;
use crate::engaged::EngagedStops;
use crate::error::Error;
use crate::inner::{Inner, Parts};
use crate::robot_rpc::LinkFace;
use crate::robots::Robots;
use crate::site_index::SiteIndex;
use crate::threads::lock;
use crate::writer::{self, Writer};
use crate::{opening, snapshot};
use midshift_core::Boxed;
use midshift_core::identity::Actor;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::time::Utc;
use midshift_proto::stop::v1::stop_service_server::StopServiceServer;
use std::fs::DirBuilder;
use std::net::IpAddr;
use std::os::unix::fs::DirBuilderExt;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};
use tokio::sync::{Semaphore, watch};
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// So often in a row something may come between the disk's turn and the end of a service that is followed.
const FOLLOW_TRIES: u32 = 100;

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct StopService {
    pub(crate) inner: Arc<Inner>,
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
            site_index: SiteIndex::of_site(site.as_deref()),
            key: opened.key,
            fan: Mutex::new(()),
            engaged_stops: Mutex::new(EngagedStops::begin(opened.saved, now.wall)),
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
        let engaged = lock(&inner.engaged_stops).latch().effective().count();
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
        lock(&self.inner.engaged_stops).latch().effective().count()
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
        let note = Note::by_actor(self.inner.clock.now().wall, Action::Denied, actor);
        let note = note.with("code", code).with("asked", path).with("network", network);
        let note = robot_id.iter().fold(note, |note, robot_id| note.with("robot_id", robot_id));
        self.inner.disk.denied(note, left_out);
    }

    /// Looks at what every stop and every check-in needs. One that hangs does not come back from here.
    pub fn look_at_locks(&self) {
        drop(lock(&self.inner.fan));
        drop(lock(&self.inner.engaged_stops));
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
                let version = lock(&inner.engaged_stops).version();
                if !inner.disk.turn(version).await {
                    return false;
                }
                let _fan = lock(&inner.fan);
                if inner.disk.holds(lock(&inner.engaged_stops).version()) {
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
            tokio::join!(writer::write_until_end(&inner, writer), moving, following);
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
