//! The audit of all services: looked through, exported whole, and verified.
//!
//! Invariant: reads only, but for one row before each export. What else is written is written by each service in the item of its decision, and by
//! [`upkeep`] for what nobody decides: rows that quote the other chains, and rows that say that old ones went.

mod export;
mod grpc;
mod pages;
pub mod upkeep;
mod verify;

use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Row, Table};
use midshift_core::time::Clock;
use midshift_proto::identity::v1::audit_service_server::AuditServiceServer;
use midshift_store::{Cursor, Error, Query, Store};
use std::sync::Arc;
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tonic::codec::CompressionEncoding;
use tonic::service::Routes;

/// Exports and verifications at a time: each reads everything there is.
const READERS_MAX: usize = 4;

/// The service. Cheap to clone.
#[derive(Clone)]
pub struct AuditService {
    store: Arc<dyn Store>,
    clock: Arc<dyn Clock>,
    readers: Arc<Semaphore>,
    shutdown: CancellationToken,
}

impl AuditService {
    /// Of this store. Streams end at `shutdown`.
    pub fn new(store: Arc<dyn Store>, clock: Arc<dyn Clock>, shutdown: CancellationToken) -> Self {
        Self { store, clock, readers: Arc::new(Semaphore::new(READERS_MAX)), shutdown }
    }
    /// With the gRPC face.
    pub fn add_to(&self, routes: Routes) -> Routes {
        let face = AuditServiceServer::new(self.clone()).accept_compressed(CompressionEncoding::Gzip);
        routes.add_service(face.max_decoding_message_size(limits::CONTROL_MESSAGE_BYTES))
    }
}

fn unavailable(error: Error) -> Refusal {
    tracing::warn!(%error, "the audit cannot be read");
    Refusal::new(Kind::Unavailable, Code::StoreUnavailable)
}

/// The next rows of a chain behind a place in it, oldest first.
async fn page(store: &dyn Store, table: Table, after: Option<Cursor>) -> Result<Vec<Row>, Refusal> {
    store.list(Query { after, ..Query::all(table) }).await.map_err(unavailable)
}

#[cfg(test)]
mod tests;
