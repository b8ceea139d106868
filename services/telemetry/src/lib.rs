//! Telemetry ingest as a service: holds the robots' links, keeps their events, serves their live state.
//!
//! Called by the server: [`TelemetryService::new`], its gRPC faces, and [`TelemetryService::run`]. Invariant: an acknowledgement leaves only
//! after the commit that holds the data; a session and its way down never wait for the store; every stream is drained into bounded queues.

mod beacons;
mod bugs;
mod clones;
mod enrolment;
mod event_rate;
mod events;
mod facts;
mod grpc;
mod hellos;
mod inner;
mod link;
mod misreads;
mod offset;
pub mod precision;
mod presence;
mod projection;
mod projection_feed;
mod registry;
mod replay;
mod retention;
mod session;
mod session_status;
mod shared_heartbeats;
mod status;
mod status_writer;
mod stops;
mod waits;
mod welcome;

pub use bugs::Bugs;
#[cfg(feature = "seeded-bugs")]
pub use bugs::SeededBug;
pub use inner::Parts;
pub use retention::prune;

use inner::Inner;
use midshift_core::{Boxed, limits};
use midshift_proto::link::v1::link_service_server::LinkServiceServer;
use midshift_proto::link::v1::replay_service_server::ReplayServiceServer;
use midshift_proto::telemetry::v1::telemetry_service_server::TelemetryServiceServer;
use midshift_store::Error;
use projection::LinkProjection;
use registry::Registry;
use status_writer::StatusWriter;
use std::sync::Arc;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct TelemetryService {
    inner: Arc<Inner>,
}

impl TelemetryService {
    /// A service that ends its sessions at `shutdown`. Sessions wait until [`TelemetryService::run`] has read the store once.
    pub fn new(parts: Parts, shutdown: CancellationToken) -> Self {
        let (projection, registry, beacons) =
            (LinkProjection::default(), Registry::default(), beacons::BeaconListener::default());
        let shared = parts.heard.clone().map(shared_heartbeats::Shared::new);
        let hellos = hellos::Hellos::default();
        let (event_rates, moving) = (event_rate::EventRates::default(), CancellationToken::new());
        let misreads = misreads::Misreads::default();
        let status_writer = StatusWriter::default();
        let inner = Inner {
            parts,
            projection,
            registry,
            event_rates,
            misreads,
            beacons,
            shared,
            status_writer,
            hellos,
            moving,
            shutdown,
        };
        Self { inner: Arc::new(inner) }
    }
    /// With the faces of robots, that of their sessions and the one beside them for old STATUS, and with that of people and programs.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let link = LinkServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        let replay = ReplayServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        let face = TelemetryServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes
            .add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
            .add_service(link.max_decoding_message_size(limits::TELEMETRY_BATCH_BYTES))
            .add_service(replay.max_decoding_message_size(limits::TELEMETRY_BATCH_BYTES))
    }
    /// Whether the database that several processes share has not been reached for long, so that no session is held here; it may come back.
    /// None: this process needs nobody else.
    pub fn cut_off(&self) -> Option<watch::Receiver<bool>> {
        self.inner.shared.as_ref().map(shared_heartbeats::Shared::cut_off)
    }
    /// Sessions in charge here.
    pub fn sessions(&self) -> usize {
        self.inner.registry.in_charge()
    }
    /// Takes no new sessions and asks every robot to open its next one elsewhere; returns when none is left.
    pub fn move_over(&self) -> Boxed<'_, ()> {
        Box::pin(async {
            self.inner.moving.cancel();
            self.inner.registry.empty().await;
        })
    }
    /// Listens for the beacons of launchers on `socket` until shutdown: hints for people, which nobody proves and nothing is decided by.
    pub fn hear_beacons(self, socket: tokio::net::UdpSocket) -> Boxed<'static, ()> {
        let inner = self.inner;
        Box::pin(async move {
            tokio::select! {
                () = inner.shutdown.cancelled() => {}
                () = beacons::listen(&inner.beacons, &inner.projection, inner.parts.clock.as_ref(), &socket) => {}
            }
        })
    }
    /// Keeps the projection of rows, the presence of robots and what they bring of STATUS until shutdown.
    pub fn run(self) -> Boxed<'static, Result<(), Error>> {
        let inner = self.inner;
        Box::pin(async move {
            let frames = inner.parts.frames.as_ref();
            let result = tokio::select! {
                () = inner.shutdown.cancelled() => Ok(()),
                () = inner.status_writer.write_groups(frames) => Ok(()),
                result = projection_feed::follow_rows(&inner) => result,
                () = presence::write_presence(&inner) => Ok(()),
                () = shared_heartbeats::keep_heartbeats(inner.shared.as_ref(), &inner.parts.board, &inner.projection) => Ok(()),
            };
            inner.status_writer.finish(frames).await;
            result
        })
    }
}
