//! What callers hear when the file fails under the writer, and that the writer finds its way back.

use crate::support::{at, clock, one, put, site};
use midshift_core::item::Expect;
use midshift_core::rows::{Key, Log, Revision, Table, Writer};
use midshift_store::{CommitError, SqliteStore, Store};
use sqlx::{AssertSqlSafe, Connection, SqliteConnection};
use std::path::Path;

/// Someone else with the file open, who breaks the rules.
async fn meddle(dir: &Path, statements: &[&str]) {
    let url = format!("sqlite://{}", dir.join("control.db").display());
    let mut connection = SqliteConnection::connect(&url).await.unwrap();
    for statement in statements {
        sqlx::query(AssertSqlSafe(*statement)).execute(&mut connection).await.unwrap();
    }
    connection.close().await.unwrap();
}

#[tokio::test]
async fn a_commit_that_fails_before_its_end_changed_nothing_and_the_writer_goes_on() {
    let dir = tempfile::tempdir().unwrap();
    let store = SqliteStore::open(dir.path(), site(), clock()).await.unwrap();
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    meddle(dir.path(), &["ALTER TABLE attempt RENAME TO hidden"]).await;
    let rows = vec![put(Table::RobotControl, "r", Expect::Absent, "1"), put(Table::Attempt, "a", at(1), "2")];
    let failed = one(&store, Writer::Fleet, rows).await;
    assert!(matches!(failed, Err(CommitError::Unavailable(_))), "{failed:?}");
    meddle(dir.path(), &["ALTER TABLE hidden RENAME TO attempt"]).await;
    assert!(store.get(vec![Key::new(Table::RobotControl, "r")]).await.unwrap().is_empty());
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", at(1), "2")]).await.unwrap();
}

#[tokio::test]
async fn an_error_at_commit_is_unknown_to_the_whole_group_and_the_writer_reads_again() {
    let dir = tempfile::tempdir().unwrap();
    let store = SqliteStore::open(dir.path(), site(), clock()).await.unwrap();
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    // A deferred constraint that nothing can meet is checked at COMMIT and not before.
    let trap = "CREATE TABLE trap (id INTEGER REFERENCES nowhere (id) DEFERRABLE INITIALLY DEFERRED)";
    let trigger =
        "CREATE TRIGGER spring AFTER INSERT ON attempt WHEN NEW.id = 'b' BEGIN INSERT INTO trap VALUES (1); END";
    meddle(dir.path(), &["CREATE TABLE nowhere (id INTEGER PRIMARY KEY)", trap, trigger]).await;
    let head = store.snapshot(&[]).await.unwrap().seq;
    let attempt = |id: &str, expect| crate::support::item(Writer::Fleet, vec![put(Table::Attempt, id, expect, "2")]);
    let results = store.commit(vec![attempt("a", at(1)), attempt("b", Expect::Absent), attempt("a", at(9))]).await;
    assert!(results.iter().all(|r| matches!(r, Err(CommitError::Unknown(_)))), "{results:?}");
    assert_eq!(store.get(vec![Key::new(Table::Attempt, "a")]).await.unwrap()[0].revision, Revision(1));
    let applied = store.commit(vec![attempt("a", at(1))]).await.remove(0).unwrap();
    let page = store.feed(head, &[Log::Fleet], 10).await.unwrap();
    let numbers: Vec<_> = page.entries.iter().map(|entry| entry.seq).collect();
    assert_eq!(numbers, [applied.seq]);
}
