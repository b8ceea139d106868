//! Stores of each release: opened by this build on both engines, every row read, and held against what that release itself could read.

use crate::plant::Engine;
use anyhow::{Context, ensure};
use midshift_core::site::{DEMO, text};
use midshift_store::{
    FRAME_BYTES_DEFAULT, HeardLog, PostgresConfig, PostgresFrames, PostgresHeard, PostgresStore, SqliteFrames,
    SqliteStore,
};
use midshift_tests::postgres::PostgresServer;
use midshift_tests::released::{Release, sqlite_file};
use midshift_tests::rows::{self, Found};
use midshift_tests::shape::Shapes;
use std::collections::BTreeSet;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;

/// What a run leaves nothing in, and why. Anything else that is empty fails.
pub const EMPTY: &[(&str, &str)] = &[
    (
        "hold_token",
        "a robot's own safety stop makes one, and bodies of agents in processes of their own have none that can be pulled",
    ),
    ("stop_record", "a stop service writes them, and none runs beside the server of a run"),
    ("stop_event", "the same"),
    ("token", "a server without login, as 0.1.0 is, writes none"),
    ("robot_identity", "the same"),
    ("authority", "the same"),
    ("server_certificate", "the same"),
    ("identity_event", "the same"),
];

/// Words of enums that a release does not know and this build may write all the same, with why a process of that release that shares the store does
/// not stumble over it.
const NEW_WORDS: &[(&str, &str)] = &[
    (
        "STOP_ENGAGED",
        "said only while a fleet stop is engaged: a stop service is started when every process of the site knows of it (CHANGELOG)",
    ),
    ("HOLD_BY_STOP", "the same"),
    ("fleet_stop", "said only by robots with a line to a stop service: the same"),
    ("STOPS_FULL", "an answer of the stop service, which writes no row"),
    ("STOP_WAS_RESET", "the same"),
    ("STOP_NOT_FOUND", "an answer of task, which writes no row"),
    ("LINE_REPLACED", "the same"),
    ("LINE_HELD", "the same"),
    ("TOO_MANY_REQUESTS", "an answer of a port, which writes no row"),
    ("SIGN_IN_NEEDED", "an answer of a port or of identity, which writes no row"),
    ("TOKEN_UNKNOWN", "the same"),
    ("TOKEN_EXPIRED", "the same"),
    ("NOT_PERMITTED", "the same"),
    ("NOT_THIS_ROBOT", "the same"),
    ("NOT_YOUR_OWN", "the same"),
    ("ROBOT_ENROLLED", "the same"),
    ("ENROLMENT_UNKNOWN", "the same"),
    ("ENROLMENT_USED", "the same"),
    ("ENROLMENT_EXPIRED", "the same"),
    ("KEY_DENIED", "the same"),
    ("TOKEN_NOT_FOUND", "the same"),
    ("LAST_ADMIN", "the same"),
];

/// The store of a release as a database that this build may open: a folder of `data`, or a database.
pub fn restore(release: &Release, engine: Engine, data: &Path) -> anyhow::Result<Option<String>> {
    let from = release.engine(engine.name());
    if engine == Engine::Postgres {
        let server = PostgresServer::shared();
        let url = server.database();
        server.load(&url, &from.join("store.sql"));
        return Ok(Some(url));
    }
    // As `serve` makes it.
    std::fs::DirBuilder::new().recursive(true).mode(0o700).create(data)?;
    for name in ["control", "telemetry"] {
        let text = std::fs::read_to_string(from.join(format!("{name}.sql")))?;
        sqlite_file(&text, &data.join(format!("{name}.db")))?;
    }
    Ok(None)
}

/// Opens a store as `serve` does, and reads all of it.
pub async fn read(data: &Path, database: Option<&str>) -> anyhow::Result<Found> {
    let (clock, site_id) = (midshift::clock::clock(1000), text::parse(DEMO)?.site_id().clone());
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
    let heard = PostgresHeard::open(&config, site_id).await?;
    let found = rows::read(&store, &frames, Some(&heard as &dyn HeardLog)).await?;
    store.close().await;
    frames.close().await;
    heard.close().await;
    Ok(found)
}

/// Whether everything has something in it, but what is listed.
pub fn whole(found: &Found, engine: Engine) -> anyhow::Result<()> {
    let mut listed: BTreeSet<&str> = EMPTY.iter().map(|(name, _)| *name).collect();
    if engine == Engine::Sqlite {
        // One process opens the files: its own board is the whole truth (docs/rows.md).
        listed.insert("robot_last");
    }
    let empty: BTreeSet<&str> = found.empty().into_iter().collect();
    ensure!(empty == listed, "empty: {empty:?}, listed as empty: {listed:?}");
    Ok(())
}

async fn open_all(engine: Engine) -> anyhow::Result<()> {
    for release in Release::all()? {
        let dir = tempfile::tempdir()?;
        let database = restore(&release, engine, dir.path())?;
        let found = read(dir.path(), database.as_deref()).await;
        let found = found.with_context(|| format!("a store of {}", release.folder.display()))?;
        // What that release had something in and is empty now is gone, and said below; what came later is not asked for.
        let known = Shapes::parse(&release.text(&format!("{}/shapes.txt", engine.name()))?);
        let broken = unreadable(&known, &found.shapes);
        assert!(broken.is_empty(), "{} could not read what this build writes: {broken:#?}", release.folder.display());
    }
    Ok(())
}

/// What a reader that knows `known` stumbles over in rows of a writer that knows `now`: a field that is gone, a word that is new. A field that is
/// new it passes over.
fn unreadable(known: &Shapes, now: &Shapes) -> Vec<String> {
    let mut broken = Vec::new();
    for (at, before) in &known.0 {
        let Some(after) = now.0.get(at) else {
            broken.push(format!("{at} is gone"));
            continue;
        };
        broken.extend(before.difference(after).map(|gone| format!("{at}: {gone} is gone")));
        if at.ends_with(":words") {
            let is_listed = |word: &&String| NEW_WORDS.iter().any(|(new, _)| new == word);
            let new = after.difference(before).filter(|word| !is_listed(word));
            broken.extend(new.map(|word| format!("{at}: {word} is new")));
        }
    }
    broken
}

#[tokio::test(flavor = "multi_thread")]
async fn every_row_of_a_release_is_read_from_sqlite_and_loses_nothing() -> anyhow::Result<()> {
    open_all(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread")]
async fn every_row_of_a_release_is_read_from_postgresql_and_loses_nothing() -> anyhow::Result<()> {
    open_all(Engine::Postgres).await
}

#[test]
fn an_older_reader_misses_a_field_and_does_not_know_a_word() {
    let known = Shapes::parse("t:fields a b\nt.a:words x y\n");
    let broken = |now: &str| unreadable(&known, &Shapes::parse(now));
    assert_eq!(broken("t:fields a b c\nt.a:words x y\nt.c:words z\n"), Vec::<String>::new());
    assert_eq!(broken("t:fields a c\nt.a:words x y\n"), ["t:fields: b is gone"]);
    assert_eq!(broken("t:fields a b\nt.a:words x y z\n"), ["t.a:words: z is new"]);
    assert_eq!(broken("t:fields a b\nt.a:words x\n"), ["t.a:words: y is gone"]);
    assert_eq!(broken("t:fields a b\n"), ["t.a:words is gone"]);
}
