//! The writer task: the one place from which `control.db` changes.
//!
//! Invariant: while one commit runs everything queues, and the next group takes all of it; there is no timer. Nobody is told
//! "applied" before the COMMIT that holds it has returned. An error at COMMIT is answered `Unknown` to every member of the group,
//! and nothing remembered from before it is used again.

use super::file::DataFile;
use super::group::Group;
use super::revisions::{Revisions, Standing};
use super::tail::Tail;
use super::{OpenError, unavailable, write_sql};
use crate::{Applied, Cause, CommitError, Error, StoreId};
use midshift_core::ids::SiteId;
use midshift_core::limits;
use midshift_core::rows::{Item, Key, Log, Seq};
use midshift_core::time::{Clock, Utc};
use sqlx::{Connection, Row, SqliteConnection};
use std::collections::HashMap;
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

type Results = Vec<Result<Applied, CommitError>>;

pub(super) struct Commit {
    pub(super) items: Vec<Item>,
    pub(super) bytes: usize,
    pub(super) reply: oneshot::Sender<Results>,
}

pub(super) enum Command {
    Commit(Commit),
    RaiseHead { at_least: Seq, reply: oneshot::Sender<Result<Seq, Error>> },
    Prune { log: Log, up_to: Seq, reply: oneshot::Sender<Result<(), Error>> },
    Close { reply: oneshot::Sender<()> },
}

/// Why a transaction did not go through.
enum Failed {
    /// Nothing of it was written.
    Before(sqlx::Error),
    /// Nobody knows.
    AtCommit(sqlx::Error),
}

pub(super) struct Writer {
    file: DataFile,
    /// None after a failure, until the next command.
    connection: Option<SqliteConnection>,
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    revisions: Revisions,
    tail: Arc<Tail>,
    wake: watch::Sender<Seq>,
    head: Seq,
}

impl Writer {
    pub(super) fn new(
        file: DataFile,
        connection: SqliteConnection,
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        tail: Arc<Tail>,
        wake: watch::Sender<Seq>,
        head: Seq,
    ) -> Self {
        Self { file, connection: Some(connection), site_id, clock, revisions: Revisions::default(), tail, wake, head }
    }

    pub(super) async fn run(mut self, mut queue: mpsc::Receiver<Command>) {
        let mut put_back = None;
        loop {
            let command = match put_back.take() {
                Some(command) => command,
                None => match queue.recv().await {
                    Some(command) => command,
                    None => return,
                },
            };
            match command {
                Command::Commit(first) => {
                    let group = gather(first, &mut queue, &mut put_back);
                    self.commit(group).await;
                }
                // Who asked may have stopped waiting; the work is done all the same.
                Command::RaiseHead { at_least, reply } => drop(reply.send(self.raise_head(at_least).await)),
                Command::Prune { log, up_to, reply } => drop(reply.send(self.prune(log, up_to).await)),
                Command::Close { reply } => {
                    if let Some(connection) = self.connection.take() {
                        close(connection).await;
                    }
                    let _ = reply.send(());
                    return;
                }
            }
        }
    }

