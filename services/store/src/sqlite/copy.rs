//! Copies of a data directory's files while a server uses them, and what a copy must be before it is used again.
//!
//! Invariant: a copy is one moment of its file, whole and durable, or it is not there. A store that was restored is another store: it gets an
//! id of its own, so that nobody goes on from a number that the copy never gave.

use super::file::{CONTROL_DB, TELEMETRY_DB};
use super::{schema, write_sql};
use crate::migrations::{self, Migration};
use crate::restored_rows::amended;
use crate::sql::{self, RENEW};
use crate::{OpenError, StoreId};
use midshift_core::Boxed;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Row as StoredRow, Seq, Table};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, Row, SqliteConnection};
use std::path::Path;
use std::time::Duration;

/// The writer may hold the file up for so long.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);
/// Findings of one check that are told.
const FINDINGS_MAX: u32 = 20;

/// One of the two files of a data directory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Database {
    /// Rows and their logs.
    Control,
    /// Samples of robots.
    Telemetry,
}

/// What a file says of itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Described {
    /// Whose rows these are; none: a file that no server ever served from, or one of samples.
    pub site_id: Option<String>,
    /// Its newest number; none as above.
    pub head: Option<Seq>,
    /// Its schema.
    pub schema: u32,
}

impl Database {
    /// Its name in a data directory.
    pub const fn file(self) -> &'static str {
        match self {
            Self::Control => CONTROL_DB,
            Self::Telemetry => TELEMETRY_DB,
        }
    }
    const fn migrations(self) -> &'static [Migration] {
        match self {
            Self::Control => migrations::CONTROL,
            Self::Telemetry => migrations::TELEMETRY,
        }
    }

    /// Copies it out of a data directory, which a server may be using, to `to`, which must not be there.
    ///
    /// # Errors
    /// If the file cannot be read, was written by a newer release, or the copy cannot be written.
    pub fn copy<'a>(self, dir: &'a Path, to: &'a Path) -> Boxed<'a, Result<(), OpenError>> {
        Box::pin(async move {
            let mut connection = read_only(&dir.join(self.file())).await?;
            self.schema(&mut connection).await?;
            let sql = |source| OpenError::Sql { doing: "copying", source };
            sqlx::query("VACUUM INTO $1").bind(to.to_string_lossy()).execute(&mut connection).await.map_err(sql)?;
            connection.close().await.map_err(sql)?;
            let durable = async { tokio::fs::File::open(to).await?.sync_all().await };
            durable.await.map_err(|source| OpenError::Io { doing: "making the copy durable", source })
        })
    }

    /// Reads a file that nobody serves from, and whether SQLite finds it whole: what is wrong with it comes second.
    ///
    /// # Errors
    /// If it cannot be read at all, or was written by a newer release.
    pub fn inspect(self, path: &Path) -> Boxed<'_, Result<(Described, Vec<String>), OpenError>> {
        Box::pin(async move {
            let mut connection = read_only(path).await?;
            let sql = |source| OpenError::Sql { doing: "checking", source };
            let schema = self.schema(&mut connection).await?;
            let rows = sqlx::query("SELECT integrity_check FROM pragma_integrity_check LIMIT $1").bind(FINDINGS_MAX);
            let rows = rows.fetch_all(&mut connection).await.map_err(sql)?;
            let found: Result<Vec<String>, _> = rows.iter().map(|row| row.try_get(0)).collect();
            let found = found.map_err(sql)?.into_iter().filter(|text| text != "ok").collect();
            let mut described = Described { site_id: None, head: None, schema };
            if self == Self::Control {
                let head = sqlx::query("SELECT site_id, seq FROM store_head").fetch_optional(&mut connection).await;
                if let Some(head) = head.map_err(sql)? {
                    described.site_id = Some(head.try_get(0).map_err(sql)?);
                    described.head = Some(Seq(head.try_get::<i64, _>(1).map_err(sql)?.cast_unsigned()));
                }
            }
            connection.close().await.map_err(sql)?;
            Ok((described, found))
        })
    }

    async fn schema(self, connection: &mut SqliteConnection) -> Result<u32, OpenError> {
        let sql = |source| OpenError::Sql { doing: "reading the schema version", source };
        let row = sqlx::query("SELECT COALESCE(MAX(version), 0) FROM schema_version").fetch_one(connection).await;
        let found = row.and_then(|row| row.try_get::<i64, _>(0)).map_err(sql)? as u32;
        let known = self.migrations().len() as u32;
        if found > known {
            return Err(OpenError::NewerSchema { file: self.file(), found, known });
        }
        Ok(found)
    }
}

