//! The store on SQLite: one writer task, group commit without a timer, readers beside it.
//!
//! Invariant: an acknowledged item survives `kill -9` and power loss (WAL, `synchronous = FULL`, both read back at start); the
//! writer task is the only writer of the file, which is why it may judge items by what it remembers.
//! SQL stays within what PostgreSQL also has: numbered binds, `ON CONFLICT … DO UPDATE`, BIGINT and TEXT.

mod batch;
mod copy;
mod file;
mod frames;
mod frames_writer;
mod read;
mod revisions;
mod schema;
mod tail;
mod write_sql;
mod writer;

pub use copy::{Database, Described, SqliteRestored, renew_identity};
pub use frames::SqliteFrames;

use crate::migrations::{CONTROL, Migrated, TELEMETRY};
use crate::queue::{PRUNE_SLICE, Queue, going, run, unavailable};
use crate::store::Wanted;
use crate::{
    Applied, CommitError, Error, FeedPage, GET_KEYS_MAX, OpenError, Query, Retention, Snapshot, Store, StoreId,
    Subjects,
};
use async_trait::async_trait;
use file::{CONTROL_DB, DataFile, TELEMETRY_DB};
use midshift_core::Boxed;
use midshift_core::audit::Head;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Key, Log, Naming, Row, RowSelection, Seq, Writer as Author};
use midshift_core::time::Clock;
use sqlx::SqlitePool;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use tail::Tail;
use tokio::sync::{oneshot, watch};
use writer::Writer;

/// Brings both files of a data directory up to this binary's schema; creates what is not there.
///
/// # Errors
/// If the directory is in use or a file is newer than this binary.
pub fn migrate(dir: &Path) -> Boxed<'_, Result<Vec<Migrated>, OpenError>> {
    Box::pin(async move {
        let (_control, control) = DataFile::open(dir, CONTROL_DB, CONTROL).await?;
        let (_telemetry, telemetry) = DataFile::open(dir, TELEMETRY_DB, TELEMETRY).await?;
        Ok(vec![control, telemetry])
    })
}

/// A [`Store`] in `control.db` of a data directory.
pub struct SqliteStore {
    id: StoreId,
    site_id: SiteId,
    commands: Queue,
    readers: SqlitePool,
    tail: Arc<Tail>,
    wake: watch::Receiver<Seq>,
}

impl SqliteStore {
    /// Opens the store of `site_id` in `dir`, which is created if need be, and starts its writer on the current runtime.
    ///
    /// # Errors
    /// If another server has the directory, it belongs to another site, is newer than this binary, or cannot be durable.
    pub fn open(dir: &Path, site_id: SiteId, clock: Arc<dyn Clock>) -> Boxed<'_, Result<Self, OpenError>> {
        Box::pin(async move {
            let (file, migrated) = DataFile::open(dir, CONTROL_DB, CONTROL).await?;
            if !migrated.applied.is_empty() {
                tracing::info!(file = migrated.file, from = migrated.from, to = migrated.to, "schema migrated");
            }
            let mut connection = file.writer().await?;
            let id = writer::identify(&mut connection, &site_id, clock.now().wall).await?;
            let head = writer::head(&mut connection, &site_id)
                .await
                .map_err(|source| OpenError::Sql { doing: "reading the head", source })?;
            let committing = batch::tell_commits(&mut connection)
                .await
                .map_err(|source| OpenError::Sql { doing: "listening for commits", source })?;
            let readers = file.readers().await?;
            let tail = Arc::new(Tail::new(head));
            let (wake_sender, wake) = watch::channel(head);
            let (ended_sender, ended) = oneshot::channel();
            let (commands, queue) = Queue::new();
            let connection = (connection, committing);
            let writer = Writer::new(file.clone(), connection, site_id.clone(), clock, tail.clone(), wake_sender, head);
            tokio::spawn(async move {
                run(writer, queue).await;
                drop(ended_sender);
            });
            tokio::spawn(file.checkpoint(ended));
            Ok(Self { id, site_id, commands, readers, tail, wake })
        })
    }

    /// Finishes what is queued and closes the file. Everything asked afterwards is refused.
    pub fn close(&self) -> Boxed<'_, ()> {
        Box::pin(async move {
            self.commands.close().await;
            self.readers.close().await;
        })
    }

    async fn page(&self, wanted: &Wanted, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        if let Some(page) = self.tail.page(after, limit, |entry| wanted.holds(entry)) {
            return Ok(page);
        }
        read::feed(&self.readers, &self.site_id, wanted, after, limit).await
    }
}

#[async_trait]
impl Store for SqliteStore {
    fn id(&self) -> &StoreId {
        &self.id
    }

    fn site_id(&self) -> &SiteId {
        &self.site_id
    }

    fn is_shared(&self) -> bool {
        false
    }

    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        self.commands.commit(items).await
    }

    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        if keys.len() > GET_KEYS_MAX {
            return Err(Error::TooManyKeys { asked: keys.len() });
        }
        read::get(&self.readers, &self.site_id, &keys).await.map_err(unavailable)
    }

    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        read::list(&self.readers, &self.site_id, &query).await.map_err(unavailable)
    }

    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        read::read(&self.readers, &self.site_id, parts, named).await.map_err(unavailable)
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
        read::audit_heads(&self.readers, &self.site_id).await.map_err(unavailable)
    }

    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        let mut gone = 0;
        for log in Log::ALL {
            let count = read::count(&self.readers, &self.site_id, log).await.map_err(unavailable)?;
            let mut surplus = count.saturating_sub(keep.entries_max);
            loop {
                let slice = read::oldest(&self.readers, &self.site_id, log, PRUNE_SLICE).await.map_err(unavailable)?;
                let Some((count, up_to)) = going(&slice, surplus, &keep) else { break };
                self.commands.prune(log, up_to).await?;
                gone += count;
                surplus = surplus.saturating_sub(count);
            }
        }
        Ok(gone)
    }
}
