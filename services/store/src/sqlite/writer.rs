//! The writer task: the one place from which `control.db` changes.
//!
//! Invariant: while one commit runs everything queues, and the next group takes all of it; there is no timer. Nobody is told
//! "applied" before the COMMIT that holds it has returned. An error at COMMIT is answered `Unknown` to every member of the group,
//! and nothing remembered from before it is used again.

use super::batch::{Stopped, tell_commits};
use super::file::DataFile;
use super::revisions::Revisions;
use super::tail::Tail;
use super::write_sql;
use crate::audit::Heads;
use crate::group::{CurrentRevision, Group};
use crate::queue::{Engine, Failed, Results, closed};
use crate::{Cause, Error, OpenError, StoreId, sql};
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Key, Log, Seq};
use midshift_core::time::{Clock, Utc};
use sqlx::{Connection, Row, SqliteConnection};
use std::collections::HashMap;
use std::sync::Arc;
use tokio::sync::{Notify, watch};

pub(super) struct Writer {
    file: DataFile,
    /// None after a failure, until the next command.
    connection: Option<SqliteConnection>,
    /// Told when a COMMIT of the connection begins.
    committing: Arc<Notify>,
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    revisions: Revisions,
    tail: Arc<Tail>,
    wake: watch::Sender<Seq>,
    head: Seq,
    /// Where the chains of the audit stand, once it was asked.
    chains: Option<Heads>,
}

impl Writer {
    pub(super) fn new(
        file: DataFile,
        (connection, committing): (SqliteConnection, Arc<Notify>),
        site_id: SiteId,
        clock: Arc<dyn Clock>,
        tail: Arc<Tail>,
        wake: watch::Sender<Seq>,
        head: Seq,
    ) -> Self {
        let (connection, revisions, chains) = (Some(connection), Revisions::default(), None);
        Self { file, connection, committing, site_id, clock, revisions, tail, wake, head, chains }
    }

    /// A group that knows where all rows stand that its items name.
    async fn begin(&mut self, items: &[Vec<Item>]) -> Result<Group, Cause> {
        self.connect().await?;
        let mut base: HashMap<Key, CurrentRevision> = HashMap::new();
        let mut missing = Vec::new();
        for change in items.iter().flatten().flat_map(|i| &i.rows) {
            if base.contains_key(&change.key) {
                continue;
            }
            let revision = self.revisions.get(&change.key);
            if revision.is_none() {
                missing.push(change.key.clone());
            }
            base.insert(change.key.clone(), revision.flatten());
        }
        if !missing.is_empty() {
            let connection = self.connection.as_mut().ok_or_else(closed)?;
            let found = write_sql::read_standings(connection, &self.site_id, missing).await;
            let found = found.map_err(|error| self.fail(error))?;
            for (key, standing) in found {
                base.insert(key.clone(), standing.as_ref().map(|(revision, _)| *revision));
                self.revisions.note(key, standing);
            }
        }
        let is_audited = items.iter().flatten().any(|item| item.note.is_some());
        Ok(Group::new(self.head, base, if is_audited { self.chains().await? } else { Heads::new() }))
    }

    async fn chains(&mut self) -> Result<Heads, Cause> {
        if let Some(chains) = &self.chains {
            return Ok(chains.clone());
        }
        let connection = self.connection.as_mut().ok_or_else(closed)?;
        let chains = write_sql::chains(connection, &self.site_id).await.map_err(|error| self.fail(error))?;
        Ok(self.chains.insert(chains).clone())
    }

    /// Forgets everything that a broken connection may have left behind.
    fn fail(&mut self, error: sqlx::Error) -> Cause {
        self.connection = None;
        self.revisions.forget_all();
        self.chains = None;
        Arc::new(error)
    }

    /// Opens the file again after a failure; what is in it now is the truth.
    async fn connect(&mut self) -> Result<(), Cause> {
        if self.connection.is_some() {
            return Ok(());
        }
        let mut connection = self.file.writer().await.map_err(|e| -> Cause { Arc::new(e) })?;
        self.committing = tell_commits(&mut connection).await.map_err(|e| -> Cause { Arc::new(e) })?;
        let head = head(&mut connection, &self.site_id).await.map_err(|e| -> Cause { Arc::new(e) })?;
        self.revisions.forget_all();
        self.chains = None;
        self.tail.restart(head);
        self.head = head;
        self.wake.send_replace(head);
        self.connection = Some(connection);
        Ok(())
    }