/// Makes a restored `control.db` the store `id`, another one than it is a copy of.
///
/// # Errors
/// If the file cannot be written.
pub fn renew_identity<'a>(dir: &'a Path, id: &'a StoreId) -> Boxed<'a, Result<(), OpenError>> {
    Box::pin(async move {
        let sql = |source| OpenError::Sql { doing: "giving the restored store an id of its own", source };
        let mut connection = durable(dir).await.map_err(sql)?;
        sqlx::query(RENEW).bind(&*id.0).execute(&mut connection).await.map_err(sql)?;
        connection.close().await.map_err(sql)
    })
}

/// A restored `control.db` that nobody serves from yet.
pub struct SqliteRestored {
    connection: SqliteConnection,
    site_id: SiteId,
}

fn amending(source: sqlx::Error) -> OpenError {
    OpenError::Sql { doing: "putting restored rows right", source }
}

impl SqliteRestored {
    /// Opens the one in `dir`, and brings it up to this binary's schema.
    ///
    /// # Errors
    /// If the file cannot be written, or is of a newer release.
    pub fn open(dir: &Path, site_id: SiteId) -> Boxed<'_, Result<Self, OpenError>> {
        Box::pin(async move {
            let mut connection = durable(dir).await.map_err(amending)?;
            schema::apply(&mut connection, CONTROL_DB, migrations::CONTROL).await?;
            Ok(Self { connection, site_id })
        })
    }

    /// All rows of these tables.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn rows<'a>(&'a mut self, tables: &'a [Table]) -> Boxed<'a, Result<Vec<StoredRow>, OpenError>> {
        Box::pin(async move {
            let mut rows = Vec::new();
            for table in tables {
                let select = sqlx::query(AssertSqlSafe(sql::whole(*table))).bind(self.site_id.as_str());
                for row in &select.fetch_all(&mut self.connection).await.map_err(amending)? {
                    rows.push(sql::row(*table, row).map_err(amending)?);
                }
            }
            Ok(rows)
        })
    }

    /// Writes rows of an item, all or none, and closes the file. No log has them: the restored store is another one, which everybody reads anew.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn amend(mut self, item: &Item) -> Boxed<'_, Result<(), OpenError>> {
        Box::pin(async move {
            let mut transaction = self.connection.begin().await.map_err(amending)?;
            write_sql::write_rows(&mut transaction, &self.site_id, &amended(item)).await.map_err(amending)?;
            transaction.commit().await.map_err(amending)?;
            self.connection.close().await.map_err(amending)
        })
    }
}

/// A connection to the `control.db` in `dir` whose commits are durable.
async fn durable(dir: &Path) -> Result<SqliteConnection, sqlx::Error> {
    let options = SqliteConnectOptions::new().filename(dir.join(CONTROL_DB)).busy_timeout(BUSY_TIMEOUT);
    let mut connection = options.connect().await?;
    sqlx::query("PRAGMA synchronous = FULL").execute(&mut connection).await?;
    Ok(connection)
}

async fn read_only(path: &Path) -> Result<SqliteConnection, OpenError> {
    let options = SqliteConnectOptions::new().filename(path).busy_timeout(BUSY_TIMEOUT).read_only(true);
    options.connect().await.map_err(|source| OpenError::Sql { doing: "opening for reading", source })
}
