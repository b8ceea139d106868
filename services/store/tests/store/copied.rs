//! Copies of a database while servers write, and databases made of them.

use crate::server::PostgresServer;
use crate::support::{at, clock, database, number, one, postgres_at, put, say, site, stranger, until_a_writer_waits};
use midshift_core::ids::RobotId;
use midshift_core::item::Expect;
use midshift_core::rows::{Key, Log, Seq, Table, Writer};
use midshift_store::{
    CommitError, Frame, FrameLog, Gap, HeartbeatLog, OpenError, PostgresConfig, PostgresCopy, PostgresFrames,
    PostgresHeartbeats, PostgresRestore, RestoreError, Store, StoreId, StoredHeartbeat, migrate_postgres,
};
use sqlx::{AssertSqlSafe, PgConnection, Row};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tempfile::TempDir;

/// A database without anything in it.
pub fn fresh() -> PostgresConfig {
    PostgresConfig::new(PostgresServer::shared().database())
}

pub async fn taken(config: &PostgresConfig) -> (TempDir, PostgresCopy) {
    let dir = tempfile::tempdir().unwrap();
    let copy = PostgresCopy::begin(config, dir.path()).await.unwrap().expect("a store");
    (dir, copy)
}

pub async fn restored(config: &PostgresConfig, folder: &Path, copy: &PostgresCopy) -> Result<StoreId, RestoreError> {
    let id = StoreId::fresh();
    PostgresRestore::begin(config, folder, copy, &id).await?.commit().await?;
    Ok(id)
}

/// Names of the tables of both schemas.
async fn tables(connection: &mut PgConnection) -> Vec<String> {
    let select = "SELECT table_schema || '.' || table_name FROM information_schema.tables \
                  WHERE table_schema IN ('control', 'telemetry') ORDER BY 1";
    let rows = sqlx::query(select).fetch_all(connection).await.unwrap();
    rows.iter().map(|row| row.get(0)).collect()
}

/// Every row of every table, as text.
pub async fn all(config: &PostgresConfig) -> BTreeMap<String, Vec<String>> {
    let mut connection = stranger(config).await;
    let mut found = BTreeMap::new();
    for table in tables(&mut connection).await {
        let select = AssertSqlSafe(format!("SELECT row::text FROM {table} AS row ORDER BY 1"));
        let rows = sqlx::query(select).fetch_all(&mut connection).await.unwrap();
        found.insert(table, rows.iter().map(|row| row.get(0)).collect());
    }
    found
}

fn robot() -> RobotId {
    RobotId::parse("r-1").unwrap()
}

fn frame(seq: u64) -> Frame {
    let bytes: Vec<u8> = (0..=255).collect();
    Frame { robot_id: robot(), ring: Arc::from("ring"), first_seq: seq, last_seq: seq, bytes: bytes.into() }
}

async fn frames(config: &PostgresConfig) -> PostgresFrames {
    PostgresFrames::open(config, site(), clock(), 1 << 30).await.unwrap()
}

/// A database in which every kind of row stands, and entries of a row that is gone.
pub async fn used() -> PostgresConfig {
    let config = database().await;
    let store = postgres_at(&config).await;
    let odd = "{\"text\":\"\\\\N\\t tab, line\\n, ünïcode 🤖, \\\\u0000\"}";
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, odd)]).await.unwrap();
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "b", Expect::Absent, "{}")]).await.unwrap();
    let mut gone = put(Table::Attempt, "b", at(1), "{}");
    gone.write = midshift_core::item::Write::Delete;
    one(&store, Writer::Fleet, vec![gone]).await.unwrap();
    one(&store, Writer::Telemetry, vec![put(Table::Presence, "r-1", Expect::Absent, "{}")]).await.unwrap();
    let frames = frames(&config).await;
    frames.append(vec![frame(1)]).await.unwrap();
    let [ring, lane, reason] = ["ring", "status", "DROPPED"].map(Arc::from);
    frames
        .report_gaps(vec![Gap { robot_id: robot(), ring, lane, from_seq: 1, to_seq: 2, reason, at_unix_ms: 3 }])
        .await
        .unwrap();
    let heard = StoredHeartbeat { robot_id: robot(), session_epoch: 1, hb: 2, body: Arc::from("{}") };
    PostgresHeartbeats::open(&config, site()).await.unwrap().save_newest(vec![heard]).await.unwrap();
    config
}

