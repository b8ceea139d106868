//! The newest heartbeats of all gateways: one batch is one transaction that has their head row for itself.
//!
//! Invariant: whoever keeps heartbeats moves `robot_last_head` first and reads the store's head after that; whoever relies on a
//! robot's silence locks the store's head first and that row after it ([`broken_silence`]). So of the two one sees the other, and
//! they never wait for each other in a circle.

use super::connect::{
    CONTROL_SCHEMA, Database, PostgresConfig, WRITE_PATIENCE, is_undone_by_others, no_answer, patiently,
};
use super::migrate::BEGIN;
use super::read;
use crate::queue::unavailable;
use crate::{Error, HeartbeatLog, OpenError, SavedHeartbeats, StoredHeartbeat};
use async_trait::async_trait;
use midshift_core::Boxed;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Silent;
use sqlx::{PgConnection, PgPool, Row};
use std::collections::BTreeSet;
use std::sync::Arc;
use tokio::sync::Mutex;

/// How often a transaction is tried that the server undid because of others.
const ATTEMPTS: u32 = 24;

/// A [`HeartbeatLog`] in schema `control` of a PostgreSQL database.
pub struct PostgresHeartbeats {
    database: Database,
    site_id: SiteId,
    readers: PgPool,
    /// None after a failure, until the next batch.
    writer: Mutex<Option<PgConnection>>,
}

impl PostgresHeartbeats {
    /// Opens it in a database whose store is open.
    ///
    /// # Errors
    /// If the database cannot be reached.
    pub fn open(config: &PostgresConfig, site_id: SiteId) -> Boxed<'_, Result<Self, OpenError>> {
        Box::pin(async move {
            let database = Database::new(config, CONTROL_SCHEMA)?;
            let mut connection = database.writer().await?;
            sqlx::query(
                "INSERT INTO robot_last_head (site_id, position) VALUES ($1, 0) ON CONFLICT (site_id) DO NOTHING",
            )
            .bind(site_id.as_str())
            .execute(&mut connection)
            .await
            .map_err(|source| OpenError::Sql { doing: "reading the head of the heartbeats", source })?;
            Ok(Self { readers: database.readers(), database, site_id, writer: Mutex::new(Some(connection)) })
        })
    }

    /// Closes its connections.
    pub fn close(&self) -> Boxed<'_, ()> {
        Box::pin(async move {
            drop(self.writer.lock().await.take());
            self.readers.close().await;
        })
    }
}

#[async_trait]
impl HeartbeatLog for PostgresHeartbeats {
    async fn save_newest(&self, heard: Vec<StoredHeartbeat>) -> Result<SavedHeartbeats, Error> {
        let mut writer = self.writer.lock().await;
        let mut attempt = 0;
        loop {
            attempt += 1;
            let mut connection = match writer.take() {
                Some(connection) => connection,
                None => self.database.writer().await.map_err(|error| Error::Unavailable(Arc::new(error)))?,
            };
            let done = tokio::time::timeout(WRITE_PATIENCE, save_batch(&mut connection, &self.site_id, &heard)).await;
            match done.map_err(|_| Error::Unavailable(no_answer()))? {
                Ok(kept) => {
                    *writer = Some(connection);
                    return Ok(kept);
                }
                // Dropping the connection rolls back what it had open. Kept twice, it says the same twice.
                Err(error) if is_undone_by_others(&error) && attempt < ATTEMPTS => {
                    metrics::counter!("midshift_store_retries_total").increment(1);
                }
                Err(error) => return Err(unavailable(error)),
            }
        }
    }

    async fn position(&self) -> Result<u64, Error> {
        let select = sqlx::query("SELECT position FROM robot_last_head WHERE site_id = $1").bind(self.site_id.as_str());
        let row = patiently(async { select.fetch_one(&self.readers).await.map_err(unavailable) }).await?;
        number(&row, 0).map_err(unavailable)
    }

    async fn read(&self, after: u64) -> Result<(Vec<StoredHeartbeat>, u64), Error> {
        let select = sqlx::query(
            "SELECT position, robot_id, session_epoch, hb, body FROM robot_last \
             WHERE site_id = $1 AND position > $2 ORDER BY position",
        );
        let select = select.bind(self.site_id.as_str()).bind(after.cast_signed());
        let rows = patiently(async { select.fetch_all(&self.readers).await.map_err(unavailable) }).await?;
        let last = rows.last().map(|row| number(row, 0)).transpose().map_err(unavailable)?;
        let heard: Result<Vec<StoredHeartbeat>, sqlx::Error> = rows.iter().map(decode).collect();
        Ok((heard.map_err(unavailable)?, last.unwrap_or(after)))
    }
}

