//! The store on SQLite: one writer task, group commit without a timer, readers beside it.
//!
//! Invariant: an acknowledged item survives `kill -9` and power loss (WAL, `synchronous = FULL`, both read back at start); the
//! writer task is the only writer of the file, which is why it may judge items by what it remembers.
//! SQL stays within what PostgreSQL also has: numbered binds, `ON CONFLICT … DO UPDATE`, BIGINT and TEXT.

mod copy;
mod file;
mod frames;
mod frames_pack;
mod frames_writer;
mod group;
mod read;
mod revisions;
mod schema;
mod tail;
mod write_sql;
mod writer;

pub use copy::{Database, Described, renew_identity};
pub use frames::SqliteFrames;
pub use schema::Migrated;

use crate::check::item_bytes;
use crate::{
    Applied, Cause, CommitError, Error, FeedPage, GET_KEYS_MAX, Query, Retention, SEQ_PLAUSIBLE_MAX, Snapshot, Store,
    StoreId,
};
use async_trait::async_trait;
use file::DataFile;
use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::rows::{Entry, Item, Key, Log, Row, Seq, Table};
use midshift_core::time::Clock;
use sqlx::SqlitePool;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tail::Tail;
use tokio::sync::{mpsc, oneshot, watch};
use writer::{Command, Commit, Writer};

/// Why a data directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The directory or the lock file.
    #[error("{doing} failed")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// Another server has it.
    #[error("data directory {} is in use by another server; stop it first, or choose another directory", dir.display())]
    Locked {
        /// The directory.
        dir: PathBuf,
    },
    /// SQLite failed.
    #[error("{doing} failed")]
    Sql {
        /// What was being done.
        doing: &'static str,
        /// Why.
        #[source]
        source: sqlx::Error,
    },
    /// A commit on this file would not be durable.
    #[error("{name} is {found}, must be {expected}: commits would not be durable on this file system")]
    NotDurable {
        /// The pragma.
        name: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// Written by a newer release.
    #[error("{file} has schema {found}, this release knows {known}: use the newer release")]
    NewerSchema {
        /// The file.
        file: &'static str,
        /// Its schema version.
        found: u32,
        /// The newest known here.
        known: u32,
    },
    /// The directory belongs to another site.
    #[error("data directory holds site {found}, not {asked}")]
    OtherSite {
        /// Whose it is.
        found: String,
        /// Who asked.
        asked: SiteId,
    },
}

/// Commands that may wait for the writer. Each holds at most one group's worth of items.
const QUEUE_COMMANDS: usize = 256;
/// Entries one slice of pruning looks at.
const PRUNE_SLICE: usize = 1_000;
const CONTROL_DB: &str = "control.db";
const TELEMETRY_DB: &str = "telemetry.db";

/// Brings both files of a data directory up to this binary's schema; creates what is not there.
///
/// # Errors
/// If the directory is in use or a file is newer than this binary.
pub async fn migrate(dir: &Path) -> Result<Vec<Migrated>, OpenError> {
    let (_control, control) = DataFile::open(dir, CONTROL_DB, schema::CONTROL).await?;
    let (_telemetry, telemetry) = DataFile::open(dir, TELEMETRY_DB, schema::TELEMETRY).await?;
    Ok(vec![control, telemetry])
}

/// A [`Store`] in `control.db` of a data directory.
pub struct SqliteStore {
    id: StoreId,
    site_id: SiteId,
    commands: mpsc::Sender<Command>,
    readers: SqlitePool,
    tail: Arc<Tail>,
    wake: watch::Receiver<Seq>,
}

impl SqliteStore {
    /// Opens the store of `site_id` in `dir`, which is created if need be, and starts its writer on the current runtime.
    ///
    /// # Errors
    /// If another server has the directory, it belongs to another site, is newer than this binary, or cannot be durable.
    pub async fn open(dir: &Path, site_id: SiteId, clock: Arc<dyn Clock>) -> Result<Self, OpenError> {
        let (file, migrated) = DataFile::open(dir, CONTROL_DB, schema::CONTROL).await?;
        if !migrated.applied.is_empty() {
            tracing::info!(file = migrated.file, from = migrated.from, to = migrated.to, "schema migrated");
        }
        let mut connection = file.writer().await?;
        let id = writer::identify(&mut connection, &site_id, clock.now().wall).await?;
        let head = writer::head(&mut connection, &site_id)
            .await
            .map_err(|source| OpenError::Sql { doing: "reading the head", source })?;
        let readers = file.readers().await?;
        let tail = Arc::new(Tail::new(head));
        let (wake_sender, wake) = watch::channel(head);
        let (ended_sender, ended) = oneshot::channel();
        let (commands, queue) = mpsc::channel(QUEUE_COMMANDS);
        let writer = Writer::new(file.clone(), connection, site_id.clone(), clock, tail.clone(), wake_sender, head);
        tokio::spawn(async move {
            writer.run(queue).await;
            drop(ended_sender);
        });
        tokio::spawn(file.checkpoint(ended));
        Ok(Self { id, site_id, commands, readers, tail, wake })
    }

