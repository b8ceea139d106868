//! Copies that are not whole, and restores that end in the middle.

use crate::copied::{all, fresh, restored, taken, used};
use crate::server::PostgresServer;
use crate::support::{database, number, postgres_at, say, stranger, until_a_writer_waits};
use midshift_core::rows::{Seq, Table};
use midshift_store::{OpenError, PostgresConfig, PostgresCopy, RestoreError, Store};
use std::fs;

/// Where the first row of a file begins.
const HEADER_BYTES: usize = 19;

async fn has_nothing(config: &PostgresConfig) -> bool {
    all(config).await.iter().all(|(table, rows)| table.ends_with(".schema_version") || rows.is_empty())
}

#[tokio::test]
async fn every_file_that_is_not_what_was_copied_is_named_and_nothing_is_made_of_it() {
    let (dir, copy) = taken(&used().await).await;
    let path = dir.path().join("control/attempt.copy");
    let whole = fs::read(&path).unwrap();
    let cut = |at: usize| whole[..at].to_vec();
    let flipped = |at: usize| {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x80;
        bytes
    };
    let longer: Vec<u8> = whole.iter().copied().chain([0]).collect();
    // After the header: 7 columns, 5 bytes of site, its id of 1 byte, 8 of its revision.
    let id = HEADER_BYTES + 2 + 4 + 5 + 4;
    let spoils = [
        (cut(0), "it is no copy of PostgreSQL"),
        (cut(HEADER_BYTES), "it ends before row 1"),
        (cut(whole.len() - 2), "it ends before row 2"),
        (cut(id), "row 1, column id: the file ends"),
        (flipped(0), "it is no copy of PostgreSQL"),
        (flipped(HEADER_BYTES), "columns, not 7"),
        (flipped(id), "column id: it is no UTF-8"),
        (flipped(id - 4), "column id: its length is negative"),
        (longer, "something is behind its end"),
    ];
    let database = fresh();
    for (bytes, told) in spoils {
        fs::write(&path, &bytes).unwrap();
        let wrong = copy.check(dir.path());
        assert!(wrong.len() == 1 && wrong[0].contains(told), "{told}: {wrong:?}");
        assert!(wrong[0].starts_with("control.attempt"), "{wrong:?}");
        // Without its end a file still has all rows: only its reader sees that.
        if told != "it ends before row 2" {
            let refused = restored(&database, dir.path(), &copy).await.unwrap_err();
            assert!(matches!(refused, RestoreError::Open(_) | RestoreError::Rows { .. }), "{refused:?}");
        }
    }
    assert!(has_nothing(&database).await);
    fs::write(&path, &whole).unwrap();
    // All at once, each is named.
    fs::write(dir.path().join("control/presence.copy"), cut(1)).unwrap();
    fs::remove_file(dir.path().join("telemetry/frame_log.copy")).unwrap();
    let mut other = copy.clone();
    let tables = &mut other.schemas.get_mut("control").unwrap().tables;
    tables.insert("attempt".to_owned(), 9);
    tables.insert("of_nobody".to_owned(), 1);
    tables.remove("timer");
    let wrong = other.check(dir.path());
    let told = [
        "no table of_nobody",
        "control.attempt has 1 rows, 9",
        "control.timer was not",
        "control.presence: ",
        "telemetry.frame_log: ",
    ];
    assert_eq!(wrong.len(), told.len(), "{wrong:?}");
    assert!(told.iter().all(|told| wrong.iter().any(|text| text.contains(told))), "{wrong:?}");
}

