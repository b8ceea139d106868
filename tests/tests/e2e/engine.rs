//! What is behind the store of servers in these tests: files of SQLite, or PostgreSQL where `MIDSHIFT_TEST_ENGINE=postgres`.
//!
//! Invariant: each server has a database of its own and keeps it over restarts; all are on one PostgreSQL server, which ends with this
//! program. Which tests run so in the suite, and why, is said by name in xtask/src/engine.rs.

use anyhow::bail;
use midshift_tests::postgres::PostgresServer;

/// What says so.
const VARIABLE: &str = "MIDSHIFT_TEST_ENGINE";

/// Flags of `serve` for a store that nobody has used.
pub fn fresh_store() -> anyhow::Result<Vec<String>> {
    match std::env::var(VARIABLE).as_deref() {
        Err(std::env::VarError::NotPresent) | Ok("sqlite") => Ok(Vec::new()),
        Ok("postgres") => Ok(vec!["--store".to_owned(), PostgresServer::shared().database()]),
        other => bail!("{VARIABLE} is {other:?}: say sqlite or postgres"),
    }
}