fn number(row: &sqlx::postgres::PgRow, at: usize) -> Result<u64, sqlx::Error> {
    row.try_get::<i64, _>(at).map(i64::cast_unsigned)
}

fn decode(row: &sqlx::postgres::PgRow) -> Result<StoredHeartbeat, sqlx::Error> {
    Ok(StoredHeartbeat {
        robot_id: robot_id(row.try_get(1)?)?,
        session_epoch: number(row, 2)?,
        hb: number(row, 3)?,
        body: Arc::from(row.try_get::<&str, _>(4)?),
    })
}

fn robot_id(text: &str) -> Result<RobotId, sqlx::Error> {
    RobotId::parse(text).map_err(|error| sqlx::Error::Decode(Box::new(error)))
}

async fn save_batch(
    connection: &mut PgConnection,
    site_id: &SiteId,
    heard: &[StoredHeartbeat],
) -> Result<SavedHeartbeats, sqlx::Error> {
    sqlx::raw_sql(BEGIN).execute(&mut *connection).await?;
    let moved = sqlx::query("UPDATE robot_last_head SET position = position + 1 WHERE site_id = $1 RETURNING position")
        .bind(site_id.as_str())
        .fetch_one(&mut *connection)
        .await?;
    let stored = sqlx::query(
        "INSERT INTO robot_last (site_id, position, robot_id, session_epoch, hb, body) SELECT $1, $2, row.* FROM \
         UNNEST($3::text[], $4::bigint[], $5::bigint[], $6::text[]) AS row \
         ON CONFLICT (site_id, robot_id) DO UPDATE SET position = excluded.position, \
         session_epoch = excluded.session_epoch, hb = excluded.hb, body = excluded.body \
         WHERE robot_last.session_epoch <= excluded.session_epoch RETURNING robot_id",
    )
    .bind(site_id.as_str())
    .bind(moved.try_get::<i64, _>(0)?)
    .bind(heard.iter().map(|h| h.robot_id.as_str()).collect::<Vec<_>>())
    .bind(heard.iter().map(|h| h.session_epoch.cast_signed()).collect::<Vec<_>>())
    .bind(heard.iter().map(|h| h.hb.cast_signed()).collect::<Vec<_>>())
    .bind(heard.iter().map(|h| &*h.body).collect::<Vec<_>>())
    .fetch_all(&mut *connection)
    .await?;
    let stored: Result<BTreeSet<RobotId>, sqlx::Error> = stored.iter().map(|row| robot_id(row.try_get(0)?)).collect();
    let stored = stored?;
    let head = read::head(&mut *connection, site_id).await?;
    sqlx::raw_sql("COMMIT").execute(connection).await?;
    let fenced = heard.iter().map(|h| &h.robot_id).filter(|id| !stored.contains(*id)).cloned().collect();
    Ok(SavedHeartbeats { head, fenced })
}

/// Which of the robots that had to be silent were heard after what was known of them. Until the transaction ends nobody else is kept.
pub(super) async fn broken_silence(
    connection: &mut PgConnection,
    site_id: &SiteId,
    silent: &[&Silent],
) -> Result<BTreeSet<RobotId>, sqlx::Error> {
    if silent.is_empty() {
        return Ok(BTreeSet::new());
    }
    sqlx::query("SELECT position FROM robot_last_head WHERE site_id = $1 FOR SHARE")
        .bind(site_id.as_str())
        .fetch_optional(&mut *connection)
        .await?;
    let rows = sqlx::query("SELECT robot_id, position FROM robot_last WHERE site_id = $1 AND robot_id = ANY($2)")
        .bind(site_id.as_str())
        .bind(silent.iter().map(|s| s.robot_id.as_str()).collect::<Vec<_>>())
        .fetch_all(connection)
        .await?;
    let mut broken = BTreeSet::new();
    for row in &rows {
        let (id, position) = (robot_id(row.try_get(0)?)?, number(row, 1)?);
        if silent.iter().any(|s| s.robot_id == id && s.position < position) {
            broken.insert(id);
        }
    }
    Ok(broken)
}
