//! Migrations of a PostgreSQL schema, safe to be run by several processes at once.
//!
//! Invariant: one row is locked for as long as a process migrates, so that the next one finds everything done; all pending
//! migrations are applied in one transaction, and a schema newer than this binary is refused.

use super::connect::Database;
use crate::OpenError;
use crate::migrations::{Migrated, Migration, RAISE_VERSION, SCHEMA_VERSION, VERSION, pending};
use midshift_core::ids::SiteId;
use midshift_core::time::Utc;
use sqlx::{AssertSqlSafe, Connection, PgConnection, Row};

/// Processes that create the same schema at the same moment see each other's half; one of them has it after a few tries.
const CREATE_ATTEMPTS: usize = 20;
/// Locked by whoever migrates.
const LOCK: &str = "SELECT version FROM schema_version WHERE version = 0 FOR UPDATE";
const LOCK_ROW: &str = "INSERT INTO schema_version (version, name) VALUES (0, 'lock') ON CONFLICT (version) DO NOTHING";
/// Also where the database's own default is stricter: what was committed while we waited for the lock must be seen.
pub(super) const BEGIN: &str = "BEGIN ISOLATION LEVEL READ COMMITTED";

/// A migration in PostgreSQL's words: text is ordered by its bytes, as SQLite does, and bytes have another name.
pub(super) fn translated(sql: &str) -> String {
    sql.replace(" TEXT", " TEXT COLLATE \"C\"").replace(" BLOB", " BYTEA")
}

/// Brings one schema up to this binary's. Applying twice is a no-op.
pub(super) async fn apply(
    database: &Database,
    migrations: &'static [Migration],
    store: Option<(&SiteId, Utc)>,
) -> Result<Migrated, OpenError> {
    let sql = |source| OpenError::Sql { doing: "migrating the schema", source };
    let mut connection = database.migrator().await?;
    create(&mut connection, database.schema).await.map_err(sql)?;
    let mut transaction = connection.begin_with(BEGIN).await.map_err(sql)?;
    let from = lock(&mut transaction).await.map_err(sql)?;
    let pending = pending(database.schema, migrations, from)?;
    climb(&mut transaction, from, pending).await.map_err(sql)?;
    if let Some((site_id, created)) = store {
        // Under the lock, so that two sites cannot both be the first one.
        super::identity::identify(&mut transaction, site_id, created).await?;
    }
    transaction.commit().await.map_err(sql)?;
    drop(connection.close().await);
    let applied = pending.iter().map(|m| m.name).collect();
    Ok(Migrated { file: database.schema, from, to: migrations.len() as u32, applied })
}

/// Waits until nobody else migrates the schema on the search path, and keeps others out until the transaction ends. Its version.
pub(super) async fn lock(connection: &mut PgConnection) -> Result<u32, sqlx::Error> {
    sqlx::query(LOCK).execute(&mut *connection).await?;
    let row = sqlx::query(VERSION).fetch_one(connection).await?;
    Ok(row.try_get::<i64, _>(0)? as u32)
}

/// Brings a schema of version `from` up by `steps`.
pub(super) async fn climb(connection: &mut PgConnection, from: u32, steps: &[Migration]) -> Result<(), sqlx::Error> {
    for (version, migration) in (i64::from(from) + 1..).zip(steps) {
        sqlx::query(AssertSqlSafe(translated(migration.sql))).execute(&mut *connection).await?;
        let raise = sqlx::query(RAISE_VERSION).bind(version).bind(migration.name);
        raise.execute(&mut *connection).await?;
    }
    Ok(())
}

/// Makes a schema, which is on the search path, and its row to lock, if nobody else does so at the same moment.
pub(super) async fn make(connection: &mut PgConnection, schema: &'static str) -> Result<(), sqlx::Error> {
    for step in [format!("CREATE SCHEMA IF NOT EXISTS {schema}"), translated(SCHEMA_VERSION), LOCK_ROW.to_owned()] {
        sqlx::query(AssertSqlSafe(step)).execute(&mut *connection).await?;
    }
    Ok(())
}

