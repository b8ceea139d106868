//! The writer task of one process: each group is one transaction that has the site's head row for itself.
//!
//! Invariant: whoever writes rows or entries of the site locks `store_head` first, reads where its rows stand after that, and lets
//! go at COMMIT. So number order is commit order over all processes, and what an item expects or keeps is still so when it is
//! committed. Nothing is remembered from one transaction to the next: other processes write too.

use super::connect::{Database, WRITE_PATIENCE, is_gone, is_undone_by_others, no_answer};
use super::heartbeats::broken_silence;
use super::identity::identify;
use super::write_sql;
use crate::audit::Heads;
use crate::group::Group;
use crate::queue::{Engine, Failed, Results};
use crate::{Cause, CommitError, Error, StoreId};
use midshift_core::ids::SiteId;
use midshift_core::item::{Item, Silent};
use midshift_core::rows::{Log, Seq};
use midshift_core::time::Clock;
use sqlx::{Connection, PgConnection};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// How often a transaction is tried that the server undid because of others (serialization failure, deadlock).
const ATTEMPTS: u32 = 24;
/// Longest pause before another try; the first ones are shorter.
const PAUSE_MAX: Duration = Duration::from_millis(50);

pub(super) struct Writer {
    database: Database,
    /// None after a failure, until the next command.
    connection: Option<PgConnection>,
    site_id: SiteId,
    id: StoreId,
    clock: Arc<dyn Clock>,
    /// Within this process.
    wake: watch::Sender<Seq>,
    /// For the notifier.
    committed: watch::Sender<Seq>,
}

/// Why one try did not go through.
enum Undone {
    /// Nothing of it was written, and it may be tried again.
    ByOthers(sqlx::Error),
    /// Nothing of it was written: the connection is no more.
    Gone(sqlx::Error),
    /// Nothing of it was written.
    Before(Cause),
    /// Nobody knows.
    AtCommit(Cause),
}

impl From<sqlx::Error> for Undone {
    fn from(error: sqlx::Error) -> Self {
        match error {
            error if is_undone_by_others(&error) => Self::ByOthers(error),
            error if is_gone(&error) => Self::Gone(error),
            error => Self::Before(Arc::new(error)),
        }
    }
}

impl Writer {
    pub(super) fn new(
        database: Database,
        connection: PgConnection,
        (site_id, id): (SiteId, StoreId),
        clock: Arc<dyn Clock>,
        (wake, committed): (watch::Sender<Seq>, watch::Sender<Seq>),
    ) -> Self {
        Self { database, connection: Some(connection), site_id, id, clock, wake, committed }
    }

    /// A connection to the same store as before.
    async fn connect(&self) -> Result<PgConnection, Cause> {
        let mut connection = self.database.writer().await.map_err(|error| -> Cause { Arc::new(error) })?;
        let identity = identify(&mut connection, &self.site_id, self.clock.now().wall);
        let found = tokio::time::timeout(WRITE_PATIENCE, identity).await.map_err(|_| no_answer())?;
        let found = found.map_err(|error| -> Cause { Arc::new(error) })?;
        if found == self.id {
            return Ok(connection);
        }
        // Restored or made anew: what this process holds in memory is of another store.
        tracing::error!(store_id = %found, expected = %self.id, "the database holds another store now: start again");
        Err(Arc::new(std::io::Error::other("the database holds another store now")))
    }

    fn announce(&self, head: Seq) {
        super::wake::raise(&self.wake, head);
        super::wake::raise(&self.committed, head);
    }

    /// Runs `work` in one transaction that begins with the lock of the head row; tried again when others undid it. `work` says
    /// whether there is anything to commit.
    async fn transaction<T, W>(&mut self, mut work: W) -> Result<T, Failed>
    where
        W: AsyncWork<T>,
    {
        let mut attempt = 0;
        loop {
            attempt += 1;
            let kept = self.connection.take();
            let is_kept = kept.is_some();
            let mut connection = match kept {
                Some(connection) => connection,
                None => self.connect().await.map_err(Failed::Before)?,
            };
            match once(&mut connection, &self.site_id, &mut work).await {
                Ok(done) => {
                    self.connection = Some(connection);
                    return Ok(done);
                }
                Err(Undone::ByOthers(error)) => {
                    metrics::counter!("midshift_store_retries_total").increment(1);
                    let ended =
                        tokio::time::timeout(WRITE_PATIENCE, sqlx::raw_sql("ROLLBACK").execute(&mut connection));
                    if matches!(ended.await, Ok(Ok(_))) {
                        self.connection = Some(connection);
                    }
                    if attempt == ATTEMPTS {
                        return Err(Failed::Before(Arc::new(error)));
                    }
                    let longest = PAUSE_MAX.min(Duration::from_millis(1 << attempt.min(6)));
                    tokio::time::sleep(longest.mul_f64(rand::random())).await;
                }
                // It may have ended long before, with a server that is there again: a new one says so.
                Err(Undone::Gone(_)) if is_kept && attempt < ATTEMPTS => {
                    metrics::counter!("midshift_store_retries_total").increment(1);
                }
                Err(Undone::Gone(error)) => return Err(Failed::Before(Arc::new(error))),
                // Dropping the connection rolls back what it had open.
                Err(Undone::Before(cause)) => return Err(Failed::Before(cause)),
                Err(Undone::AtCommit(cause)) => return Err(Failed::AtCommit(cause)),
            }
        }
    }
}

