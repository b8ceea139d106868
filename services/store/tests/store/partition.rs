//! A process that is cut off from PostgreSQL: it hears so within its limits, and holds nobody up for longer than theirs.

use crate::line::{Line, Trap};
use crate::server::PostgresServer;
use crate::support::{database, one, postgres_at, put, say, site, stranger, until_a_writer_waits};
use midshift_core::item::Expect;
use midshift_core::rows::{Key, Table, Writer};
use midshift_store::{CommitError, HeartbeatLog, PostgresConfig, PostgresHeartbeats, Store};
use std::sync::Arc;
use std::time::Duration;

/// A line to the shared server, and the address of `config`'s database at its end.
async fn line_to(config: &PostgresConfig) -> (Line, PostgresConfig) {
    let line = Line::to(PostgresServer::shared().socket()).await.unwrap();
    let far = PostgresConfig::new(line.url(&config.url));
    (line, far)
}

#[tokio::test]
async fn a_process_cut_off_inside_its_transaction_wrote_nothing_and_the_head_is_free_again() {
    let config = database().await;
    let (line, far) = line_to(&config).await;
    let (cut_off, well) = (Arc::new(postgres_at(&far).await), postgres_at(&config).await);
    let mut holder = stranger(&config).await;
    say(&mut holder, "BEGIN; SELECT seq FROM store_head FOR UPDATE").await;
    let writer = cut_off.clone();
    let attempt = |id: &str| vec![put(Table::Attempt, id, Expect::Absent, "1")];
    let rows = attempt("cut-off");
    let waiting = tokio::spawn(async move { one(&*writer, Writer::Fleet, rows).await });
    until_a_writer_waits(&mut stranger(&config).await).await;
    line.cut();
    // Now it has the head, and does not know.
    say(&mut holder, "COMMIT").await;
    let failed = waiting.await.unwrap();
    assert!(matches!(failed, Err(CommitError::Unavailable(_))), "{failed:?}");
    while !matches!(one(&well, Writer::Fleet, attempt("well")).await, Ok(_) | Err(CommitError::Conflict { .. })) {}
    let ids = ["cut-off", "well"].map(|id| Key::new(Table::Attempt, id));
    let rows = well.get(ids.to_vec()).await.unwrap();
    assert_eq!(rows.len(), 1, "the one that is cut off wrote nothing");
    let still = one(&*cut_off, Writer::Fleet, attempt("still")).await;
    assert!(matches!(still, Err(CommitError::Unavailable(_))), "{still:?}");
    line.heal();
    one(&*cut_off, Writer::Fleet, attempt("back")).await.unwrap();
}

async fn cut_at_commit(trap: Trap) -> (bool, Result<(), CommitError>) {
    let config = database().await;
    let (line, far) = line_to(&config).await;
    let (cut_off, well) = (postgres_at(&far).await, postgres_at(&config).await);
    line.set(trap);
    let outcome = one(&cut_off, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await;
    line.until_cut().await;
    // Whoever commits next has waited for the end of the other's transaction, one way or the other.
    let next = || vec![put(Table::Attempt, "b", Expect::Absent, "1")];
    while !matches!(one(&well, Writer::Fleet, next()).await, Ok(_) | Err(CommitError::Conflict { .. })) {}
    let there = !well.get(vec![Key::new(Table::Attempt, "a")]).await.unwrap().is_empty();
    (there, outcome.map(drop))
}

#[tokio::test]
async fn a_commit_whose_answer_is_lost_is_unknown_whether_it_was_done_or_not() {
    let (there, outcome) = cut_at_commit(Trap::AfterCommit).await;
    assert!(there && matches!(outcome, Err(CommitError::Unknown(_))), "{there} {outcome:?}");
    let (there, outcome) = cut_at_commit(Trap::BeforeCommit).await;
    assert!(!there && matches!(outcome, Err(CommitError::Unknown(_))), "{there} {outcome:?}");
}

/// Readers who do not wait for ever, while a line is severed; then it is whole again, and what had been open stays dead.
async fn reads_again_after(sever: fn(&Line)) {
    let config = database().await;
    let (line, far) = line_to(&config).await;
    let (cut_off, well) = (postgres_at(&far).await, postgres_at(&config).await);
    let heard = PostgresHeartbeats::open(&far, site()).await.unwrap();
    one(&well, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    let key = || vec![Key::new(Table::Attempt, "a")];
    tokio::join!(cut_off.get(key()), cut_off.get(key()), heard.position(), heard.position()).0.unwrap();
    sever(&line);
    let shortly = Duration::from_millis(300);
    for _ in 0..8 {
        let rows = tokio::time::timeout(shortly, cut_off.get(key()));
        let position = tokio::time::timeout(shortly, heard.position());
        let (rows, position) = tokio::join!(rows, position);
        assert!(!matches!(rows, Ok(Ok(_))) && !matches!(position, Ok(Ok(_))), "{rows:?} {position:?}");
    }
    line.heal();
    // Whoever finds no free connection is told so after 5 s: by then those that were given up have made room.
    let mut tries = 0..4;
    while tries.next().is_some() && (cut_off.get(key()).await.is_err() || heard.position().await.is_err()) {}
    assert_eq!(cut_off.get(key()).await.unwrap().len(), 1);
    heard.position().await.unwrap();
}

#[tokio::test]
async fn readers_who_stopped_waiting_behind_a_cut_keep_nobody_from_reading_when_the_line_is_whole_again() {
    tokio::join!(reads_again_after(Line::cut), reads_again_after(Line::break_off));
}
