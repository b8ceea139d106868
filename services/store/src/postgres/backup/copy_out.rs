//! All tables of both schemas into files, as they were at one moment.

use super::copied::{CopiedSchema, PATIENCE, PostgresCopy, SCHEMAS, file};
use super::tables::{TableShape, tables};
use crate::migrations::{VERSION, pending};
use crate::postgres::connect::{CONTROL_SCHEMA, Database, PostgresConfig};
use crate::postgres::read;
use crate::{OpenError, sql};
use midshift_core::Boxed;
use midshift_core::rows::Seq;
use sqlx::{AssertSqlSafe, Connection, PgConnection, Row};
use std::collections::BTreeMap;
use std::path::Path;
use tokio::fs::File;
use tokio::io::{AsyncWriteExt, BufWriter};
use tokio_stream::StreamExt;

/// What is gathered before it is written, bytes. A row may be larger.
const BUFFER_BYTES: usize = 1 << 18;
/// Asked of the catalogue, which everybody may read: `information_schema` hides what this user has no rights on.
const EXISTS: &str = "SELECT COUNT(*) FROM pg_catalog.pg_class AS c JOIN pg_catalog.pg_namespace AS n ON n.oid = c.relnamespace \
                      WHERE n.nspname = $1 AND c.relname = $2";

fn failed(source: sqlx::Error) -> OpenError {
    OpenError::Sql { doing: "copying out of PostgreSQL", source }
}

fn failed_at(table: String, source: sqlx::Error) -> OpenError {
    OpenError::Table { table, source }
}

fn io(source: std::io::Error) -> OpenError {
    OpenError::Io { doing: "writing the copy", source }
}

/// Waits for the server, but not for ever.
pub(super) async fn in_time<T>(answer: impl Future<Output = Result<T, sqlx::Error>>) -> Result<T, sqlx::Error> {
    tokio::time::timeout(PATIENCE, answer).await.unwrap_or(Err(sqlx::Error::PoolTimedOut))
}

impl PostgresCopy {
    /// Copies both schemas into `folder`, which is there. Servers may be using them: they go on, and the copy is one moment. None: no server
    /// ever served from this database.
    ///
    /// # Errors
    /// If the database cannot be reached, was written by a newer release, has only one of the schemas or a table that this user may not read
    /// whole, or the files cannot be written. Some are there then.
    pub fn begin<'a>(config: &'a PostgresConfig, folder: &'a Path) -> Boxed<'a, Result<Option<Self>, OpenError>> {
        Box::pin(async move {
            let mut connection = Database::new(config, CONTROL_SCHEMA)?.copier().await?;
            in_time(sqlx::raw_sql(read::BEGIN).execute(&mut connection)).await.map_err(failed)?;
            let mut schemas = BTreeMap::new();
            let mut shapes = Vec::new();
            for (schema, migrations) in SCHEMAS {
                let version = version(&mut connection, schema).await?;
                let ahead = pending(schema, migrations, version)?.len();
                let of_version = tables(schema, migrations.get(..migrations.len() - ahead).unwrap_or_default());
                schemas.insert(schema.to_owned(), CopiedSchema { version, tables: BTreeMap::new() });
                shapes.extend(of_version);
            }
            if !shapes.iter().any(|table| table.name == "store_head") {
                return Ok(None);
            }
            let head = in_time(sqlx::query(sql::STORE).fetch_optional(&mut connection)).await.map_err(failed)?;
            let Some(head) = head else { return Ok(None) };
            if let Some((schema, _)) =
                SCHEMAS.into_iter().find(|(schema, _)| schemas.get(*schema).is_none_or(CopiedSchema::is_unmade))
            {
                return Err(OpenError::NoSchema { schema });
            }
            let mut copy = Self {
                site_id: head.try_get(0).map_err(failed)?,
                store_id: head.try_get(1).map_err(failed)?,
                head: Seq(head.try_get::<i64, _>(2).map_err(failed)?.cast_unsigned()),
                schemas,
            };
            for table in &shapes {
                let rows = write(&mut connection, folder, table).await?;
                if let Some(schema) = copy.schemas.get_mut(table.schema) {
                    schema.tables.insert(table.name.to_owned(), rows);
                }
            }
            connection.close().await.map_err(failed)?;
            Ok(Some(copy))
        })
    }
}

/// 0: there is no such schema.
async fn version(connection: &mut PgConnection, schema: &'static str) -> Result<u32, OpenError> {
    let exists = sqlx::query(EXISTS).bind(schema).bind("schema_version").fetch_one(&mut *connection);
    let exists = in_time(exists).await.and_then(|row| row.try_get::<i64, _>(0)).map_err(failed)?;
    if exists == 0 {
        return Ok(0);
    }
    let table = format!("{schema}.schema_version");
    let select = VERSION.replace("schema_version", &table);
    let row = in_time(sqlx::query(AssertSqlSafe(select)).fetch_one(connection)).await;
    let version = row.and_then(|row| row.try_get::<i64, _>(0)).map_err(|source| failed_at(table, source))?;
    Ok(version as u32)
}

/// How many rows went into the file: what the database says, not what was written.
async fn write(connection: &mut PgConnection, folder: &Path, table: &TableShape) -> Result<u64, OpenError> {
    let path = file(folder, table);
    tokio::fs::create_dir_all(folder.join(table.schema)).await.map_err(io)?;
    let mut file = BufWriter::with_capacity(BUFFER_BYTES, File::create_new(path).await.map_err(io)?);
    let failed = |source| failed_at(format!("{}.{}", table.schema, table.name), source);
    let statement = format!("COPY {} TO STDOUT (FORMAT binary)", table.columns());
    let mut rows = in_time(connection.copy_out_raw(&statement)).await.map_err(failed)?;
    loop {
        let next = in_time(async { rows.next().await.transpose() }).await.map_err(failed)?;
        let Some(bytes) = next else { break };
        file.write_all(&bytes).await.map_err(io)?;
    }
    drop(rows);
    file.flush().await.map_err(io)?;
    let count = AssertSqlSafe(format!("SELECT COUNT(*) FROM {}.{}", table.schema, table.name));
    let row = in_time(sqlx::query(count).fetch_one(connection)).await.map_err(failed)?;
    Ok(row.try_get::<i64, _>(0).map_err(failed)?.cast_unsigned())
}