    async fn commit(&mut self, commits: Vec<Commit>) {
        let started = Instant::now();
        let items: usize = commits.iter().map(|c| c.items.len()).sum();
        let mut group = match self.begin(&commits).await {
            Ok(group) => group,
            Err(error) => return refuse(commits, || CommitError::Unavailable(error.clone())),
        };
        let at_unix_ms = self.clock.now().wall.0;
        let mut answers = Vec::with_capacity(commits.len());
        for Commit { items, reply, .. } in commits {
            let results: Results = items.into_iter().map(|item| group.add(item, at_unix_ms)).collect();
            answers.push((results, reply));
        }
        let conflicts = answers.iter().flat_map(|(r, _)| r).filter(|r| matches!(r, Err(CommitError::Conflict { .. })));
        metrics::counter!("midshift_store_conflicts_total").increment(conflicts.count() as u64);
        let outcome = if group.entries.is_empty() { Ok(()) } else { self.write(&group).await };
        let replace: Box<dyn Fn() -> CommitError + Send> = match outcome {
            Ok(()) => {
                self.take(group);
                metrics::counter!("midshift_store_groups_total").increment(1);
                metrics::histogram!("midshift_store_group_items").record(items as f64);
                metrics::histogram!("midshift_store_commit_seconds").record(started.elapsed().as_secs_f64());
                return answers.into_iter().for_each(|(results, reply)| drop(reply.send(results)));
            }
            Err(Failed::Before(error)) => {
                let cause: Cause = Arc::new(error);
                Box::new(move || CommitError::Unavailable(cause.clone()))
            }
            Err(Failed::AtCommit(error)) => {
                tracing::error!(%error, items, "commit outcome unknown");
                metrics::counter!("midshift_store_unknown_total").increment(items as u64);
                let cause: Cause = Arc::new(error);
                Box::new(move || CommitError::Unknown(cause.clone()))
            }
        };
        for (results, reply) in answers {
            // Also a conflict was judged against what may not have been written.
            drop(reply.send(results.iter().map(|_| Err(replace())).collect()));
        }
    }

    /// A group that knows where all rows stand that its items name.
    async fn begin(&mut self, commits: &[Commit]) -> Result<Group, Cause> {
        self.connect().await?;
        let mut base: HashMap<Key, Standing> = HashMap::new();
        let mut missing = Vec::new();
        for change in commits.iter().flat_map(|c| &c.items).flat_map(|i| &i.rows) {
            if base.contains_key(&change.key) {
                continue;
            }
            let standing = self.revisions.get(&change.key);
            if standing.is_none() {
                missing.push(change.key.clone());
            }
            base.insert(change.key.clone(), standing.flatten());
        }
        if !missing.is_empty() {
            let connection = self.connection.as_mut().ok_or_else(super::closed)?;
            let found = write_sql::standings(connection, &self.site_id, missing).await;
            let found = found.map_err(|error| self.fail(error))?;
            for (key, standing) in found {
                self.revisions.put(key.clone(), standing);
                base.insert(key, standing);
            }
        }
        Ok(Group::new(self.head, base))
    }

    /// Forgets everything that a broken connection may have left behind.
    fn fail(&mut self, error: sqlx::Error) -> Cause {
        self.connection = None;
        self.revisions.forget_all();
        Arc::new(error)
    }

    /// Opens the file again after a failure; what is in it now is the truth.
    async fn connect(&mut self) -> Result<(), Cause> {
        if self.connection.is_some() {
            return Ok(());
        }
        let mut connection = self.file.writer().await.map_err(|e| -> Cause { Arc::new(e) })?;
        let head = head(&mut connection, &self.site_id).await.map_err(|e| -> Cause { Arc::new(e) })?;
        self.revisions.forget_all();
        self.tail.restart(head);
        self.head = head;
        self.wake.send_replace(head);
        self.connection = Some(connection);
        Ok(())
    }

    async fn write(&mut self, group: &Group) -> Result<(), Failed> {
        let Some(connection) = self.connection.as_mut() else {
            return Err(Failed::Before(sqlx::Error::PoolClosed));
        };
        let outcome = transaction(connection, &self.site_id, group).await;
        if outcome.is_err() {
            // Dropping the connection rolls back what it had open.
            self.connection = None;
            self.revisions.forget_all();
        }
        outcome
    }

    /// After the commit: what was written is known, then readable at the head, then announced.
    fn take(&mut self, group: Group) {
        for (key, row) in group.rows {
            self.revisions.put(key, row.map(|row| row.revision));
        }
        if group.head > self.head {
            self.head = group.head;
            self.tail.extend(group.entries, group.head);
            self.wake.send_replace(group.head);
        }
    }

    async fn raise_head(&mut self, at_least: Seq) -> Result<Seq, Error> {
        self.connect().await.map_err(Error::Unavailable)?;
        if at_least > self.head {
            let mut group = Group::new(self.head, HashMap::new());
            group.head = at_least;
            let written = self.write(&group).await;
            written.map_err(|(Failed::Before(error) | Failed::AtCommit(error))| unavailable(error))?;
            self.take(group);
        }
        Ok(self.head)
    }

