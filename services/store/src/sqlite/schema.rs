//! Forward-only migrations of the SQLite files: numbered files of one statement each.
//!
//! Invariant: a file that has been released never changes; a change of the schema is a new file at the end. All pending
//! migrations of a file are applied in one transaction, and a schema newer than this binary is refused, never guessed at.
//! `golden/*.sql` is what they produce together.

use super::OpenError;
use sqlx::{AssertSqlSafe, Connection, Row, SqliteConnection};

/// One step.
pub(crate) struct Migration {
    /// File name without `.sql`; begins with its number, which is also its place in the list, from 1.
    pub(crate) name: &'static str,
    sql: &'static str,
}

macro_rules! migrations {
    ($folder:literal: $($name:literal,)*) => {
        &[$(Migration { name: $name, sql: include_str!(concat!("../../migrations/", $folder, "/", $name, ".sql")) }),*]
    };
}

/// Of `control.db`.
pub(crate) const CONTROL: &[Migration] = migrations!["control":
    "0001_store_head",
    "0002_log_mark",
    "0003_task_intake",
    "0004_task_request",
    "0005_request_key",
    "0006_task_state",
    "0007_attempt",
    "0008_timer",
    "0009_hold_token",
    "0010_place_grant",
    "0011_robot_authority",
    "0012_robot_control",
    "0013_robot_counter",
    "0014_site",
    "0015_area_policy",
    "0016_desired_work",
    "0017_desired_policy",
    "0018_service_clock",
    "0019_fleet_mark",
    "0020_incident",
    "0021_session",
    "0022_presence",
    "0023_lane_mark",
    "0024_task_event",
    "0025_fleet_event",
    "0026_telemetry_event",
    "0027_robot_inbox",
    "0028_task_event_by_subject",
    "0029_fleet_event_by_subject",
    "0030_telemetry_event_by_subject",
    "0031_robot_inbox_by_subject",
    "0032_task_intake_by_ord",
    "0033_task_request_by_parent",
    "0034_task_request_by_ord",
    "0035_request_key_by_ord",
    "0036_task_state_by_state",
    "0037_task_state_by_parent",
    "0038_task_state_by_ord",
    "0039_attempt_by_parent",
    "0040_attempt_by_state",
    "0041_timer_by_ord",
    "0042_incident_by_state",
    "0043_incident_by_ord",
    "0044_command_key",
    "0045_drain",
    "0046_bundle",
    "0047_rollout",
    "0048_rollout_robot",
    "0049_drain_request",
    "0050_drain_release",
    "0051_desired_update",
    "0052_robot_software",
    "0053_quarantine",
    "0054_area_bundle",
    "0055_ota_mark",
    "0056_ota_clock",
    "0057_area_budget",
    "0058_ota_event",
    "0059_ota_event_by_subject",
    "0060_rollout_robot_by_parent",
    "0061_rollout_by_ord",
    "0062_bundle_by_ord",
];

/// Of `telemetry.db`.
pub(crate) const TELEMETRY: &[Migration] = migrations!["telemetry":
    "0001_frame_head",
    "0002_frame_log",
    "0003_frame_mark",
    "0004_gap",
    "0005_gap_by_robot",
];

/// What a migration run did to one file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Migrated {
    /// `control.db` or `telemetry.db`.
    pub file: &'static str,
    /// Schema version before; 0 = an empty file.
    pub from: u32,
    /// Schema version now.
    pub to: u32,
    /// Names of the steps that were applied, in order.
    pub applied: Vec<&'static str>,
}

/// Brings one file up to this binary's schema. Applying twice is a no-op.
pub(crate) async fn apply(
    connection: &mut SqliteConnection,
    file: &'static str,
    migrations: &[Migration],
) -> Result<Migrated, OpenError> {
    let sql = |source| OpenError::Sql { doing: "migrating the schema", source };
    let mut transaction = connection.begin_with("BEGIN IMMEDIATE").await.map_err(sql)?;
    sqlx::query(
        "CREATE TABLE IF NOT EXISTS schema_version (version BIGINT NOT NULL, name TEXT NOT NULL, UNIQUE (version))",
    )
    .execute(&mut *transaction)
    .await
    .map_err(sql)?;
    let row = sqlx::query("SELECT COALESCE(MAX(version), 0) FROM schema_version").fetch_one(&mut *transaction).await;
    let from = row.and_then(|row| row.try_get::<i64, _>(0)).map_err(sql)? as u32;
    let known = migrations.len() as u32;
    if from > known {
        return Err(OpenError::NewerSchema { file, found: from, known });
    }
    let pending = &migrations[from as usize..];
    for (version, migration) in (i64::from(from) + 1..).zip(pending) {
        sqlx::query(AssertSqlSafe(migration.sql)).execute(&mut *transaction).await.map_err(sql)?;
        sqlx::query("INSERT INTO schema_version (version, name) VALUES ($1, $2)")
            .bind(version)
            .bind(migration.name)
            .execute(&mut *transaction)
            .await
            .map_err(sql)?;
    }
    transaction.commit().await.map_err(sql)?;
    Ok(Migrated { file, from, to: known, applied: pending.iter().map(|m| m.name).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
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
        assert!(matches!(older, Err(OpenError::NewerSchema { found: 5, known: 2, .. })), "{older:?}");
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

    #[test]
    fn every_file_is_listed_under_its_number_and_holds_one_statement() {
        for (folder, migrations) in [("control", CONTROL), ("telemetry", TELEMETRY)] {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations").join(folder);
            let files = std::fs::read_dir(path).expect("the folder").map(|f| f.expect("a file").file_name());
            let mut files: Vec<String> = files.map(|f| f.to_string_lossy().into_owned()).collect();
            files.sort();
            let listed: Vec<String> = migrations.iter().map(|m| format!("{}.sql", m.name)).collect();
            assert_eq!(files, listed);
            for (number, migration) in (1..).zip(migrations) {
                assert!(migration.name.starts_with(&format!("{number:04}_")), "{}", migration.name);
                assert!(!migration.sql.contains(';'), "{}", migration.name);
            }
        }
    }
}
