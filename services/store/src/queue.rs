//! The way to the one writer task of a process: commands queue while a commit runs, and the next group takes all that is there.
//!
//! Invariant: there is no timer, and every command is answered once. What a commit does is its engine's ([`Engine`]); what its
//! callers hear of it is decided here, so that it is the same on every engine.

use crate::{Applied, Cause, CommitError, Error, Retention};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::rows::{Log, Seq};
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

/// Commands that may wait for the writer. Each holds at most one group's worth of items.
const QUEUE_COMMANDS: usize = 256;
/// Entries one slice of pruning looks at.
pub(crate) const PRUNE_SLICE: usize = 1_000;

/// Answers to the items of one command.
pub(crate) type Results = Vec<Result<Applied, CommitError>>;

pub(crate) struct Commit {
    items: Vec<Item>,
    bytes: usize,
    reply: oneshot::Sender<Results>,
}

pub(crate) enum Command {
    Commit(Commit),
    RaiseHead { at_least: Seq, reply: oneshot::Sender<Result<Seq, Error>> },
    Prune { log: Log, up_to: Seq, reply: oneshot::Sender<Result<(), Error>> },
    Close { reply: oneshot::Sender<()> },
}

/// Why a group did not go through.
pub(crate) enum Failed {
    /// Nothing of it was written.
    Before(Cause),
    /// Nobody knows.
    AtCommit(Cause),
}

/// What the writer task drives: one engine's side of a commit.
pub(crate) trait Engine: Send + 'static {
    /// Applies the items of one group, in order, in one transaction; the answers in the same shape.
    fn commit(&mut self, group: Vec<Vec<Item>>) -> impl Future<Output = Result<Vec<Results>, Failed>> + Send;
    /// As [`crate::Store::raise_head`].
    fn raise_head(&mut self, at_least: Seq) -> impl Future<Output = Result<Seq, Error>> + Send;
    /// Takes the entries of a log up to `up_to` out, and remembers that they are gone.
    fn prune(&mut self, log: Log, up_to: Seq) -> impl Future<Output = Result<(), Error>> + Send;
    /// Lets go of what is open.
    fn close(self) -> impl Future<Output = ()> + Send;
}

/// Serves the queue until it is closed or nobody can ask any more.
pub(crate) async fn run(mut engine: impl Engine, mut queue: mpsc::Receiver<Command>) {
    let mut put_back = None;
    loop {
        let command = match put_back.take() {
            Some(command) => command,
            None => match queue.recv().await {
                Some(command) => command,
                None => return,
            },
        };
        match command {
            Command::Commit(first) => commit(&mut engine, gather(first, &mut queue, &mut put_back)).await,
            // Who asked may have stopped waiting; the work is done all the same.
            Command::RaiseHead { at_least, reply } => drop(reply.send(engine.raise_head(at_least).await)),
            Command::Prune { log, up_to, reply } => drop(reply.send(engine.prune(log, up_to).await)),
            Command::Close { reply } => {
                engine.close().await;
                let _ = reply.send(());
                return;
            }
        }
    }
}

async fn commit(engine: &mut impl Engine, commits: Vec<Commit>) {
    let started = Instant::now();
    let counts: Vec<usize> = commits.iter().map(|c| c.items.len()).collect();
    let items: usize = counts.iter().sum();
    let (group, replies): (Vec<_>, Vec<_>) = commits.into_iter().map(|c| (c.items, c.reply)).unzip();
    let replace: Box<dyn Fn() -> CommitError + Send> = match engine.commit(group).await {
        Ok(answers) => {
            let conflicts = answers.iter().flatten().filter(|r| matches!(r, Err(CommitError::Conflict { .. })));
            metrics::counter!("midshift_store_conflicts_total").increment(conflicts.count() as u64);
            metrics::counter!("midshift_store_groups_total").increment(1);
            metrics::histogram!("midshift_store_group_items").record(items as f64);
            metrics::histogram!("midshift_store_commit_seconds").record(started.elapsed().as_secs_f64());
            return replies.into_iter().zip(answers).for_each(|(reply, results)| drop(reply.send(results)));
        }
        Err(Failed::Before(cause)) => Box::new(move || CommitError::Unavailable(cause.clone())),
        Err(Failed::AtCommit(cause)) => {
            tracing::error!(error = %cause, items, "commit outcome unknown");
            metrics::counter!("midshift_store_unknown_total").increment(items as u64);
            Box::new(move || CommitError::Unknown(cause.clone()))
        }
    };
    for (reply, count) in replies.into_iter().zip(counts) {
        // Also a conflict was judged against what may not have been written.
        drop(reply.send((0..count).map(|_| Err(replace())).collect()));
    }
}