    async fn prune(&mut self, log: Log, up_to: Seq) -> Result<(), Error> {
        self.connect().await.map_err(Error::Unavailable)?;
        let connection = self.connection.as_mut().ok_or_else(|| Error::Unavailable(super::closed()))?;
        let slice = async {
            let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await?;
            write_sql::prune(&mut transaction, &self.site_id, log, up_to).await?;
            transaction.commit().await
        };
        slice.await.map_err(|error| Error::Unavailable(self.fail(error)))
    }
}

/// Takes what has queued, up to one group's caps.
fn gather(first: Commit, queue: &mut mpsc::Receiver<Command>, put_back: &mut Option<Command>) -> Vec<Commit> {
    let (mut items, mut bytes) = (first.items.len(), first.bytes);
    let mut group = vec![first];
    while let Ok(command) = queue.try_recv() {
        match command {
            Command::Commit(commit)
                if items + commit.items.len() <= limits::GROUP_COMMIT_ITEMS
                    && bytes + commit.bytes <= limits::GROUP_COMMIT_BYTES =>
            {
                items += commit.items.len();
                bytes += commit.bytes;
                group.push(commit);
            }
            other => {
                *put_back = Some(other);
                break;
            }
        }
    }
    group
}

fn refuse(commits: Vec<Commit>, error: impl Fn() -> CommitError) {
    for commit in commits {
        drop(commit.reply.send(commit.items.iter().map(|_| Err(error())).collect()));
    }
}

async fn transaction(connection: &mut SqliteConnection, site_id: &SiteId, group: &Group) -> Result<(), Failed> {
    let statements = async {
        sqlx::query("BEGIN IMMEDIATE").execute(&mut *connection).await?;
        write_sql::rows(connection, site_id, &group.rows).await?;
        write_sql::entries(connection, site_id, &group.entries).await?;
        write_sql::head(connection, site_id, group.head).await
    };
    statements.await.map_err(Failed::Before)?;
    sqlx::query("COMMIT").execute(connection).await.map(drop).map_err(Failed::AtCommit)
}

async fn close(connection: SqliteConnection) {
    if let Err(error) = connection.close().await {
        tracing::warn!(%error, "closing the store failed");
    }
}

/// The newest number given.
pub(super) async fn head(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<Seq, sqlx::Error> {
    let row = sqlx::query("SELECT seq FROM store_head WHERE site_id = $1").bind(site_id.as_str());
    Ok(Seq(row.fetch_one(connection).await?.try_get::<i64, _>(0)?.cast_unsigned()))
}

/// A name for a store that no other store has.
pub(super) fn fresh_id() -> String {
    format!("{:032x}", rand::random::<u128>())
}

/// Reads the store's identity, or makes one: a new store gets a random id and numbers from `created` on.
pub(super) async fn identify(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    created: Utc,
) -> Result<StoreId, OpenError> {
    let sql = |source| OpenError::Sql { doing: "reading the store's identity", source };
    let select = "SELECT site_id, store_id FROM store_head";
    if sqlx::query(select).fetch_optional(&mut *connection).await.map_err(sql)?.is_none() {
        sqlx::query("INSERT INTO store_head (site_id, store_id, seq) VALUES ($1, $2, $3)")
            .bind(site_id.as_str())
            .bind(fresh_id())
            .bind(created.0.max(0))
            .execute(&mut *connection)
            .await
            .map_err(sql)?;
    }
    let row = sqlx::query(select).fetch_one(connection).await.map_err(sql)?;
    let found: String = row.try_get(0).map_err(sql)?;
    if found != site_id.as_str() {
        return Err(OpenError::OtherSite { found, asked: site_id.clone() });
    }
    let store_id: String = row.try_get(1).map_err(sql)?;
    Ok(StoreId(Arc::from(store_id)))
}
