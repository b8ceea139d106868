//! Migrations of the SQLite files.
//!
//! Invariant: all pending migrations of a file are applied in one transaction, and a schema newer than this binary is refused,
//! never guessed at.

use crate::OpenError;
use crate::migrations::{Migrated, Migration, RAISE_VERSION, SCHEMA_VERSION, VERSION, pending};
use sqlx::{AssertSqlSafe, Connection, Row, SqliteConnection};

/// Brings one file up to this binary's schema. Applying twice is a no-op.
pub(crate) async fn apply(
    connection: &mut SqliteConnection,
    file: &'static str,
    migrations: &[Migration],
) -> Result<Migrated, OpenError> {
    let sql = |source| OpenError::Sql { doing: "migrating the schema", source };
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await.map_err(sql)?;
    sqlx::query(SCHEMA_VERSION).execute(&mut *transaction).await.map_err(sql)?;
    let row = sqlx::query(VERSION).fetch_one(&mut *transaction).await;
    let from = row.and_then(|row| row.try_get::<i64, _>(0)).map_err(sql)? as u32;
    let pending = pending(file, migrations, from)?;
    for (version, migration) in (i64::from(from) + 1..).zip(pending) {
        sqlx::query(AssertSqlSafe(migration.sql)).execute(&mut *transaction).await.map_err(sql)?;
        sqlx::query(RAISE_VERSION).bind(version).bind(migration.name).execute(&mut *transaction).await.map_err(sql)?;
    }
    transaction.commit().await.map_err(sql)?;
    Ok(Migrated { file, from, to: migrations.len() as u32, applied: pending.iter().map(|m| m.name).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::migrations::{CONTROL, TELEMETRY};
    use std::path::Path;

    async fn fresh(migrations: &[Migration]) -> SqliteConnection {
        let mut connection = SqliteConnection::connect("sqlite::memory:").await.expect("an empty database");
        let migrated = apply(&mut connection, "test.db", migrations).await.expect("migrations");
        assert_eq!((migrated.from, migrated.to as usize), (0, migrated.applied.len()));
        connection
    }

    #[tokio::test]
    async fn applying_twice_changes_nothing() {
        let mut connection = fresh(CONTROL).await;
        let again = apply(&mut connection, "test.db", CONTROL).await.expect("a second run");
        assert_eq!((again.from, again.applied), (again.to, vec![]));
    }

    #[tokio::test]
    async fn a_schema_newer_than_the_binary_is_refused() {
        let mut connection = fresh(TELEMETRY).await;
        let older = apply(&mut connection, "test.db", &TELEMETRY[..2]).await;
        assert!(matches!(older, Err(OpenError::NewerSchema { found: 6, known: 2, .. })), "{older:?}");
    }

    #[tokio::test]
    async fn the_schema_is_the_golden_one() {
        for (golden, migrations) in [("control.sql", CONTROL), ("telemetry.sql", TELEMETRY)] {
            let mut connection = fresh(migrations).await;
            let rows = sqlx::query("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY type DESC, name")
                .fetch_all(&mut connection)
                .await
                .expect("the schema");
            let schema: String = rows.iter().map(|row| row.get::<String, _>(0) + ";\n\n").collect();
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden").join(golden);
            if std::env::var_os("BLESS").is_some() {
                std::fs::write(&path, &schema).expect("writing the golden schema");
            }
            let expected = std::fs::read_to_string(&path).unwrap_or_default();
            assert_eq!(schema, expected, "run with BLESS=1 if the change is meant");
        }
    }
}
