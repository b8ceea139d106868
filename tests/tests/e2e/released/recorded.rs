//! This build's own run, held against what must be in it, and written down when a release is cut; and stores of each
//! release, read row by row.

use super::rows::{self, Found};
use super::run;
use super::{Engine, all, database};
use anyhow::{Context, ensure};
use midshift_core::site::{DEMO, text};
use midshift_store::{
    FRAME_BYTES_DEFAULT, HeartbeatLog, PostgresConfig, PostgresFrames, PostgresHeartbeats, PostgresStore, SqliteFrames,
    SqliteStore,
};
use std::path::Path;

/// Where this build's run is to be written down, if it is to be.
const RECORD: &str = "MIDSHIFT_RECORD";
/// What a run on SQLite leaves empty: processes share newest heartbeats there, and one process opens the files. Anything
/// else that is empty fails.
const EMPTY_ON_SQLITE: &str = "robot_last";

/// Opens a store as `serve` does, and reads all of it.
async fn read(data: &Path, database: Option<&str>) -> anyhow::Result<Found> {
    let (clock, site_id) = (midshift_process::clock::clock(1000), text::parse(DEMO)?.site_id().clone());
    let Some(url) = database else {
        let store = SqliteStore::open(data, site_id.clone(), clock.clone()).await?;
        let frames = SqliteFrames::open(data, site_id, clock, FRAME_BYTES_DEFAULT).await?;
        let found = rows::read(&store, &frames, None).await?;
        store.close().await;
        frames.close().await;
        return Ok(found);
    };
    let config = PostgresConfig::new(url);
    let store = PostgresStore::open(&config, site_id.clone(), clock.clone()).await?;
    let frames = PostgresFrames::open(&config, site_id.clone(), clock, FRAME_BYTES_DEFAULT).await?;
    let heard = PostgresHeartbeats::open(&config, site_id).await?;
    let found = rows::read(&store, &frames, Some(&heard as &dyn HeartbeatLog)).await?;
    store.close().await;
    frames.close().await;
    heard.close().await;
    Ok(found)
}

async fn records(engine: Engine) -> anyhow::Result<()> {
    let left = run::run(engine).await?;
    if let Some(to) = std::env::var_os(RECORD) {
        database::write(&left, &Path::new(&to).join(engine.name()))?;
    }
    let found = read(&left.dir.path().join("data"), left.database.as_deref()).await?;
    let empty = found.empty();
    let expected: &[&str] = if engine == Engine::Sqlite { &[EMPTY_ON_SQLITE] } else { &[] };
    ensure!(empty == expected, "empty: {empty:?}, and only {expected:?} may be");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_on_sqlite_leaves_something_of_everything() -> anyhow::Result<()> {
    records(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_on_postgresql_leaves_something_of_everything() -> anyhow::Result<()> {
    records(Engine::Postgres).await
}

async fn read_all(engine: Engine) -> anyhow::Result<()> {
    for from in all(engine)? {
        let dir = tempfile::tempdir()?;
        let database = database::restore(&from, dir.path())?;
        let found = read(&dir.path().join("data"), database.as_deref()).await;
        found.with_context(|| format!("a store of {}", from.display()))?;
    }
    Ok(())
}

#[tokio::test]
async fn every_row_of_a_release_is_read_from_sqlite_and_loses_nothing() -> anyhow::Result<()> {
    read_all(Engine::Sqlite).await
}

#[tokio::test]
async fn every_row_of_a_release_is_read_from_postgresql_and_loses_nothing() -> anyhow::Result<()> {
    read_all(Engine::Postgres).await
}
