//! The store on PostgreSQL 15 or newer: several processes on one database, each with one writer task, and wakes between them.
//!
//! Invariant: an acknowledged item survives any end of this process and of the server (`fsync`, `synchronous_commit`, read at
//! start); what is judged is what the database holds at that moment, never what a process remembers.
//! SQL stays within what other engines that speak PostgreSQL's protocol have too: no NOTIFY in a transaction, no advisory locks,
//! no triggers.

mod backup;
mod connect;
mod frames;
mod frames_writer;
mod heartbeats;
mod identity;
mod migrate;
mod read;
mod wake;
mod write_sql;
mod writer;

pub use backup::{CopiedSchema, PostgresCopy, PostgresRestore, RestoreError};
pub use connect::{PostgresConfig, Road, Wakes};
pub use frames::PostgresFrames;
pub use heartbeats::PostgresHeartbeats;

use crate::migrations::{CONTROL, Migrated, TELEMETRY};
use crate::queue::{PRUNE_SLICE, Queue, going, run, unavailable};
use crate::store::Wanted;
use crate::{
    Applied, CommitError, Error, FeedPage, GET_KEYS_MAX, OpenError, Query, Retention, Snapshot, Store, StoreId,
    Subjects,
};
use async_trait::async_trait;
use connect::{CONTROL_SCHEMA, Database, TELEMETRY_SCHEMA, patiently};
use midshift_core::Boxed;
use midshift_core::audit::Head;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Key, Log, Naming, Row, RowSelection, Seq, Writer as Author};
use midshift_core::time::Clock;
use sqlx::PgPool;
use std::collections::BTreeMap;
use std::sync::Arc;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use writer::Writer;

/// Brings both schemas of a database up to this binary's; creates what is not there.
///
/// # Errors
/// If the database cannot be reached or is newer than this binary.
pub fn migrate_postgres(config: &PostgresConfig) -> Boxed<'_, Result<Vec<Migrated>, OpenError>> {
    Box::pin(async move {
        let control = migrate::apply(&Database::new(config, CONTROL_SCHEMA)?, CONTROL, None).await?;
        let telemetry = migrate::apply(&Database::new(config, TELEMETRY_SCHEMA)?, TELEMETRY, None).await?;
        Ok(vec![control, telemetry])
    })
}

/// A [`Store`] in schema `control` of a PostgreSQL database.
pub struct PostgresStore {
    id: StoreId,
    site_id: SiteId,
    commands: Queue,
    readers: PgPool,
    wake: watch::Receiver<Seq>,
    /// Of the tasks that hear, tell and look.
    wakers: Vec<AbortHandle>,
}

impl PostgresStore {
    /// Opens the store of `site_id`, which is made if the database is empty, and starts its tasks on the current runtime.
    /// Other processes may have it open.
    ///
    /// # Errors
    /// If the database cannot be reached, belongs to another site, is newer than this binary, or cannot be durable.
    pub fn open(config: &PostgresConfig, site_id: SiteId, clock: Arc<dyn Clock>) -> Boxed<'_, Result<Self, OpenError>> {
        Box::pin(async move {
            let database = Database::new(config, CONTROL_SCHEMA)?;
            let mut connection = database.writer().await?;
            let migrated = migrate::apply(&database, CONTROL, Some((&site_id, clock.now().wall))).await?;
            if !migrated.applied.is_empty() {
                tracing::info!(schema = migrated.file, from = migrated.from, to = migrated.to, "schema migrated");
            }
            let id = identity::identify(&mut connection, &site_id, clock.now().wall).await?;
            let head = read::head(&mut connection, &site_id)
                .await
                .map_err(|source| OpenError::Sql { doing: "reading the head", source })?;
            let readers = database.readers();
            let (wake_sender, wake) = watch::channel(head);
            let (committed_sender, committed) = watch::channel(head);
            let (commands, queue) = Queue::new();
            let known = (site_id.clone(), id.clone());
            let wakes = (wake_sender.clone(), committed_sender);
            tokio::spawn(run(Writer::new(database.clone(), connection, known, clock, wakes), queue));
            let sweep = wake::sweep(readers.clone(), site_id.clone(), wake_sender.clone());
            let mut wakers = vec![tokio::spawn(sweep).abort_handle()];
            if config.wakes == Wakes::Notified {
                let listen = wake::listen(database.clone(), site_id.clone(), wake_sender);
                wakers.push(tokio::spawn(listen).abort_handle());
                wakers.push(tokio::spawn(wake::notify(database, site_id.clone(), committed)).abort_handle());
            }
            Ok(Self { id, site_id, commands, readers, wake, wakers })
        })
    }

    /// Finishes what is queued and closes the connections. Everything asked afterwards is refused.
    pub fn close(&self) -> Boxed<'_, ()> {
        Box::pin(async move {
            self.commands.close().await;
            self.wakers.iter().for_each(AbortHandle::abort);
            self.readers.close().await;
        })
    }

    async fn page(&self, wanted: &Wanted, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        patiently(read::feed(&self.readers, &self.site_id, wanted, after, limit)).await
    }
}

impl Drop for PostgresStore {
    fn drop(&mut self) {
        self.wakers.iter().for_each(AbortHandle::abort);
    }
}

#[async_trait]
impl Store for PostgresStore {
    fn id(&self) -> &StoreId {
        &self.id
    }

    fn site_id(&self) -> &SiteId {
        &self.site_id
    }

    fn is_shared(&self) -> bool {
        true
    }

    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        self.commands.commit(items).await
    }

    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        if keys.len() > GET_KEYS_MAX {
            return Err(Error::TooManyKeys { asked: keys.len() });
        }
        patiently(async { read::get(&self.readers, &self.site_id, &keys).await.map_err(unavailable) }).await
    }

    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        patiently(async { read::list(&self.readers, &self.site_id, &query).await.map_err(unavailable) }).await
    }

    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        patiently(async { read::read(&self.readers, &self.site_id, parts, named).await.map_err(unavailable) }).await
    }

    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.page(&Wanted::from_logs(logs), after, limit).await
    }

    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.page(&Wanted::from_subjects(subjects)?, after, limit).await
    }

    fn wake(&self) -> watch::Receiver<Seq> {
        self.wake.clone()
    }

    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        self.commands.raise_head(at_least).await
    }

    async fn audit_heads(&self) -> Result<BTreeMap<Author, Head>, Error> {
        patiently(async { read::audit_heads(&self.readers, &self.site_id).await.map_err(unavailable) }).await
    }

    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        let mut gone = 0;
        for log in Log::ALL {
            let count = patiently(async { read::count(&self.readers, &self.site_id, log).await.map_err(unavailable) });
            let mut surplus = count.await?.saturating_sub(keep.entries_max);
            loop {
                let oldest = read::oldest(&self.readers, &self.site_id, log, PRUNE_SLICE);
                let slice = patiently(async { oldest.await.map_err(unavailable) }).await?;
                let Some((count, up_to)) = going(&slice, surplus, &keep) else { break };
                self.commands.prune(log, up_to).await?;
                gone += count;
                surplus = surplus.saturating_sub(count);
            }
        }
        Ok(gone)
    }
}
