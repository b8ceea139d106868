//! Copies of a database while servers use it, and a database made of a copy: one file for each table, in PostgreSQL's binary format.
//!
//! Invariant: a copy is one moment of both schemas. What is restored is committed in one transaction, into a database that has no row of
//! midshift, or it is not there; and it is a store of its own, see [`PostgresRestore`]. What a file of a copy may hold is what the
//! migrations make, never what the copy says of itself.

mod check;
mod copy_in;
mod copy_out;
mod tables;

pub use copy_in::{PostgresRestore, RestoreError};

use super::{CONTROL_SCHEMA, TELEMETRY_SCHEMA};
use crate::migrations::{CONTROL, Migration, TELEMETRY};
use midshift_core::rows::Seq;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;
use tables::TableShape;

/// Both schemas with what makes them.
const SCHEMAS: [(&str, &[Migration]); 2] = [(CONTROL_SCHEMA, CONTROL), (TELEMETRY_SCHEMA, TELEMETRY)];
/// Longest wait for the server to say or take anything, also for a lock that others have, before a copy is given up.
const PATIENCE: Duration = Duration::from_secs(600);

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
    const fn is_unmade(&self) -> bool {
        self.version == 0
    }
}

impl PostgresCopy {
    /// How many rows a table of schema `control` had; none: there was no such table.
    pub fn rows(&self, table: &str) -> Option<u64> {
        self.schemas.get(CONTROL_SCHEMA)?.tables.get(table).copied()
    }

    fn version(&self, schema: &str) -> u32 {
        self.schemas.get(schema).map_or(0, |copied| copied.version)
    }
}

/// Where a table's rows are in a copy.
fn file(folder: &Path, table: &TableShape) -> PathBuf {
    folder.join(table.schema).join(format!("{}.copy", table.name))
}