    async fn write(&mut self, group: &Group) -> Result<(), Failed> {
        let Some(connection) = self.connection.as_mut() else {
            return Err(Failed::Before(closed()));
        };
        let batch = write_sql::write_group(&self.site_id, group, &self.revisions);
        let outcome = match batch {
            Ok(batch) => batch.run_transaction(connection, &self.committing).await,
            Err(error) => Err(Stopped { at_commit: false, error }),
        };
        if outcome.is_err() {
            // Dropping the connection rolls back what it had open.
            self.connection = None;
            self.revisions.forget_all();
            self.chains = None;
        }
        outcome.map_err(|Stopped { at_commit, error }| match at_commit {
            true => Failed::AtCommit(Arc::new(error)),
            false => Failed::Before(Arc::new(error)),
        })
    }

    /// After the commit: what was written is known, then readable at the head, then announced.
    fn publish_group(&mut self, group: Group) {
        if !group.audited_writers.is_empty() {
            self.chains = Some(group.chains);
        }
        for (key, row) in group.rows {
            self.revisions.settle(key, row);
        }
        if group.head > self.head {
            self.head = group.head;
            self.tail.extend(group.entries, group.head);
            self.wake.send_replace(group.head);
        }
    }
}

impl Engine for Writer {
    async fn commit(&mut self, items: Vec<Vec<Item>>) -> Result<Vec<Results>, Failed> {
        let mut group = self.begin(&items).await.map_err(Failed::Before)?;
        let at_unix_ms = self.clock.now().wall.0;
        let judge = |items: Vec<Item>| items.into_iter().map(|item| group.add(item, at_unix_ms)).collect();
        let results = items.into_iter().map(judge).collect();
        group.seal();
        if group.writes() {
            self.write(&group).await?;
        }
        self.publish_group(group);
        Ok(results)
    }

    async fn close(self) {
        if let Some(connection) = self.connection
            && let Err(error) = connection.close().await
        {
            tracing::warn!(%error, "closing the store failed");
        }
    }

    async fn raise_head(&mut self, at_least: Seq) -> Result<Seq, Error> {
        self.connect().await.map_err(Error::Unavailable)?;
        if at_least > self.head {
            let mut group = Group::new(self.head, HashMap::new(), Heads::new());
            group.head = at_least;
            let written = self.write(&group).await;
            written.map_err(|(Failed::Before(cause) | Failed::AtCommit(cause))| Error::Unavailable(cause))?;
            self.publish_group(group);
        }
        Ok(self.head)
    }

    async fn prune(&mut self, log: Log, up_to: Seq) -> Result<(), Error> {
        self.connect().await.map_err(Error::Unavailable)?;
        let connection = self.connection.as_mut().ok_or_else(|| Error::Unavailable(closed()))?;
        let pruned = write_sql::prune(connection, &self.site_id, log, up_to).await;
        pruned.map_err(|error| Error::Unavailable(self.fail(error)))
    }
}

/// The newest number given.
pub(super) async fn head(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<Seq, sqlx::Error> {
    let select = sqlx::query(sql::HEAD).bind(site_id.as_str());
    sql::seq(&select.fetch_one(connection).await?, 0)
}

/// Reads the store's identity, or makes one: a new store gets a random id and numbers from `created` on.
pub(super) async fn identify(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    created: Utc,
) -> Result<StoreId, OpenError> {
    let failed = |source| OpenError::Sql { doing: "reading the store's identity", source };
    if sqlx::query(sql::IDENTITY).fetch_optional(&mut *connection).await.map_err(failed)?.is_none() {
        sqlx::query(sql::IDENTIFY)
            .bind(site_id.as_str())
            .bind(&*StoreId::fresh().0)
            .bind(created.0.max(0))
            .execute(&mut *connection)
            .await
            .map_err(failed)?;
    }
    let row = sqlx::query(sql::IDENTITY).fetch_one(connection).await.map_err(failed)?;
    let found: String = row.try_get(0).map_err(failed)?;
    if found != site_id.as_str() {
        return Err(OpenError::OtherSite { found, asked: site_id.clone() });
    }
    let store_id: String = row.try_get(1).map_err(failed)?;
    Ok(StoreId(Arc::from(store_id)))
}