/// Takes what has queued, up to one group's caps.
fn gather(first: Commit, queue: &mut mpsc::Receiver<Command>, put_back: &mut Option<Command>) -> Vec<Commit> {
    let (mut items, mut bytes) = (first.items.len(), first.bytes);
    let mut group = vec![first];
    while let Ok(command) = queue.try_recv() {
        match command {
            Command::Commit(commit)
                if items + commit.items.len() <= limits::GROUP_COMMIT_ITEMS
                    && bytes + commit.bytes <= limits::GROUP_COMMIT_BYTES =>
            {
                items += commit.items.len();
                bytes += commit.bytes;
                group.push(commit);
            }
            other => {
                *put_back = Some(other);
                break;
            }
        }
    }
    group
}

/// The callers' end.
pub(crate) struct Queue(mpsc::Sender<Command>);

impl Queue {
    /// Both ends.
    pub(crate) fn new() -> (Self, mpsc::Receiver<Command>) {
        let (commands, queue) = mpsc::channel(QUEUE_COMMANDS);
        (Self(commands), queue)
    }

    pub(crate) async fn commit(&self, items: Vec<Item>) -> Results {
        let mut results = Vec::with_capacity(items.len());
        for (items, bytes) in slices(items) {
            let (reply, answer) = oneshot::channel();
            let count = items.len();
            // A refused send drops the reply, which is heard below.
            let sent = self.0.send(Command::Commit(Commit { items, bytes, reply })).await.is_ok();
            match answer.await {
                Ok(answers) => results.extend(answers),
                Err(_) if sent => results.extend((0..count).map(|_| Err(CommitError::Unknown(closed())))),
                Err(_) => results.extend((0..count).map(|_| Err(CommitError::Unavailable(closed())))),
            }
        }
        results
    }

    pub(crate) async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        if at_least > crate::SEQ_PLAUSIBLE_MAX {
            return Err(Error::ImplausibleSeq { asked: at_least });
        }
        self.ask(|reply| Command::RaiseHead { at_least, reply }).await
    }

    pub(crate) async fn prune(&self, log: Log, up_to: Seq) -> Result<(), Error> {
        self.ask(|reply| Command::Prune { log, up_to, reply }).await
    }

    /// Finishes what is queued; everything asked afterwards is refused.
    pub(crate) async fn close(&self) {
        let (reply, closed) = oneshot::channel();
        if self.0.send(Command::Close { reply }).await.is_ok() {
            // An error means that the writer has ended by itself, which is what was asked for.
            let _ = closed.await;
        }
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<Result<T, Error>>) -> Command) -> Result<T, Error> {
        let (reply, answer) = oneshot::channel();
        self.0.send(command(reply)).await.map_err(|_| Error::Unavailable(closed()))?;
        answer.await.map_err(|_| Error::Unavailable(closed()))?
    }
}

/// Commands of a caller, in order: each a part of a group at most, and the next is sent when the one before is answered.
fn slices(items: Vec<Item>) -> Vec<(Vec<Item>, usize)> {
    let mut slices: Vec<(Vec<Item>, usize)> = Vec::new();
    for item in items {
        let bytes = item.bytes();
        match slices.last_mut() {
            Some((slice, sum))
                if slice.len() < limits::COMMIT_SLICE_ITEMS && *sum + bytes <= limits::COMMIT_SLICE_BYTES =>
            {
                slice.push(item);
                *sum += bytes;
            }
            _ => slices.push((vec![item], bytes)),
        }
    }
    slices
}

/// How many of a log's `oldest` entries go, and the number of the last of them; none: no more go.
pub(crate) fn going(oldest: &[(Seq, i64)], surplus: u64, keep: &Retention) -> Option<(u64, Seq)> {
    let going = (1u64..).zip(oldest).take_while(|(rank, (seq, at_unix_ms))| {
        *seq <= keep.floor && (*at_unix_ms < keep.before_unix_ms || *rank <= surplus)
    });
    going.last().map(|(rank, (seq, _))| (rank, *seq))
}

pub(crate) fn closed() -> Cause {
    Arc::new(std::io::Error::new(std::io::ErrorKind::NotConnected, "the store is closed"))
}

pub(crate) fn unavailable(source: sqlx::Error) -> Error {
    Error::Unavailable(Arc::new(source))
}
