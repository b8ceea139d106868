//! What a copy of a database holds, and where its files are.

use super::tables::TableShape;
use crate::migrations::{CONTROL, Migration, TELEMETRY};
use crate::postgres::connect::{CONTROL_SCHEMA, TELEMETRY_SCHEMA};
use midshift_core::rows::Seq;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Both schemas with what makes them.
pub(super) const SCHEMAS: [(&str, &[Migration]); 2] = [(CONTROL_SCHEMA, CONTROL), (TELEMETRY_SCHEMA, TELEMETRY)];
/// Longest wait for the server to say or take anything, also for a lock that others have, before a copy is given up.
pub(super) const PATIENCE: Duration = Duration::from_secs(600);

/// What a copy of a database holds. Its files are beside it, at SCHEMA/TABLE.copy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PostgresCopy {
    /// Whose rows these are.
    pub site_id: String,
    /// Id of the store that it is a copy of.
    pub store_id: String,
    /// Newest number of the feed.
    pub head: Seq,
    /// Both schemas, by name.
    pub schemas: BTreeMap<String, CopiedSchema>,
}

/// One schema of a copy.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CopiedSchema {
    /// How many migrations made it.
    pub version: u32,
    /// How many rows each table had.
    pub tables: BTreeMap<String, u64>,
}

impl CopiedSchema {
    /// Nobody had made its tables.
    pub(super) const fn is_unmade(&self) -> bool {
        self.version == 0
    }
}

impl PostgresCopy {
    /// How many rows a table of schema `control` had; none: there was no such table.
    pub fn rows(&self, table: &str) -> Option<u64> {
        self.schemas.get(CONTROL_SCHEMA)?.tables.get(table).copied()
    }

    pub(super) fn version(&self, schema: &str) -> u32 {
        self.schemas.get(schema).map_or(0, |copied| copied.version)
    }
}

/// Where a table's rows are in a copy.
pub(super) fn file(folder: &Path, table: &TableShape) -> PathBuf {
    folder.join(table.schema).join(format!("{}.copy", table.name))
}