/// Work inside a transaction, of which there may be several tries.
trait AsyncWork<T>: Send {
    /// What came out, and whether there is anything to commit.
    fn run(
        &mut self,
        connection: &mut PgConnection,
        site_id: &SiteId,
        head: Seq,
    ) -> impl Future<Output = Result<(T, bool), sqlx::Error>> + Send;
}

async fn once<T>(connection: &mut PgConnection, site_id: &SiteId, work: &mut impl AsyncWork<T>) -> Result<T, Undone> {
    let statements = async {
        let head = write_sql::begin(connection, site_id).await?;
        work.run(connection, site_id, head).await
    };
    let (done, writes) =
        tokio::time::timeout(WRITE_PATIENCE, statements).await.map_err(|_| Undone::Before(no_answer()))??;
    let end = if writes { "COMMIT" } else { "ROLLBACK" };
    let ended = tokio::time::timeout(WRITE_PATIENCE, sqlx::raw_sql(end).execute(connection)).await;
    match ended {
        Ok(Ok(_)) => Ok(done),
        // What was judged under the lock was so, whatever became of the connection afterwards.
        Ok(Err(error)) if !writes => Err(error.into()),
        Ok(Err(error)) if is_undone_by_others(&error) => Err(Undone::ByOthers(error)),
        Ok(Err(error)) => Err(Undone::AtCommit(Arc::new(error))),
        Err(_) if writes => Err(Undone::AtCommit(no_answer())),
        Err(_) => Err(Undone::Before(no_answer())),
    }
}

struct GroupCommit {
    items: Vec<Vec<Item>>,
    at_unix_ms: i64,
}

impl AsyncWork<(Vec<Results>, Seq)> for GroupCommit {
    async fn run(
        &mut self,
        connection: &mut PgConnection,
        site_id: &SiteId,
        head: Seq,
    ) -> Result<((Vec<Results>, Seq), bool), sqlx::Error> {
        let keys = self.items.iter().flatten().flat_map(|item| &item.rows).map(|change| &change.key);
        let base = write_sql::read_current_revisions(connection, site_id, keys).await?;
        let silent: Vec<&Silent> = self.items.iter().flatten().filter_map(|item| item.silent.as_ref()).collect();
        let heard = broken_silence(connection, site_id, &silent).await?;
        let is_audited = self.items.iter().flatten().any(|item| item.note.is_some());
        let chains = if is_audited { write_sql::chains(connection, site_id).await? } else { Heads::new() };
        let mut group = Group::new(head, base, chains);
        // Judged from a copy, because it may have to be judged again.
        let mut add = |item: &Item| match item.silent.as_ref().filter(|silent| heard.contains(&silent.robot_id)) {
            Some(silent) => Err(CommitError::Heard { robot_id: silent.robot_id.clone() }),
            None => group.add(item.clone(), self.at_unix_ms),
        };
        let mut judge = |items: &Vec<Item>| items.iter().map(&mut add).collect::<Results>();
        let results: Vec<Results> = self.items.iter().map(&mut judge).collect();
        group.seal();
        let writes = group.writes();
        if writes {
            write_sql::write_group(connection, site_id, &group).await?;
        }
        Ok(((results, group.head), writes))
    }
}

struct RaiseHead(Seq);

impl AsyncWork<Seq> for RaiseHead {
    async fn run(
        &mut self,
        connection: &mut PgConnection,
        site_id: &SiteId,
        head: Seq,
    ) -> Result<(Seq, bool), sqlx::Error> {
        if self.0 > head {
            write_sql::head(connection, site_id, self.0).await?;
        }
        Ok((self.0.max(head), self.0 > head))
    }
}

struct Prune(Log, Seq);

impl AsyncWork<()> for Prune {
    async fn run(
        &mut self,
        connection: &mut PgConnection,
        site_id: &SiteId,
        _: Seq,
    ) -> Result<((), bool), sqlx::Error> {
        write_sql::prune(connection, site_id, self.0, self.1).await?;
        Ok(((), true))
    }
}

impl Engine for Writer {
    async fn commit(&mut self, items: Vec<Vec<Item>>) -> Result<Vec<Results>, Failed> {
        let at_unix_ms = self.clock.now().wall.0;
        let (results, head) = self.transaction(GroupCommit { items, at_unix_ms }).await?;
        self.announce(head);
        Ok(results)
    }

    async fn raise_head(&mut self, at_least: Seq) -> Result<Seq, Error> {
        let head = self.transaction(RaiseHead(at_least)).await.map_err(error)?;
        self.announce(head);
        Ok(head)
    }

    async fn prune(&mut self, log: Log, up_to: Seq) -> Result<(), Error> {
        self.transaction(Prune(log, up_to)).await.map_err(error)
    }

    async fn close(self) {
        if let Some(connection) = self.connection
            && let Err(error) = connection.close().await
        {
            tracing::warn!(%error, "closing the store failed");
        }
    }
}

fn error(failed: Failed) -> Error {
    let (Failed::Before(cause) | Failed::AtCommit(cause)) = failed;
    Error::Unavailable(cause)
}
