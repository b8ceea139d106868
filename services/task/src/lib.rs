//! Task intake as a service: admits, shows, changes, holds, cancels, resolves and watches tasks. It decides nothing about robots.
//!
//! Called by the server. Invariant: an answer leaves only after its commit; a task is stored whole or not at all; what happens to an
//! admitted task is fleet's.

mod admit;
mod authorization;
mod batch;
mod commands;
mod filtered_commands;
mod grpc;
mod known_types;
mod list;
mod prune;
mod resume;
mod rows;
mod search;
mod task_changes;
mod types;
mod watch;
mod watch_state;

use known_types::KnownTypes;
use midshift_core::Boxed;
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::reason::Refusal;
use midshift_core::rows::Table;
use midshift_core::site::Site;
use midshift_core::task::TaskIntake;
use midshift_core::task::bugs::Bugs;
use midshift_core::time::Clock;
use midshift_proto::task::v1::task_service_server::TaskServiceServer;
use midshift_store::{Applied, CommitError, Error, Query, Store};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// What the service is built from.
pub struct Parts {
    /// The memory that services share.
    pub store: Arc<dyn Store>,
    /// The site, whose waypoints tasks may name.
    pub site: Arc<Site>,
    /// Where the time of the wall, the link and the site is read.
    pub clock: Arc<dyn Clock>,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
}

struct Inner {
    parts: Parts,
    /// The last admission number that was given.
    number: AtomicU64,
    /// Drawn at the start, so that two processes do not draw the same ids.
    salt: u64,
    /// The task types of the site as they were read last.
    types: Mutex<Option<KnownTypes>>,
    shutdown: CancellationToken,
}

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct TaskService {
    inner: Arc<Inner>,
}

impl TaskService {
    /// Reads the highest admission number and is ready. Streams end at `shutdown`.
    ///
    /// # Errors
    /// If the store cannot be read.
    pub fn open(parts: Parts, shutdown: CancellationToken) -> Boxed<'static, Result<Self, Error>> {
        Box::pin(async move {
            let query = Query { newest_first: true, limit: 1, ..Query::all(Table::TaskIntake) };
            let newest = parts.store.list(query).await?.pop();
            let number = match newest {
                Some(row) => row.decode::<TaskIntake>()?.number,
                None => 0,
            };
            let number = AtomicU64::new(number);
            Ok(Self {
                inner: Arc::new(Inner { parts, number, salt: rand::random(), types: Mutex::default(), shutdown }),
            })
        })
    }
    /// With the gRPC face.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let face = TaskServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes.add_service(face.max_decoding_message_size(limits::TASK_MESSAGE_BYTES))
    }
    fn store(&self) -> &dyn Store {
        self.inner.parts.store.as_ref()
    }
    /// Commits items and notes how long it took; one result an item.
    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        let begun = Instant::now();
        let results = self.store().commit(items).await;
        metrics::histogram!("midshift_task_commit_seconds").record(begun.elapsed().as_secs_f64());
        results
    }
    /// The next admission number: above the last one of this process, and above the newest entry it has heard of. An admission writes more entries than
    /// it takes numbers, so that of two processes none falls behind what the other has admitted.
    fn next_number(&self) -> u64 {
        let head = self.store().wake().borrow().0;
        let next = |last: u64| last.max(head) + 1;
        self.inner.number.fetch_update(Relaxed, Relaxed, |last| Some(next(last))).map_or(head + 1, next)
    }
}

/// Counts a refusal of a call or of one item of a batch.
fn count(refusal: &Refusal) {
    metrics::counter!("midshift_task_refused_total", "code" => refusal.reason.code.as_str()).increment(1);
}
