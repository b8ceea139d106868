//! A database made of a copy, in one transaction.

use super::copied::{PostgresCopy, SCHEMAS, file};
use super::copy_out::in_time;
use super::tables::{TableShape, tables};
use crate::migrations::{Migration, pending};
use crate::postgres::connect::{CONTROL_SCHEMA, Database, PostgresConfig};
use crate::postgres::{migrate, write_sql};
use crate::restored_rows::amended;
use crate::{OpenError, StoreId, sql};
use midshift_core::Boxed;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Row as StoredRow, Table};
use sqlx::{AssertSqlSafe, PgConnection, Row};
use std::path::Path;
use tokio::fs::File;
use tokio::io::AsyncReadExt;

/// What is sent at once, bytes.
const CHUNK_BYTES: usize = 1 << 18;

/// Why a database was not made of a copy.
#[derive(Debug, thiserror::Error)]
pub enum RestoreError {
    /// The database, or the copy's file.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// It has rows already.
    #[error(
        "the database has rows in {table} already, and a restore goes into an empty one only: make another one (createdb) and name it in --store"
    )]
    NotEmpty {
        /// The first table with a row.
        table: String,
    },
    /// Its tables are empty, but of another version.
    #[error(
        "the database has empty tables of schema {schema} {found}, and the backup is of {backup}: make another database (createdb) and name it in --store"
    )]
    OtherSchema {
        /// Which schema.
        schema: &'static str,
        /// Its version.
        found: u32,
        /// The backup's.
        backup: u32,
    },
    /// A file has not the rows that were counted when it was copied.
    #[error("{table} took {found} rows of the backup, {copied} were copied")]
    Rows {
        /// Which table.
        table: String,
        /// How many were there to be.
        copied: u64,
        /// How many there are.
        found: u64,
    },
    /// It may have been committed or not.
    #[error("PostgreSQL has not said whether it took the rows")]
    Unknown(#[source] sqlx::Error),
}

fn failed(source: sqlx::Error) -> RestoreError {
    OpenError::Sql { doing: "restoring into PostgreSQL", source }.into()
}

fn io(source: std::io::Error) -> RestoreError {
    OpenError::Io { doing: "reading the copy", source }.into()
}

/// A database that is being made of a copy. Until [`PostgresRestore::commit`] nothing of it is there, and when it is dropped nothing stays.
/// Nobody else migrates or opens the database meanwhile.
pub struct PostgresRestore {
    connection: PgConnection,
    config: PostgresConfig,
    id: StoreId,
}

impl PostgresRestore {
    /// Brings all rows of a copy in `folder`, which [`PostgresCopy::check`] finds good, into an empty database, as the store `id`. Numbers go on from those of the copy. A copy of an
    /// older schema is brought up to this binary's.
    ///
    /// # Errors
    /// If the database has a row of midshift, the copy is of a newer release, or one of the two fails.
    pub fn begin<'a>(
        config: &'a PostgresConfig,
        folder: &'a Path,
        copy: &'a PostgresCopy,
        id: &'a StoreId,
    ) -> Boxed<'a, Result<Self, RestoreError>> {
        Box::pin(async move {
            let mut connection = Database::new(config, CONTROL_SCHEMA)?.copier().await?;
            in_time(sqlx::raw_sql(migrate::BEGIN).execute(&mut connection)).await.map_err(failed)?;
            // Telemetry first: what ends in the schema on the search path is the store's.
            for (schema, migrations) in SCHEMAS.into_iter().rev() {
                let version = copy.version(schema);
                let later = pending(schema, migrations, version)?;
                let made = migrations.get(..migrations.len() - later.len()).unwrap_or_default();
                empty(&mut connection, (schema, migrations), made).await?;
                for table in &tables(schema, made) {
                    let copied = copy.schemas.get(schema).and_then(|s| s.tables.get(table.name)).copied();
                    fill(&mut connection, folder, table, copied.unwrap_or(0)).await?;
                }
                in_time(migrate::climb(&mut connection, version, later)).await.map_err(failed)?;
            }
            in_time(sqlx::query(sql::RENEW).bind(&*id.0).execute(&mut connection)).await.map_err(failed)?;
            Ok(Self { connection, config: config.clone(), id: id.clone() })
        })
    }

    /// All rows of these tables, as they are about to be.
    ///
    /// # Errors
    /// The database.
    pub fn rows<'a>(
        &'a mut self,
        site_id: &'a SiteId,
        tables: &'a [Table],
    ) -> Boxed<'a, Result<Vec<StoredRow>, RestoreError>> {
        Box::pin(async move {
            let mut rows = Vec::new();
            for table in tables {
                let select = sqlx::query(AssertSqlSafe(sql::whole(*table))).bind(site_id.as_str());
                for row in &in_time(select.fetch_all(&mut self.connection)).await.map_err(failed)? {
                    rows.push(sql::row(*table, row).map_err(failed)?);
                }
            }
            Ok(rows)
        })
    }

    /// Writes rows of an item with the others. No log has them: the restored store is another one, which everybody reads anew.
    ///
    /// # Errors
    /// The database.
    pub fn amend<'a>(&'a mut self, site_id: &'a SiteId, item: &'a Item) -> Boxed<'a, Result<(), RestoreError>> {
        Box::pin(async move {
            in_time(write_sql::write_rows(&mut self.connection, site_id, &amended(item))).await.map_err(failed)
        })
    }

    /// Makes it what servers can open, durable.
    ///
    /// # Errors
    /// [`RestoreError::Unknown`] if nobody knows; after any other the database is as it was before.
    pub fn commit(mut self) -> Boxed<'static, Result<(), RestoreError>> {
        Box::pin(async move {
            match in_time(sqlx::raw_sql("COMMIT").execute(&mut self.connection)).await {
                Ok(_) => Ok(()),
                Err(error) if is_undone(&error) => Err(failed(error)),
                Err(error) => match self.is_there().await {
                    Ok(true) => Ok(()),
                    Ok(false) | Err(_) => Err(RestoreError::Unknown(error)),
                },
            }
        })
    }

    /// Whether the database holds the restored store.
    async fn is_there(&self) -> Result<bool, OpenError> {
        let mut connection = Database::new(&self.config, CONTROL_SCHEMA)?.copier().await?;
        let row = in_time(sqlx::query(sql::STORE).fetch_optional(&mut connection)).await;
        let found = row.and_then(|row| row.map(|row| row.try_get::<String, _>(1)).transpose());
        let found = found.map_err(|source| OpenError::Sql { doing: "reading the store's identity", source })?;
        Ok(found.is_some_and(|found| found == *self.id.0))
    }
}