/// Makes the schema and its row to lock, whoever does so at the same moment.
async fn create(connection: &mut PgConnection, schema: &'static str) -> Result<(), sqlx::Error> {
    let mut attempt = 0;
    loop {
        attempt += 1;
        match make(connection, schema).await {
            Err(sqlx::Error::Database(error))
                if attempt < CREATE_ATTEMPTS && is_made_twice(error.code().as_deref()) => {}
            outcome => return outcome,
        }
    }
}

/// `IF NOT EXISTS` is not safe against another session that creates the same: the loser hears one of these.
fn is_made_twice(code: Option<&str>) -> bool {
    matches!(code, Some("23505" | "42P06" | "42P07" | "42710" | "40001" | "40P01"))
}

#[cfg(test)]
mod tests {
    use super::translated;
    use crate::migrations::{CONTROL, TELEMETRY};

    /// Words of PostgreSQL or SQLite that the other, or another engine that speaks PostgreSQL's protocol, does not have.
    const FOREIGN: [&str; 12] = [
        "NOTIFY",
        "ADVISORY",
        "TRIGGER",
        "SERIAL",
        "AUTOINCREMENT",
        "ROWID",
        "STRICT",
        "PRAGMA",
        "JSONB",
        "FUNCTION",
        "CREATE TYPE",
        "LOCK TABLE",
    ];

    #[test]
    fn every_migration_is_of_the_portable_subset() {
        for migration in CONTROL.iter().chain(TELEMETRY) {
            let sql = migration.sql.to_uppercase();
            let foreign = FOREIGN.iter().find(|word| sql.contains(**word));
            assert_eq!(foreign, None, "{}", migration.name);
            assert!(!sql.contains(" INTEGER"), "{}: 64 bits on one engine and 32 on the other", migration.name);
            let words = ["TEXT", "BIGINT", "BLOB", "NOT NULL"];
            for line in sql.lines().filter(|line| line.starts_with("    ") && !line.contains("UNIQUE (")) {
                let kind = line.trim().trim_end_matches(',').split_once(' ').map_or("", |(_, kind)| kind);
                let known = words.iter().fold(kind.to_owned(), |rest, word| rest.replacen(word, "", 1));
                assert_eq!(known.trim(), "", "{}: {line}", migration.name);
            }
        }
    }

    /// The source's own SQL: each text that begins like a statement.
    #[test]
    fn every_statement_in_the_source_is_of_the_portable_subset() {
        let mut seen = 0;
        let mut open = vec![std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src")];
        while let Some(path) = open.pop() {
            if path.is_dir() {
                open.extend(std::fs::read_dir(path).expect("a folder").map(|f| f.expect("an entry").path()));
                continue;
            }
            // Files of SQLite's own (pragmas, copies) and this list are left out; NOTIFY has one place, outside every transaction.
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if ["file.rs", "copy.rs", "migrate.rs"].contains(&name.as_str()) {
                continue;
            }
            let text = std::fs::read_to_string(&path).expect("source");
            let text = text.split("#[cfg(test)]").next().unwrap_or_default();
            for literal in text.split('"').skip(1).step_by(2) {
                let begins = ["SELECT ", "INSERT ", "UPDATE ", "DELETE ", "CREATE ", "BEGIN", "LOCK "];
                if !begins.iter().any(|word| literal.starts_with(word)) {
                    continue;
                }
                seen += 1;
                let upper = literal.to_uppercase();
                let foreign = FOREIGN.iter().find(|word| upper.contains(**word));
                let notifier = name == "wake.rs" && foreign == Some(&"NOTIFY");
                assert!(foreign.is_none() || notifier, "{}: {literal}", path.display());
            }
        }
        assert!(seen > 20, "{seen} statements read");
    }

    #[test]
    fn a_migration_is_translated_word_by_word() {
        let sql = translated("CREATE TABLE t (\n    id TEXT NOT NULL,\n    body BLOB NOT NULL,\n    n BIGINT\n)");
        assert_eq!(
            sql,
            "CREATE TABLE t (\n    id TEXT COLLATE \"C\" NOT NULL,\n    body BYTEA NOT NULL,\n    n BIGINT\n)"
        );
    }
}
