//! What each release from 0.2.0 on left, read and carried on by this build; and the run that leaves it.
//!
//! `tests/fixtures/VERSION` is written once, by `cargo xtask fixtures record` at the cut of that release, and never
//! changed afterwards (docs/decisions/0124). What a test program without servers can hold of it is tested there: frames of
//! the link in tests/tests/simulation/frames.rs, schemas and stored names in tests/tests/architecture/released.rs.
//!
//! ```text
//! wire.txt                   frames that robots and server exchanged
//! protos.binpb               descriptors of every .proto
//! stored_keys.txt            every name in what is kept as text
//! ENGINE/                    sqlite or postgres: a run of its own each
//!   data/                    data directory of server and stop service; databases are SQL text
//!   store.sql                the database, of PostgreSQL alone
//!   rbt-01/ rbt-02/          a robot's folder each
//! ```

mod carried;
mod database;
mod recorded;
mod rows;
mod run;

use anyhow::ensure;
use std::path::{Path, PathBuf};

/// Robots and where they begin.
const ROBOTS: [(&str, &str); 2] = [("rbt-01", "park-1"), ("rbt-02", "park-2")];
/// What is left of a run when the power is gone.
struct Left {
    /// Everything in it: `data` of the server and its stop service, `rbt-01`, `rbt-02`.
    dir: tempfile::TempDir,
    /// Its database, if it is not in `data`.
    database: Option<String>,
}

/// What is behind a store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Engine {
    /// Files in the data directory.
    Sqlite,
    /// A database of a server of its own.
    Postgres,
}

impl Engine {
    /// Its name in paths.
    const fn name(self) -> &'static str {
        match self {
            Self::Sqlite => "sqlite",
            Self::Postgres => "postgres",
        }
    }
}

/// What every release left on an engine. Names that begin with a dot are being made.
fn all(engine: Engine) -> anyhow::Result<Vec<PathBuf>> {
    let under = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures");
    let entries = std::fs::read_dir(&under)?.collect::<Result<Vec<_>, _>>()?;
    let made = entries.iter().filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."));
    let all: Vec<PathBuf> = made.map(|entry| entry.path().join(engine.name())).collect();
    ensure!(!all.is_empty(), "no release is in {}", under.display());
    Ok(all)
}