/// Whether the server says that it committed nothing. One that was told to end says something else, and may have committed before.
fn is_undone(error: &sqlx::Error) -> bool {
    let code = error.as_database_error().and_then(|error| error.code());
    code.is_some_and(|code| !code.starts_with("57") && !code.starts_with("08"))
}

/// Makes the schema by `made`, or sees that what is there is that, without a row. Others are kept out from here on.
async fn empty(
    connection: &mut PgConnection,
    (schema, migrations): (&'static str, &'static [Migration]),
    made: &'static [Migration],
) -> Result<(), RestoreError> {
    let path = AssertSqlSafe(format!("SET LOCAL search_path TO {schema}"));
    in_time(sqlx::query(path).execute(&mut *connection)).await.map_err(failed)?;
    in_time(migrate::make(connection, schema)).await.map_err(failed)?;
    let found = in_time(migrate::lock(connection)).await.map_err(failed)?;
    let ahead = pending(schema, migrations, found)?.len();
    for table in tables(schema, migrations.get(..migrations.len() - ahead).unwrap_or_default()) {
        let exists = AssertSqlSafe(format!("SELECT EXISTS (SELECT 1 FROM {schema}.{})", table.name));
        let row = in_time(sqlx::query(exists).fetch_one(&mut *connection)).await.map_err(failed)?;
        if row.try_get(0).map_err(failed)? {
            return Err(RestoreError::NotEmpty { table: format!("{schema}.{}", table.name) });
        }
    }
    let backup = made.len() as u32;
    if found == 0 {
        return in_time(migrate::climb(connection, 0, made)).await.map_err(failed);
    }
    if found != backup {
        return Err(RestoreError::OtherSchema { schema, found, backup });
    }
    Ok(())
}

async fn fill(
    connection: &mut PgConnection,
    folder: &Path,
    table: &TableShape,
    copied: u64,
) -> Result<(), RestoreError> {
    let mut source = File::open(file(folder, table)).await.map_err(io)?;
    let statement = format!("COPY {} FROM STDIN (FORMAT binary)", table.columns());
    let mut copying = in_time(connection.copy_in_raw(&statement)).await.map_err(failed)?;
    let mut chunk = vec![0; CHUNK_BYTES];
    loop {
        let read = source.read(&mut chunk).await.map_err(io)?;
        let Some(bytes) = chunk.get(..read).filter(|bytes| !bytes.is_empty()) else { break };
        in_time(copying.send(bytes)).await.map_err(failed)?;
    }
    let found = in_time(copying.finish()).await.map_err(failed)?;
    if found != copied {
        return Err(RestoreError::Rows { table: format!("{}.{}", table.schema, table.name), copied, found });
    }
    Ok(())
}
