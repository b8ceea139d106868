//! Why a store cannot be opened, on any engine.

use midshift_core::ids::SiteId;
use std::path::PathBuf;

/// Why a store cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The directory or the lock file.
    #[error("{doing} failed")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// What the operating system said.
        #[source]
        source: std::io::Error,
    },
    /// Another server has it.
    #[error("data directory {} is in use by another server; stop it first, or choose another directory", dir.display())]
    Locked {
        /// The directory.
        dir: PathBuf,
    },
    /// The engine failed.
    #[error("{doing} failed")]
    Sql {
        /// What was being done.
        doing: &'static str,
        /// What the database said.
        #[source]
        source: sqlx::Error,
    },
    /// A table could not be copied whole.
    #[error("copying table {table} out of PostgreSQL failed")]
    Table {
        /// Its schema and name.
        table: String,
        /// Why, such as that this user may not read it.
        #[source]
        source: sqlx::Error,
    },
    /// One of the schemas is not there, or nobody has made its tables.
    #[error(
        "the database has no tables of schema {schema}, so a copy of it is not whole: bring it up with midshift migrate --store"
    )]
    NoSchema {
        /// Name of the schema without tables.
        schema: &'static str,
    },
    /// A commit would not be durable.
    #[error("{name} is {found}, must be {expected}: commits would not be durable")]
    NotDurable {
        /// The pragma or setting.
        name: &'static str,
        /// What it must be.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// Written by a newer release.
    #[error("{file} has schema {found}, this release knows {known}: use the newer release")]
    NewerSchema {
        /// The file, or the schema of PostgreSQL.
        file: &'static str,
        /// Its schema version.
        found: u32,
        /// The newest known here.
        known: u32,
    },
    /// It belongs to another site.
    #[error("the store holds site {found}, not {asked}")]
    OtherSite {
        /// Whose it is.
        found: String,
        /// Who asked.
        asked: SiteId,
    },
    /// A server that is not what the store needs.
    #[error("PostgreSQL has {name} {found}, needed is {needed}")]
    Unfit {
        /// What of it.
        name: &'static str,
        /// What is needed.
        needed: &'static str,
        /// What it is.
        found: String,
    },
}