#[tokio::test]
async fn a_copy_whose_counts_or_numbers_do_not_hang_together_is_refused() {
    let config = used().await;
    let (dir, mut copy) = taken(&config).await;
    copy.schemas.get_mut("control").unwrap().tables.insert("attempt".to_owned(), 2);
    let database = fresh();
    let refused = restored(&database, dir.path(), &copy).await.unwrap_err();
    assert!(matches!(refused, RestoreError::Rows { copied: 2, found: 1, .. }), "{refused:?}");
    assert!(has_nothing(&database).await);
    let mut other = stranger(&config).await;
    say(&mut other, "UPDATE store_head SET seq = 5; UPDATE telemetry.frame_head SET marked_position = 0").await;
    say(&mut other, "UPDATE robot_last_head SET position = 0").await;
    let (dir, mut copy) = taken(&config).await;
    let wrong = copy.check(dir.path());
    let told = [
        "control.fleet_event has number",
        "control.telemetry_event has number",
        "control.robot_last has number 1",
        "telemetry.frame_log has number 1",
    ];
    assert_eq!(wrong.len(), told.len(), "{wrong:?}");
    assert!(told.iter().all(|told| wrong.iter().any(|text| text.contains(told))), "{wrong:?}");
    copy.head = Seq(6);
    assert!(copy.check(dir.path()).iter().any(|text| text.contains("store_head is not the one row at 6")));
}

#[tokio::test]
async fn a_restore_that_ends_in_the_middle_leaves_nothing_and_is_done_again() {
    let (dir, copy) = taken(&used().await).await;
    let config = database().await;
    let mut other = stranger(&config).await;
    say(&mut other, "BEGIN; LOCK TABLE timer IN SHARE MODE").await;
    let (folder, to, of) = (dir.path().to_owned(), config.clone(), copy.clone());
    let restoring = tokio::spawn(async move { restored(&to, &folder, &of).await });
    until_a_writer_waits(&mut stranger(&config).await).await;
    restoring.abort();
    assert!(restoring.await.unwrap_err().is_cancelled(), "the fault happened");
    say(&mut other, "COMMIT").await;
    // A server that starts meanwhile waits until nothing of it is left, and so does the next restore.
    restored(&config, dir.path(), &copy).await.expect("as if there had been none");
    let rows = postgres_at(&config).await.snapshot(&[Table::Attempt]).await.unwrap();
    assert_eq!(rows.rows.len(), 1);
}

#[tokio::test]
async fn a_commit_that_the_database_refuses_leaves_it_as_it_was() {
    let (dir, copy) = taken(&used().await).await;
    let config = database().await;
    let mut other = stranger(&config).await;
    let refuse = "CREATE FUNCTION refuse() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN RAISE 'no'; END $$";
    let at_commit = "CREATE CONSTRAINT TRIGGER refuse AFTER INSERT ON store_head DEFERRABLE INITIALLY DEFERRED \
                     FOR EACH ROW EXECUTE FUNCTION refuse()";
    say(&mut other, refuse).await;
    say(&mut other, at_commit).await;
    let refused = restored(&config, dir.path(), &copy).await.unwrap_err();
    assert!(matches!(refused, RestoreError::Open(_)), "{refused:?}");
    assert!(has_nothing(&config).await);
}

#[tokio::test]
async fn a_commit_without_an_answer_is_told_as_unknown() {
    let (dir, copy) = taken(&used().await).await;
    let config = database().await;
    let mut other = stranger(&config).await;
    let end = "CREATE FUNCTION die() RETURNS trigger LANGUAGE plpgsql AS \
               $$ BEGIN PERFORM pg_terminate_backend(pg_backend_pid()); RETURN NULL; END $$";
    let at_commit = "CREATE CONSTRAINT TRIGGER die AFTER INSERT ON store_head DEFERRABLE INITIALLY DEFERRED \
                     FOR EACH ROW EXECUTE FUNCTION die()";
    say(&mut other, end).await;
    say(&mut other, at_commit).await;
    let refused = restored(&config, dir.path(), &copy).await.unwrap_err();
    assert!(matches!(refused, RestoreError::Unknown(_)), "{refused:?}");
    assert!(PostgresServer::shared().log().contains("terminating connection due to administrator command"));
}

