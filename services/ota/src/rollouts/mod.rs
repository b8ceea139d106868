//! Roll-outs as a service: reads the feed and the heartbeats, lets `core::rollout` decide, signs, commits, answers
//! questions.
//!
//! Called by the binary: [`RolloutService::new`], its gRPC face, and [`Planner::run`]. Invariant: nothing is decided
//! here; a lost wake costs one sweep; what is signed was decided by the planner and is committed with the row that
//! explains it.

mod decode;
mod directives;
mod encode;
mod ended;
mod grpc;
mod list;
mod reconcile;
mod releases;
mod standby;
mod watch;

pub use directives::Signer;
pub use releases::known_bundles;

use crate::OtaService;
use midshift_core::Boxed;
use midshift_core::identity::Caller;
use midshift_core::ids::RolloutId;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rollout::Board;
use midshift_core::rollout::bugs::Bugs;
use midshift_core::rollout::projection::View;
use midshift_core::rollout::requests::{Ask, CheckOnly, Command, Taken};
use midshift_core::rollout::spec::PROBATION_DEFAULT_MS;
use midshift_core::rows::{Revision, Seq};
use midshift_core::site::Site;
use midshift_core::time::{Clock, Now};
use midshift_core::work::Live;
use midshift_proto::ota::v1::rollout_service_server::RolloutServiceServer;
use midshift_store::{LiveBoard, Store};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot, watch as channel};
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// Requests that may wait for the planner; one more is told to come back.
const REQUESTS_MAX: usize = 256;

/// What the service is built from.
pub struct Parts {
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// Newest heartbeats, written by telemetry.
    pub board: Arc<LiveBoard<Live>>,
    /// The site.
    pub site: Arc<Site>,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// Releases and keys.
    pub ota: OtaService,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
}

/// What is made of the picture for whoever asked.
type Answer = Box<dyn FnOnce(&View, &Board, &Now) + Send>;

/// A question about the picture as it is now.
struct Question {
    /// Roll-outs that it is about: they are in the picture when it is answered, if they are there.
    about: Vec<RolloutId>,
    answer: Answer,
}

/// Something a person asks of the planner.
enum Request {
    /// Change something; answered after the commit.
    Do(Box<Asked>),
    /// Read something.
    Question(Question),
}

/// A command, until it is answered.
struct Asked {
    ask: Ask,
    reply: oneshot::Sender<Result<Taken, Refusal>>,
    /// How often it was decided and lost, because what it is about had been changed meanwhile.
    lost: u32,
}

/// The service. Cheap to clone: all clones talk to one planner.
#[derive(Clone)]
pub struct RolloutService {
    requests: mpsc::Sender<Request>,
    /// Where lists of roll-outs are read: most of them have ended.
    store: Arc<dyn Store>,
    /// Position up to which the picture is committed; changes with it.
    changed: channel::Receiver<Seq>,
    shutdown: CancellationToken,
    ota: OtaService,
    /// Probation of roll-outs that name none, milliseconds of site time.
    probation_ms: u64,
}

/// The part that runs.
pub struct Planner {
    parts: Parts,
    requests: mpsc::Receiver<Request>,
    changed: channel::Sender<Seq>,
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
    /// Runs `look` on the picture and gives its answer. Of roll-outs that have ended the picture has only what
    /// something names.
    ///
    /// # Errors
    /// If the planner does not run.
    pub async fn ask_projection<T: Send + 'static>(
        &self,
        look: impl FnOnce(&View, &Board, &Now) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        self.ask_about(Vec::new(), look).await
    }
    /// The same, of a picture that has these roll-outs, ended or not.
    ///
    /// # Errors
    /// If the planner does not run.
    pub async fn ask_about<T: Send + 'static>(
        &self,
        about: Vec<RolloutId>,
        look: impl FnOnce(&View, &Board, &Now) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        let (reply, answer) = oneshot::channel();
        let look = move |view: &View, board: &Board, now: &Now| drop(reply.send(look(view, board, now)));
        self.send(Request::Question(Question { about, answer: Box::new(look) })).await?;
        answer.await.map_err(|_| Refusal::new(Kind::Unavailable, Code::ShuttingDown))
    }
    /// Carries out a command and waits for its commit.
    async fn act(&self, command: Command, by: &Caller, seen: Option<Revision>) -> Result<(), Refusal> {
        self.act_once(command, by, seen, CheckOnly::No, None).await.map(drop)
    }
    /// As [`Self::act`], of a caller who may send it again, or only wants to know whether it may be.
    async fn act_once(
        &self,
        command: Command,
        by: &Caller,
        seen: Option<Revision>,
        check_only: CheckOnly,
        request_id: Option<String>,
    ) -> Result<Taken, Refusal> {
        let (reply, answer) = oneshot::channel();
        let ask = Ask { command, seen, check_only, request_id, by: by.clone() };
        self.send(Request::Do(Box::new(Asked { ask, reply, lost: 0 }))).await?;
        answer.await.map_err(|_| Refusal::new(Kind::Unavailable, Code::CommitUnknown))?
    }
}

impl Planner {
    /// Runs until `shutdown`. On a server without keys it only waits: nothing can be signed.
    ///
    /// # Errors
    /// Never by itself; the caller's services end alike.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, Result<(), midshift_store::Error>> {
        Box::pin(reconcile::run(self, shutdown))
    }
}
