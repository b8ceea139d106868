//! Defines a part of a backup: one durable thing of a server, and the facts that parts pass on while they are copied or put back.

use async_trait::async_trait;
use midshift_core::time::Utc;
use midshift_store::{PostgresConfig, PostgresRestore, StoreId};
use std::path::{Path, PathBuf};

/// Name of the part of online keys, and of the folder where they go if nobody says where.
pub const KEYS: &str = "ota-keys";
/// Name of the part of rows in PostgreSQL. A backup without it has rows of SQLite.
pub const POSTGRES: &str = "postgresql";

/// Where a server keeps what is durable.
#[derive(Clone, Debug)]
pub struct Places {
    /// Its data directory.
    pub data: PathBuf,
    /// The folder of its online keys, if it has any.
    pub ota_keys: Option<PathBuf>,
    /// The database of its rows; none: they are files of SQLite in the data directory.
    pub store: Option<PostgresConfig>,
}

/// The facts that copied parts pass on to those after them.
#[derive(Debug, Default)]
pub struct BackupFacts {
    /// Whose the rows are.
    pub site_id: Option<String>,
    /// Whose the folder of releases must be, if the rows are not beside it.
    pub store_id: Option<StoreId>,
    /// So many bundles the rows know, where the folder of releases may be another one.
    pub bundles: u64,
}

/// What is being made of a backup.
pub struct Making {
    /// Where it goes, under names of its own until it is whole.
    pub places: Places,
    /// The store that it becomes.
    pub store_id: StoreId,
    /// The moment of the restore.
    pub now: Utc,
    /// Rows that a database has taken and not committed.
    pub rows: Option<PostgresRestore>,
}

/// A durable thing of a server. `folder` is its own in a backup.
#[async_trait]
pub trait Part: Send + Sync {
    /// Its name, and that of its folder.
    fn name(&self) -> &'static str;
    /// Copies it; false: the server has none.
    async fn copy(&self, from: &Places, folder: &Path, facts: &mut BackupFacts) -> anyhow::Result<bool>;
    /// What is wrong with a copy.
    async fn check(&self, folder: &Path) -> anyhow::Result<Vec<String>>;
    /// Makes it what a server can start from.
    async fn put_back(&self, folder: &Path, to: &mut Making) -> anyhow::Result<()>;
}