#[tokio::test]
async fn a_table_that_the_user_may_not_read_whole_is_named_and_not_left_out() {
    let config = used().await;
    let mut owner = stranger(&config).await;
    let name: String = sqlx::query_scalar("SELECT current_database()").fetch_one(&mut owner).await.unwrap();
    let reader = PostgresConfig::new(config.url.replacen("//postgres:", &format!("//reader_of_{name}:"), 1));
    let steps = [
        (
            "CREATE ROLE {} LOGIN; GRANT USAGE ON SCHEMA control TO {}; GRANT SELECT ON ALL TABLES IN SCHEMA control TO {}",
            Some("telemetry.schema_version"),
        ),
        (
            "GRANT USAGE ON SCHEMA telemetry TO {}; GRANT SELECT ON ALL TABLES IN SCHEMA telemetry TO {}; \
             REVOKE SELECT ON telemetry.frame_log FROM {}",
            Some("telemetry.frame_log"),
        ),
        (
            "GRANT SELECT ON telemetry.frame_log TO {}; ALTER TABLE telemetry.frame_log ENABLE ROW LEVEL SECURITY",
            Some("telemetry.frame_log"),
        ),
        ("ALTER TABLE telemetry.frame_log DISABLE ROW LEVEL SECURITY", None),
    ];
    for (sql, named) in steps {
        say(&mut owner, &sql.replace("{}", &format!("reader_of_{name}"))).await;
        let dir = tempfile::tempdir().unwrap();
        let taken = PostgresCopy::begin(&reader, dir.path()).await;
        match named {
            Some(named) => {
                let refused = taken.expect_err(sql);
                assert!(matches!(&refused, OpenError::Table { table, .. } if table == named), "{sql}: {refused:?}");
            }
            None => assert_eq!(taken.unwrap().expect("a store").check(dir.path()), Vec::<String>::new()),
        }
    }
}

#[tokio::test]
async fn a_database_with_one_of_the_schemas_is_refused_and_so_is_a_copy_without_the_other() {
    let config = used().await;
    let (dir, mut copy) = taken(&config).await;
    let samples = copy.schemas.get_mut("telemetry").unwrap();
    samples.version = 0;
    samples.tables.clear();
    assert_eq!(copy.check(dir.path()), ["schema telemetry was not copied"]);
    for sql in ["DELETE FROM telemetry.schema_version WHERE version > 0", "DROP SCHEMA telemetry CASCADE"] {
        say(&mut stranger(&config).await, sql).await;
        let dir = tempfile::tempdir().unwrap();
        let refused = PostgresCopy::begin(&config, dir.path()).await.expect_err(sql);
        assert!(matches!(refused, OpenError::NoSchema { schema: "telemetry" }), "{sql}: {refused:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_server_ends_what_it_does_for_a_copy_that_was_given_up() {
    let config = used().await;
    let mut other = stranger(&config).await;
    say(&mut other, "BEGIN; LOCK TABLE telemetry.frame_head IN ACCESS EXCLUSIVE MODE").await;
    let copied = config.clone();
    let copying = tokio::spawn(async move { taken(&copied).await });
    // What a transaction sees of others' work is of one moment, so that one does not look.
    let mut watcher = stranger(&config).await;
    until_a_writer_waits(&mut watcher).await;
    let waiter = "SELECT pid::bigint FROM pg_locks WHERE NOT granted AND database = \
                  (SELECT oid FROM pg_database WHERE datname = current_database())";
    let waiter = number(&mut watcher, waiter).await;
    copying.abort();
    // By itself it would wait for the lock for ten minutes, and everybody else behind it.
    let is_there = format!("SELECT COUNT(*) FROM pg_stat_activity WHERE pid = {waiter}");
    let gone = async {
        while number(&mut watcher, &is_there).await > 0 {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(std::time::Duration::from_secs(60), gone).await.expect("the server ends it");
    let name: String = sqlx::query_scalar("SELECT current_database()").fetch_one(&mut watcher).await.unwrap();
    let log = PostgresServer::shared().log();
    let mut said = log.lines().filter(|line| line.starts_with(&format!("{name}: ")));
    assert!(said.any(|line| line.ends_with("connection to client lost")), "{log}");
    say(&mut other, "COMMIT").await;
}
