//! The schema as numbered files of one statement each, forward only, the same for every engine.
//!
//! Invariant: a file that has been released never changes; a change of the schema is a new file at the end. What an engine spells
//! otherwise it translates word by word (PostgreSQL: `postgres/migrate.rs`). `golden/*` is what they produce together.

use crate::OpenError;

/// One step.
pub(crate) struct Migration {
    /// File name without `.sql`; begins with its number, which is also its place in the list, from 1.
    pub(crate) name: &'static str,
    pub(crate) sql: &'static str,
}

macro_rules! migrations {
    ($folder:literal: $($name:literal,)*) => {
        &[$(Migration { name: $name, sql: include_str!(concat!("../migrations/", $folder, "/", $name, ".sql")) }),*]
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
    "0063_robot_last_head",
    "0064_robot_last",
    "0065_robot_last_by_position",
    "0066_fleet_leader",
    "0067_ota_leader",
    "0068_ota_command_key",
    "0069_stop_record",
    "0070_stop_event",
    "0071_stop_event_by_subject",
    "0072_token",
    "0073_robot_identity",
    "0074_authority",
    "0075_server_certificate",
    "0076_identity_event",
    "0077_identity_event_by_subject",
    "0078_token_by_ord",
    "0079_audit_head",
    "0080_task_audit",
    "0081_fleet_audit",
    "0082_ota_audit",
    "0083_stop_audit",
    "0084_task_audit_by_ord",
    "0085_fleet_audit_by_ord",
    "0086_ota_audit_by_ord",
    "0087_stop_audit_by_ord",
    "0088_identity_audit",
    "0089_identity_audit_by_ord",
    "0090_token_name",
    "0091_rollout_by_state",
    "0092_rollout_robot_by_state",
    "0093_no_task_event_by_subject",
    "0094_no_fleet_event_by_subject",
    "0095_no_telemetry_event_by_subject",
    "0096_no_ota_event_by_subject",
    "0097_no_stop_event_by_subject",
    "0098_no_identity_event_by_subject",
    "0099_task_event_by_request_key",
    "0100_fleet_event_by_attempt",
    "0101_no_timer_by_ord",
    "0102_no_task_request_by_parent",
    "0103_planner_policy",
    "0104_place_block",
    "0105_task_type",
];

/// Of `telemetry.db`.
pub(crate) const TELEMETRY: &[Migration] = migrations!["telemetry":
    "0001_frame_head",
    "0002_frame_log",
    "0003_frame_mark",
    "0004_gap",
    "0005_gap_by_robot",
    "0006_frame_coarse",
];

/// What a migration run did to one file of SQLite or one schema of PostgreSQL.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Migrated {
    /// `control.db` or `telemetry.db`; `control` or `telemetry` on PostgreSQL.
    pub file: &'static str,
    /// Schema version before; 0 = nothing was there.
    pub from: u32,
    /// Schema version now.
    pub to: u32,
    /// Names of the steps that were applied, in order.
    pub applied: Vec<&'static str>,
}

/// The table that says how far a schema has come.
pub(crate) const SCHEMA_VERSION: &str =
    "CREATE TABLE IF NOT EXISTS schema_version (version BIGINT NOT NULL, name TEXT NOT NULL, UNIQUE (version))";
pub(crate) const VERSION: &str = "SELECT COALESCE(MAX(version), 0) FROM schema_version";
pub(crate) const RAISE_VERSION: &str = "INSERT INTO schema_version (version, name) VALUES ($1, $2)";

/// The migrations that are still to be applied to a schema of version `from`.
pub(crate) fn pending<'m>(
    name: &'static str,
    migrations: &'m [Migration],
    from: u32,
) -> Result<&'m [Migration], OpenError> {
    let known = migrations.len() as u32;
    migrations.get(from as usize..).ok_or(OpenError::NewerSchema { file: name, found: from, known })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

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
