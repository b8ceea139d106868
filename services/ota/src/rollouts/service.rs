//! What callers have of roll-outs: it hands what they ask to the planner, and waits for the answer.

use super::reconcile::{Parts, Planner};
use super::requests::{PendingCommand, Question, Request};
use crate::service::OtaService;
use midshift_core::identity::Caller;
use midshift_core::ids::RolloutId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rollout::Board;
use midshift_core::rollout::projection::RolloutProjection;
use midshift_core::rollout::requests::{Ask, CheckOnly, Command, CommandOutcome};
use midshift_core::rollout::spec::PROBATION_DEFAULT_MS;
use midshift_core::rows::{Revision, Seq};
use midshift_core::time::Now;
use midshift_proto::ota::v1::rollout_service_server::RolloutServiceServer;
use midshift_store::Store;
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot, watch as channel};
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// Requests that may wait for the planner; one more is told to come back.
const REQUESTS_MAX: usize = 256;

/// The service. Cheap to clone: all clones talk to one planner.
#[derive(Clone)]
pub struct RolloutService {
    requests: mpsc::Sender<Request>,
    /// Where lists of roll-outs are read: most of them have ended.
    pub(super) store: Arc<dyn Store>,
    /// Position up to which the projection is committed; changes with it.
    pub(super) changed: channel::Receiver<Seq>,
    pub(super) shutdown: CancellationToken,
    pub(super) ota: OtaService,
    /// Probation of roll-outs that name none, milliseconds of site time.
    pub(super) probation_ms: u64,
}

impl RolloutService {
    /// The face and the part that runs behind it. Streams end at `shutdown`.
    pub fn new(parts: Parts, shutdown: CancellationToken) -> (Self, Planner) {
        let (sender, requests) = mpsc::channel(REQUESTS_MAX);
        let (changed, receiver) = channel::channel(Seq(0));
        let ota = parts.ota.clone();
        if parts.store.is_shared() {
            // Until this process leads another one may sign.
            parts.ota.lead(false);
        }
        let probation_ms = PROBATION_DEFAULT_MS;
        let store = parts.store.clone();
        let service = Self { requests: sender, store, changed: receiver, shutdown, ota, probation_ms };
        (service, Planner { parts, requests, changed })
    }
    /// Roll-outs that name no probation have this one instead of [`PROBATION_DEFAULT_MS`], milliseconds of site time.
    pub fn with_probation(self, probation_ms: u64) -> Self {
        Self { probation_ms, ..self }
    }
    /// With the gRPC face.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let face = RolloutServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes.add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
    }
    async fn send(&self, request: Request) -> Result<(), Refusal> {
        self.ota.opened()?;
        self.requests.try_send(request).map_err(|e| match e {
            mpsc::error::TrySendError::Full(_) => Refusal::new(Kind::Exhausted, Code::Overloaded),
            mpsc::error::TrySendError::Closed(_) => Refusal::new(Kind::Unavailable, Code::ShuttingDown),
        })
    }
    /// Runs `look` on the projection and gives its answer. Of roll-outs that have ended the projection has only what
    /// something names.
    ///
    /// # Errors
    /// If the planner does not run.
    pub async fn ask_projection<T: Send + 'static>(
        &self,
        look: impl FnOnce(&RolloutProjection, &Board, &Now) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        self.ask_about(Vec::new(), look).await
    }
    /// The same, of a projection that has these roll-outs, ended or not.
    ///
    /// # Errors
    /// If the planner does not run.
    pub async fn ask_about<T: Send + 'static>(
        &self,
        about: Vec<RolloutId>,
        look: impl FnOnce(&RolloutProjection, &Board, &Now) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        let (reply, answer) = oneshot::channel();
        let look = move |view: &RolloutProjection, board: &Board, now: &Now| drop(reply.send(look(view, board, now)));
        self.send(Request::Question(Question { about, answer: Box::new(look) })).await?;
        answer.await.map_err(|_| Refusal::new(Kind::Unavailable, Code::ShuttingDown))
    }
    /// Carries out a command and waits for its commit.
    pub(super) async fn act(&self, command: Command, by: &Caller, seen: Option<Revision>) -> Result<(), Refusal> {
        self.act_once(command, by, seen, CheckOnly::No, None).await.map(drop)
    }
    /// As [`Self::act`], of a caller who may send it again, or only wants to know whether it may be.
    pub(super) async fn act_once(
        &self,
        command: Command,
        by: &Caller,
        seen: Option<Revision>,
        check_only: CheckOnly,
        request_id: Option<String>,
    ) -> Result<CommandOutcome, Refusal> {
        let (reply, answer) = oneshot::channel();
        let ask = Ask { command, seen, check_only, request_id, by: by.clone() };
        self.send(Request::Do(Box::new(PendingCommand { ask, reply, lost: 0 }))).await?;
        answer.await.map_err(|_| Refusal::new(Kind::Unavailable, Code::CommitUnknown))?
    }
}
