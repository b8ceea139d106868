//! Fleet scheduling as a service: reads the feed and the heartbeats, lets `core::fleet` decide, commits, answers questions.
//!
//! Called by the server: [`FleetService::new`], its gRPC face, and [`Reconciler::run`]. Invariant: nothing is decided here; a lost wake
//! costs one sweep; no promise is kept in memory.

mod arguments;
mod commit;
mod encode;
mod figures;
mod grpc;
mod reconcile;
mod requests;
mod retention;
mod standby;

pub use requests::{MapOutdated, Parts};
pub use retention::prune;

use midshift_core::Boxed;
use midshift_core::fleet::Board;
use midshift_core::fleet::commands::Command;
use midshift_core::fleet::projection::FleetProjection;
use midshift_core::identity::Caller;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::Revision;
use midshift_core::site::Site;
use midshift_core::time::Now;
use midshift_proto::fleet::v1::fleet_service_server::FleetServiceServer;
use midshift_store::Store;
use requests::{PendingCommand, Request};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// Requests that may wait for the reconciler; one more is told to come back.
const REQUESTS_MAX: usize = 256;

/// The service. Cheap to clone: all clones talk to one reconciler.
#[derive(Clone)]
pub struct FleetService {
    requests: mpsc::Sender<Request>,
    store: Arc<dyn Store>,
    site: Arc<Site>,
}

/// The part that runs.
pub struct Reconciler {
    parts: Parts,
    requests: mpsc::Receiver<Request>,
}

impl FleetService {
    /// The face and the part that runs behind it.
    pub fn new(parts: Parts) -> (Self, Reconciler) {
        let (sender, requests) = mpsc::channel(REQUESTS_MAX);
        let (store, site) = (parts.store.clone(), parts.site.clone());
        (Self { requests: sender, store, site }, Reconciler { parts, requests })
    }
    /// With the gRPC face.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let face = FleetServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes.add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
    }

    /// How often a robot began to wait for a place since the start.
    ///
    /// # Errors
    /// If the reconciler does not run.
    pub async fn place_waits(&self) -> Result<u64, Refusal> {
        self.query_projection(|view, _, _| view.place_waits).await
    }

    async fn send(&self, request: Request) -> Result<(), Refusal> {
        self.requests.try_send(request).map_err(|e| match e {
            mpsc::error::TrySendError::Full(_) => Refusal::new(Kind::Exhausted, Code::Overloaded),
            mpsc::error::TrySendError::Closed(_) => Refusal::new(Kind::Unavailable, Code::ShuttingDown),
        })
    }
    /// Runs `look` on the projection and gives its answer.
    pub async fn query_projection<T: Send + 'static>(
        &self,
        look: impl FnOnce(&FleetProjection, &Board, &Now) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        let (reply, answer) = oneshot::channel();
        let look = move |view: &FleetProjection, board: &Board, now: &Now| drop(reply.send(look(view, board, now)));
        self.send(Request::Look(Box::new(look))).await?;
        answer.await.map_err(|_| Refusal::new(Kind::Unavailable, Code::ShuttingDown))
    }
    /// Carries out a command and waits for its commit.
    async fn act(
        &self,
        command: Command,
        by: &Caller,
        seen: Option<Revision>,
        validate_only: bool,
        request_id: Option<String>,
    ) -> Result<(), Refusal> {
        let (reply, answer) = oneshot::channel();
        let asked = PendingCommand { command, seen, validate_only, by: by.clone(), request_id, reply, lost: 0 };
        self.send(Request::Do(Box::new(asked))).await?;
        answer.await.map_err(|_| Refusal::new(Kind::Unavailable, Code::CommitUnknown))?
    }
}

impl Reconciler {
    /// Runs until `shutdown`.
    ///
    /// # Errors
    /// It ends early because its map is outdated.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, Result<(), MapOutdated>> {
        Box::pin(reconcile::run(self.parts, self.requests, shutdown))
    }
}