    /// Finishes what is queued and closes the file. Everything asked afterwards is refused.
    pub async fn close(&self) {
        let (reply, closed) = oneshot::channel();
        if self.commands.send(Command::Close { reply }).await.is_ok() {
            // An error means that the writer has ended by itself, which is what was asked for.
            let _ = closed.await;
        }
        self.readers.close().await;
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<Result<T, Error>>) -> Command) -> Result<T, Error> {
        let (reply, answer) = oneshot::channel();
        self.commands.send(command(reply)).await.map_err(|_| Error::Unavailable(closed()))?;
        answer.await.map_err(|_| Error::Unavailable(closed()))?
    }

    async fn page(
        &self,
        logs: &BTreeSet<Log>,
        subjects: Option<&BTreeSet<Arc<str>>>,
        after: Seq,
        limit: usize,
    ) -> Result<FeedPage, Error> {
        let keep = |e: &Entry| logs.contains(&e.log) && subjects.is_none_or(|of| of.contains(&e.subject));
        if let Some(page) = self.tail.page(after, limit, keep) {
            return Ok(page);
        }
        read::feed(&self.readers, &self.site_id, logs, subjects, after, limit).await
    }
}

/// Commands of a caller, in order: each a part of a group at most, and the next is sent when the one before is answered.
fn slices(items: Vec<Item>) -> Vec<(Vec<Item>, usize)> {
    let mut slices: Vec<(Vec<Item>, usize)> = Vec::new();
    for item in items {
        let bytes = item_bytes(&item);
        match slices.last_mut() {
            Some((slice, sum))
                if slice.len() < limits::COMMIT_SLICE_ITEMS && *sum + bytes <= limits::COMMIT_SLICE_BYTES =>
            {
                slice.push(item);
                *sum += bytes;
            }
            _ => slices.push((vec![item], bytes)),
        }
    }
    slices
}

pub(super) fn closed() -> Cause {
    Arc::new(std::io::Error::new(std::io::ErrorKind::NotConnected, "the store is closed"))
}

pub(super) fn unavailable(source: sqlx::Error) -> Error {
    Error::Unavailable(Arc::new(source))
}

#[async_trait]
impl Store for SqliteStore {
    fn id(&self) -> &StoreId {
        &self.id
    }

    fn site_id(&self) -> &SiteId {
        &self.site_id
    }

    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        let mut results = Vec::with_capacity(items.len());
        for (items, bytes) in slices(items) {
            let (reply, answer) = oneshot::channel();
            let count = items.len();
            // A refused send drops the reply, which is heard below.
            let sent = self.commands.send(Command::Commit(Commit { items, bytes, reply })).await.is_ok();
            match answer.await {
                Ok(answers) => results.extend(answers),
                Err(_) if sent => results.extend((0..count).map(|_| Err(CommitError::Unknown(closed())))),
                Err(_) => results.extend((0..count).map(|_| Err(CommitError::Unavailable(closed())))),
            }
        }
        results
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

    async fn snapshot(&self, tables: &[Table]) -> Result<Snapshot, Error> {
        let tables: BTreeSet<Table> = tables.iter().copied().collect();
        read::snapshot(&self.readers, &self.site_id, &tables).await.map_err(unavailable)
    }

    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.page(&logs.iter().copied().collect(), None, after, limit).await
    }

    async fn feed_of(&self, log: Log, subjects: &[Arc<str>], after: Seq, limit: usize) -> Result<FeedPage, Error> {
        if subjects.len() > GET_KEYS_MAX {
            return Err(Error::TooManyKeys { asked: subjects.len() });
        }
        let subjects: BTreeSet<Arc<str>> = subjects.iter().cloned().collect();
        self.page(&BTreeSet::from([log]), Some(&subjects), after, limit).await
    }

    fn wake(&self) -> watch::Receiver<Seq> {
        self.wake.clone()
    }

    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        if at_least > SEQ_PLAUSIBLE_MAX {
            return Err(Error::ImplausibleSeq { asked: at_least });
        }
        self.ask(|reply| Command::RaiseHead { at_least, reply }).await
    }

    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        let mut gone = 0;
        for log in Log::ALL {
            let count = read::count(&self.readers, &self.site_id, log).await.map_err(unavailable)?;
            let mut surplus = count.saturating_sub(keep.entries_max);
            loop {
                let slice = read::oldest(&self.readers, &self.site_id, log, PRUNE_SLICE).await.map_err(unavailable)?;
                let going = (0u64..).zip(&slice).take_while(|(rank, (seq, at_unix_ms))| {
                    *seq <= keep.floor && (*at_unix_ms < keep.before_unix_ms || *rank < surplus)
                });
                let Some((rank, (up_to, _))) = going.last() else { break };
                self.ask(|reply| Command::Prune { log, up_to: *up_to, reply }).await?;
                gone += rank + 1;
                surplus = surplus.saturating_sub(rank + 1);
            }
        }
        Ok(gone)
    }
}