#[tokio::test]
async fn a_database_made_of_a_copy_has_the_same_rows_and_goes_on_above_them_as_another_store() {
    let config = used().await;
    let (dir, copy) = taken(&config).await;
    assert_eq!(copy.check(dir.path()), Vec::<String>::new());
    let to = fresh();
    let id = restored(&to, dir.path(), &copy).await.unwrap();
    let (mut before, mut after) = (all(&config).await, all(&to).await);
    let heads = [&mut before, &mut after].map(|tables| tables.remove("control.store_head").unwrap());
    assert_eq!(before, after);
    assert!(before.values().filter(|rows| !rows.is_empty()).count() >= 10, "there is something to compare");
    assert_eq!(heads[0][0].replace(&copy.store_id, &id.0), heads[1][0], "all but its id");
    assert_ne!(*id.0, *copy.store_id);

    let store = postgres_at(&to).await;
    assert_eq!(*store.id(), id);
    let head = postgres_at(&config).await.snapshot(&[]).await.unwrap().seq;
    let applied = one(&store, Writer::Fleet, vec![put(Table::Attempt, "c", Expect::Absent, "{}")]).await.unwrap();
    assert_eq!((copy.head, applied.seq), (head, Seq(head.0 + 1)));
    let (frames, first) = (frames(&to).await, 1);
    frames.append(vec![frame(2)]).await.unwrap();
    let positions: Vec<u64> = frames.read(0, 1 << 20).await.unwrap().iter().map(|f| f.position).collect();
    assert_eq!(positions, [first, first + 1]);
    let heard = PostgresHeartbeats::open(&to, site()).await.unwrap();
    let position = heard.position().await.unwrap();
    heard
        .save_newest(vec![StoredHeartbeat { robot_id: robot(), session_epoch: 1, hb: 3, body: Arc::from("{}") }])
        .await
        .unwrap();
    assert_eq!((position, heard.position().await.unwrap()), (1, 2));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_copy_is_one_moment_of_both_schemas_while_servers_write() {
    let config = database().await;
    let store = Arc::new(postgres_at(&config).await);
    let frames = frames(&config).await;
    frames.append(vec![frame(1)]).await.unwrap();
    let begun = Arc::new(AtomicU64::new(0));
    let (counter, writer) = (begun.clone(), store.clone());
    // Two rows that always say the same, written in one item.
    let writing = tokio::spawn(async move {
        for n in 0.. {
            let expect = if n == 0 { Expect::Absent } else { at(n) };
            let pair = [Table::Attempt, Table::ServiceClock].map(|table| put(table, "pair", expect, &n.to_string()));
            one(&*writer, Writer::Fleet, pair.to_vec()).await.unwrap();
            counter.store(n + 1, Ordering::SeqCst);
        }
    });
    while begun.load(Ordering::SeqCst) < 5 {
        tokio::task::yield_now().await;
    }
    // The copy has rows of control and waits for telemetry.
    let mut other = stranger(&config).await;
    say(&mut other, "BEGIN; LOCK TABLE telemetry.frame_head IN ACCESS EXCLUSIVE MODE").await;
    let copied = config.clone();
    let copying = tokio::spawn(async move { taken(&copied).await });
    until_a_writer_waits(&mut stranger(&config).await).await;
    let at_the_lock = begun.load(Ordering::SeqCst);
    while begun.load(Ordering::SeqCst) < at_the_lock + 5 {
        tokio::task::yield_now().await;
    }
    say(&mut other, "UPDATE telemetry.frame_mark SET seq = 9").await;
    say(&mut other, "COMMIT").await;
    let (dir, copy) = copying.await.unwrap();
    writing.abort();
    assert_eq!(copy.check(dir.path()), Vec::<String>::new());
    let to = fresh();
    restored(&to, dir.path(), &copy).await.unwrap();
    let restored = postgres_at(&to).await;
    let rows = restored.snapshot(&[Table::Attempt, Table::ServiceClock]).await.unwrap();
    assert_eq!((rows.rows.len(), rows.seq), (2, copy.head));
    assert_eq!((&rows.rows[0].body, rows.rows[0].revision), (&rows.rows[1].body, rows.rows[1].revision));
    let times = rows.rows[0].revision.0;
    assert!(times <= at_the_lock + 1, "{times} of {at_the_lock}: nothing of what came while it waited");
    let page = restored.feed(Seq(copy.head.0 - 2 * times), &[Log::Fleet], 5_000).await.unwrap();
    let numbers: Vec<u64> = page.entries.iter().map(|entry| entry.seq.0).collect();
    assert_eq!(numbers, (copy.head.0 + 1 - 2 * times..=copy.head.0).collect::<Vec<_>>(), "every entry up to its head");
    let mark = number(&mut stranger(&to).await, "SELECT seq FROM telemetry.frame_mark").await;
    assert_eq!(mark, 1, "telemetry is of the same moment");
}

#[tokio::test]
async fn a_restore_goes_into_a_database_without_rows_only() {
    let (dir, copy) = taken(&used().await).await;
    let full = used().await;
    let before = all(&full).await;
    let refused = restored(&full, dir.path(), &copy).await.unwrap_err();
    assert!(matches!(&refused, RestoreError::NotEmpty { table } if table == "telemetry.frame_head"), "{refused:?}");
    assert_eq!(all(&full).await, before);
    // One that a server only began.
    let begun = fresh();
    drop(postgres_at(&begun).await);
    let refused = restored(&begun, dir.path(), &copy).await.unwrap_err();
    assert!(matches!(&refused, RestoreError::NotEmpty { table } if table == "control.store_head"), "{refused:?}");
    restored(&database().await, dir.path(), &copy).await.expect("tables without rows");
}

/// Takes the newest migrations of a database back.
async fn aged(config: &PostgresConfig) {
    let mut other = stranger(config).await;
    let tables = "DROP TABLE fleet_leader, ota_leader, ota_command_key";
    say(&mut other, &format!("{tables}; DELETE FROM schema_version WHERE version > 65")).await;
}

#[tokio::test]
async fn an_older_copy_is_brought_up_and_a_newer_one_is_refused() {
    let config = used().await;
    aged(&config).await;
    let (dir, mut copy) = taken(&config).await;
    assert_eq!((copy.schemas["control"].version, copy.check(dir.path())), (65, vec![]));
    let to = fresh();
    restored(&to, dir.path(), &copy).await.unwrap();
    let again = migrate_postgres(&to).await.unwrap();
    assert!(again.iter().all(|schema| schema.applied.is_empty()), "{again:?}");
    assert_eq!(postgres_at(&to).await.get(vec![Key::new(Table::Attempt, "a")]).await.unwrap().len(), 1);
    let refused = restored(&database().await, dir.path(), &copy).await.unwrap_err();
    assert!(matches!(refused, RestoreError::OtherSchema { found: 66.., backup: 65, .. }), "{refused:?}");
    copy.schemas.get_mut("control").unwrap().version = 9_999;
    let wrong = copy.check(dir.path());
    assert!(wrong.iter().any(|text| text.contains("use the newer release")), "{wrong:?}");
    let refused = restored(&fresh(), dir.path(), &copy).await.unwrap_err();
    assert!(matches!(refused, RestoreError::Open(OpenError::NewerSchema { found: 9_999, .. })), "{refused:?}");
}

#[tokio::test]
async fn a_database_that_no_server_ever_served_from_has_no_copy() {
    let dir = tempfile::tempdir().unwrap();
    for config in [fresh(), database().await] {
        assert_eq!(PostgresCopy::begin(&config, dir.path()).await.unwrap(), None);
    }
}

#[tokio::test]
async fn a_process_of_a_lost_database_does_not_go_on_in_the_restored_one() {
    let server = PostgresServer::shared();
    let config = PostgresConfig::new(server.database_named("lost"));
    let store = postgres_at(&config).await;
    drop(frames(&config).await);
    let (dir, copy) = taken(&config).await;
    server.emptied("lost");
    restored(&config, dir.path(), &copy).await.unwrap();
    for _ in 0..3 {
        let refused = one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await;
        assert!(matches!(refused, Err(CommitError::Unavailable(_) | CommitError::Unknown(_))), "{refused:?}");
    }
    assert!(postgres_at(&config).await.get(vec![Key::new(Table::Attempt, "a")]).await.unwrap().is_empty());
}
