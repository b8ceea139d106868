//! Copies that are not whole, and restores that end in the middle.

use crate::copied::{all, fresh, restored, taken, used};
use crate::server::PostgresServer;
use crate::support::{database, postgres_at, say, stranger, until_a_writer_waits};
use midshift_core::rows::{Seq, Table};
use midshift_store::{PostgresConfig, RestoreError, Store};
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
