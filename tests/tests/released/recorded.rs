//! This build's own run, held against what must be in it, and written down when a release is made.

use crate::plant::Engine;
use crate::run::{self, Left, ROBOTS};
use crate::{frames, stores};
use anyhow::Context;
use midshift_tests::postgres::PostgresServer;
use midshift_tests::released::{self, RECORD, RELEASES, sqlite_text};
use midshift_tests::wire;
use std::fs;
use std::path::{Path, PathBuf};

/// Where this build's run is written down, if it is to be.
fn target(engine: Engine) -> Option<PathBuf> {
    std::env::var_os(RECORD).map(|folder| Path::new(&folder).join(engine.name()))
}

/// Writes down what is left of a run.
fn write(left: &Left, engine: Engine, to: &Path) -> anyhow::Result<()> {
    fs::create_dir_all(to)?;
    match &left.database {
        None => {
            for name in ["control", "telemetry"] {
                let text = sqlite_text(&left.dir.path().join("data").join(format!("{name}.db")))?;
                fs::write(to.join(format!("{name}.sql")), text)?;
            }
        }
        Some(url) => fs::write(to.join("store.sql"), PostgresServer::shared().text(url))?,
    }
    released::copy(&left.dir.path().join("data").join(RELEASES), &to.join(RELEASES))?;
    for (id, _) in ROBOTS {
        released::copy(&left.dir.path().join(id), &to.join("robots").join(id))?;
    }
    if engine == Engine::Sqlite {
        let lines: Vec<String> = wire::kinds(&left.frames)?.iter().map(wire::Frame::line).collect();
        let path = to.parent().context("a folder above")?.join("wire.txt");
        fs::write(path, lines.join("\n") + "\n")?;
    }
    Ok(())
}

async fn records(engine: Engine) -> anyhow::Result<()> {
    let left = run::run(engine).await?;
    let to = target(engine);
    if let Some(to) = &to {
        write(&left, engine, to)?;
    }
    let found = stores::read(&left.dir.path().join("data"), left.database.as_deref()).await?;
    if let Some(to) = &to {
        fs::write(to.join("shapes.txt"), found.shapes.text())?;
    }
    for frame in &left.frames {
        frames::hold(frame)?;
    }
    frames::whole(&left.frames)?;
    stores::whole(&found, engine)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_on_sqlite_leaves_something_of_everything() -> anyhow::Result<()> {
    records(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_run_on_postgresql_leaves_something_of_everything() -> anyhow::Result<()> {
    records(Engine::Postgres).await
}
