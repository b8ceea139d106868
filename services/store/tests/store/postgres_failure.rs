//! What callers hear when PostgreSQL fails under the writer, and that what was acknowledged is there afterwards.

use crate::server::PostgresServer;
use crate::support::{at, database, indexed, item, number, one, postgres_at, put, say, stranger};
use midshift_core::item::Expect;
use midshift_core::rows::{Index, Key, Log, Revision, Table, Writer};
use midshift_store::{CommitError, PostgresConfig, PostgresStore, Store};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

/// What a caller heard of an item.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Heard {
    Applied,
    Unknown,
    Unavailable,
}

/// Commits items of two rows each until one fails; what was heard of each, by id.
async fn work(store: Arc<PostgresStore>, name: String, acknowledged: Arc<AtomicUsize>) -> BTreeMap<String, Heard> {
    let mut heard = BTreeMap::new();
    for n in 0.. {
        let id = format!("{name}/{n}");
        let rows = [Table::Attempt, Table::DesiredWork].map(|table| put(table, &id, Expect::Absent, "{}"));
        let outcome = match one(&*store, Writer::Fleet, rows.to_vec()).await {
            Ok(_) => Heard::Applied,
            Err(CommitError::Unknown(_)) => Heard::Unknown,
            Err(CommitError::Unavailable(_)) => Heard::Unavailable,
            Err(other) => panic!("{other}"),
        };
        heard.insert(id, outcome);
        if outcome != Heard::Applied {
            break;
        }
        acknowledged.fetch_add(1, Ordering::Relaxed);
    }
    heard
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_acknowledged_survives_the_end_of_the_server_and_nothing_is_half_there() {
    let mut server = PostgresServer::start();
    let config = PostgresConfig::new(server.database());
    let store = Arc::new(postgres_at(&config).await);
    let mut heard = BTreeMap::new();
    for round in 0..3 {
        let acknowledged = Arc::new(AtomicUsize::new(0));
        let workers = (0..4).map(|w| work(store.clone(), format!("{round}/{w}"), acknowledged.clone()));
        let mut working = workers.collect::<tokio::task::JoinSet<_>>();
        while acknowledged.load(Ordering::Relaxed) < 40 {
            tokio::task::yield_now().await;
        }
        server = tokio::task::spawn_blocking(move || {
            server.cut();
            server
        })
        .await
        .unwrap();
        while let Some(of_worker) = working.join_next().await {
            heard.extend(of_worker.unwrap());
        }
        server = tokio::task::spawn_blocking(move || {
            server.start_again();
            server
        })
        .await
        .unwrap();
        // The store finds its way back by itself.
        let back = || put(Table::RobotControl, &format!("back-{round}"), Expect::Absent, "{}");
        while !matches!(one(&*store, Writer::Fleet, vec![back()]).await, Ok(_) | Err(CommitError::Conflict { .. })) {}
    }
    let snapshot = store.snapshot(&[Table::Attempt, Table::DesiredWork]).await.unwrap();
    let has = |table, id: &str| snapshot.rows.iter().any(|row| row.key == Key::new(table, id));
    for (id, heard) in &heard {
        let there = has(Table::Attempt, id);
        assert_eq!(there, has(Table::DesiredWork, id), "{id} is half there");
        match heard {
            Heard::Applied => assert!(there, "{id} was acknowledged"),
            Heard::Unavailable => assert!(!there, "{id} was refused"),
            Heard::Unknown => {}
        }
    }
    let failed = heard.values().filter(|heard| **heard != Heard::Applied).count();
    assert!(failed >= 3, "the fault happened: {failed} of {} items failed", heard.len());
}

#[tokio::test]
async fn an_error_at_commit_is_unknown_to_the_whole_group_and_the_writer_reads_again() {
    let config = database().await;
    let store = postgres_at(&config).await;
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    // A deferred constraint that nothing can meet is checked at COMMIT and not before.
    let mut other = stranger(&config).await;
    say(&mut other, "CREATE TABLE nowhere (id TEXT PRIMARY KEY)").await;
    let trap = "FOREIGN KEY (parent) REFERENCES nowhere (id) DEFERRABLE INITIALLY DEFERRED";
    say(&mut other, &format!("ALTER TABLE attempt ADD CONSTRAINT trap {trap}")).await;
    let head = store.snapshot(&[]).await.unwrap().seq;
    let lost = Index { parent: Some(Arc::from("x")), ..Index::default() };
    let attempt = |id: &str, expect, index| item(Writer::Fleet, vec![indexed(Table::Attempt, id, expect, "2", index)]);
    let items = vec![
        attempt("a", at(1), Index::default()),
        attempt("b", Expect::Absent, lost),
        attempt("a", at(9), Index::default()),
    ];
    let results = store.commit(items).await;
    assert!(results.iter().all(|r| matches!(r, Err(CommitError::Unknown(_)))), "{results:?}");
    assert_eq!(store.get(vec![Key::new(Table::Attempt, "a")]).await.unwrap()[0].revision, Revision(1));
    let applied = store.commit(vec![attempt("a", at(1), Index::default())]).await.remove(0).unwrap();
    let page = store.feed(head, &[Log::Fleet], 10).await.unwrap();
    assert_eq!(page.entries.iter().map(|entry| entry.seq).collect::<Vec<_>>(), [applied.seq]);
}

/// The connection that waits for the head, once it is another than `before`.
async fn until_another_writer_waits(other: &mut sqlx::PgConnection, before: i64) -> i64 {
    let waiting = "SELECT COALESCE(MAX(pid), 0)::BIGINT FROM pg_stat_activity WHERE datname = current_database() \
                   AND application_name = 'midshift' AND wait_event_type = 'Lock'";
    loop {
        match number(other, &format!("{waiting} AND pid <> {before}")).await {
            0 => {}
            pid => return pid,
        }
    }
}

/// Ends that connection; which it was.
async fn cut_the_waiting_writer(other: &mut sqlx::PgConnection, before: i64) -> i64 {
    let pid = until_another_writer_waits(other, before).await;
    say(other, &format!("SELECT pg_terminate_backend({pid})")).await;
    pid
}

#[tokio::test]
async fn a_writer_whose_connection_ends_before_its_commit_tries_once_more_by_a_new_one_and_says_so_if_that_ends_too() {
    let config = database().await;
    let store = Arc::new(postgres_at(&config).await);
    let (mut holder, mut other) = (stranger(&config).await, stranger(&config).await);
    let attempt = |id: &str| {
        let (writer, rows) = (store.clone(), vec![put(Table::Attempt, id, Expect::Absent, "1")]);
        tokio::spawn(async move { one(&*writer, Writer::Fleet, rows).await })
    };
    say(&mut holder, "BEGIN; SELECT seq FROM store_head FOR UPDATE").await;
    let cut_once = attempt("a");
    let first = cut_the_waiting_writer(&mut other, 0).await;
    until_another_writer_waits(&mut other, first).await;
    say(&mut holder, "ROLLBACK").await;
    cut_once.await.unwrap().unwrap();
    say(&mut holder, "BEGIN; SELECT seq FROM store_head FOR UPDATE").await;
    let cut_twice = attempt("b");
    let first = cut_the_waiting_writer(&mut other, first).await;
    cut_the_waiting_writer(&mut other, first).await;
    let failed = cut_twice.await.unwrap();
    assert!(matches!(failed, Err(CommitError::Unavailable(_))), "{failed:?}");
    say(&mut holder, "ROLLBACK").await;
    assert!(store.get(vec![Key::new(Table::Attempt, "b")]).await.unwrap().is_empty());
    attempt("b").await.unwrap().unwrap();
}

#[tokio::test]
async fn a_writer_that_slept_while_the_server_was_away_writes_at_once_when_it_is_back() {
    let mut server = PostgresServer::start();
    let store = postgres_at(&PostgresConfig::new(server.database())).await;
    let attempt = |id: &str| vec![put(Table::Attempt, id, Expect::Absent, "1")];
    one(&store, Writer::Fleet, attempt("a")).await.unwrap();
    let _up = tokio::task::spawn_blocking(move || {
        server.cut();
        server.start_again();
        server
    })
    .await
    .unwrap();
    one(&store, Writer::Fleet, attempt("b")).await.unwrap();
}

#[tokio::test]
async fn a_head_that_stays_locked_is_unavailable_after_a_while() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let mut holder = stranger(&config).await;
    say(&mut holder, "BEGIN; SELECT seq FROM store_head FOR UPDATE").await;
    let attempt = || vec![put(Table::Attempt, "a", Expect::Absent, "1")];
    let failed = one(&store, Writer::Fleet, attempt()).await;
    assert!(matches!(failed, Err(CommitError::Unavailable(_))), "{failed:?}");
    say(&mut holder, "COMMIT").await;
    one(&store, Writer::Fleet, attempt()).await.unwrap();
}

#[tokio::test]
async fn a_process_does_not_write_to_a_store_that_took_the_place_of_its_own() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let mut other = stranger(&config).await;
    say(&mut other, "UPDATE store_head SET store_id = 'restored'").await;
    let end = "SELECT COUNT(pg_terminate_backend(pid)) FROM pg_stat_activity \
               WHERE datname = current_database() AND pid <> pg_backend_pid()";
    assert!(number(&mut other, end).await > 0, "the writer has to connect again");
    let failed = one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await;
    assert!(matches!(failed, Err(CommitError::Unavailable(_))), "{failed:?}");
    assert_eq!(number(&mut other, "SELECT COUNT(*) FROM attempt").await, 0);
}
