//! A process that is cut off from PostgreSQL: it hears so within its limits, and holds nobody up for longer than theirs.

use crate::server::PostgresServer;
use crate::support::{database, one, postgres_at, put, say, stranger, until_a_writer_waits};
use midshift_core::rows::{Expect, Key, Table, Writer};
use midshift_store::{CommitError, PostgresConfig, Store};
use std::sync::{Arc, Mutex};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, UnixStream};
use tokio::sync::watch;

/// When a proxy stops by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trap {
    /// Before it passes COMMIT on.
    BeforeCommit,
    /// After that, before the answer.
    AfterCommit,
}

/// A line to the shared server that can be cut without either end noticing: nothing arrives any more, nothing is closed.
#[derive(Clone)]
struct Line {
    cut: watch::Sender<bool>,
    trap: Arc<Mutex<Option<Trap>>>,
}

impl Line {
    /// A line, and the address of `config`'s database at its end.
    async fn to(config: &PostgresConfig) -> (Self, PostgresConfig) {
        let line = Self { cut: watch::Sender::new(false), trap: Arc::default() };
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let accepting = line.clone();
        tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                let far = UnixStream::connect(PostgresServer::shared().socket()).await.unwrap();
                let ((near_read, near_write), (far_read, far_write)) = (near.into_split(), far.into_split());
                tokio::spawn(accepting.clone().pass(near_read, far_write));
                tokio::spawn(accepting.clone().pass(far_read, near_write));
            }
        });
        let database = config.url.split(['/', '?']).nth(3).unwrap();
        (line, PostgresConfig::new(format!("postgres://postgres@{address}/{database}")))
    }

    fn set(&self, trap: Trap) {
        *self.trap.lock().unwrap() = Some(trap);
    }

    fn cut(&self) {
        self.cut.send_replace(true);
    }

    async fn until_cut(&self) {
        self.cut.subscribe().wait_for(|cut| *cut).await.unwrap();
    }

    async fn pass(self, mut from: impl AsyncRead + Unpin, mut to: impl AsyncWrite + Unpin) {
        let mut cut = self.cut.subscribe();
        let mut buffer = vec![0; 64 * 1024];
        loop {
            let read = tokio::select! {
                biased;
                _ = async { cut.wait_for(|cut| *cut).await.is_ok() } => None,
                read = from.read(&mut buffer) => Some(read),
            };
            let length = match read {
                None => return std::future::pending().await,
                Some(Ok(length @ 1..)) => length,
                Some(_) => return,
            };
            let bytes = &buffer[..length];
            let is_commit = bytes.windows(6).any(|word| word == b"COMMIT");
            let trap = self.trap.lock().unwrap().take_if(|_| is_commit);
            if trap.is_some() {
                self.cut();
            }
            if trap != Some(Trap::BeforeCommit) && to.write_all(bytes).await.is_err() {
                return;
            }
        }
    }
}

#[tokio::test]
async fn a_process_cut_off_inside_its_transaction_wrote_nothing_and_the_head_is_free_again() {
    let config = database().await;
    let (line, far) = Line::to(&config).await;
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
    line.cut.send_replace(false);
    one(&*cut_off, Writer::Fleet, attempt("back")).await.unwrap();
}

async fn cut_at_commit(trap: Trap) -> (bool, Result<(), CommitError>) {
    let config = database().await;
    let (line, far) = Line::to(&config).await;
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
