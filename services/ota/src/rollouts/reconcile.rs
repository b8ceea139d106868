//! The loop: take what is new, decide, sign, commit. A conflict means that somebody else decided too: the picture is built again.
//!
//! Invariant: the view has absorbed the whole feed before anything is decided on it.

use super::directives::Signer;
use super::{Look, Parts, Planner, Request, releases};
use crate::collect::Named;
use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rollout::named::named;
use midshift_core::rollout::view::{TABLES, View};
use midshift_core::rollout::{Board, LOGS, Plan, absorb, commands, cycle, obeyed};
use midshift_core::rows::Seq;
use midshift_core::time::Now;
use midshift_core::work::Live;
use midshift_store::{CommitError, Dirty, Error, follow};
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::sync::{oneshot, watch};
use tokio_util::sync::CancellationToken;

/// Pause after the store failed, before everything is read again.
const STORE_RETRY: Duration = Duration::from_millis(200);
/// Requests taken into one cycle.
const REQUESTS_PER_CYCLE: usize = 64;

struct Loop {
    parts: Parts,
    view: View,
    seq: Seq,
    board: Board,
    dirty: Dirty<Live>,
    started: Now,
    changed: watch::Sender<Seq>,
    /// Serving time at which it is said next which bundles are needed, milliseconds.
    say_at_ms: u64,
    /// Questions that are answered once what they would see is committed.
    looks: Vec<Look>,
}

type Replies = Vec<(oneshot::Sender<Result<(), Refusal>>, usize)>;

/// Runs until `shutdown`.
pub async fn run(planner: Planner, shutdown: CancellationToken) -> Result<(), Error> {
    let Planner { parts, mut requests, changed } = planner;
    if parts.ota.opened().is_err() {
        shutdown.cancelled().await;
        return Ok(());
    }
    let started = parts.clock.now();
    let dirty = parts.board.watch();
    let view = View::new(parts.site.clone(), started, started);
    let board = Board::new();
    let mut this = Loop { parts, view, seq: Seq(0), board, dirty, started, changed, say_at_ms: 0, looks: Vec::new() };
    this.rebuild_until_read(&shutdown).await;
    // Not before robots could say what they run.
    this.say_at_ms = this.view.served_ms(&started) + limits::COLLECT_EVERY_MS;
    let mut sweep = tokio::time::interval(Duration::from_millis(limits::SWEEP.as_ms()));
    sweep.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    let mut batch = Vec::new();
    let mut more = false;
    loop {
        tokio::select! {
            biased;
            () = shutdown.cancelled() => return Ok(()),
            n = requests.recv_many(&mut batch, REQUESTS_PER_CYCLE) => if n == 0 { return Ok(()) },
            _ = sweep.tick(), if !more => {}
            () = tokio::task::yield_now(), if more => {}
        }
        match this.turn(std::mem::take(&mut batch)).await {
            Ok(unfinished) => more = unfinished,
            Err(()) => {
                tokio::time::sleep(STORE_RETRY).await;
                this.rebuild_until_read(&shutdown).await;
                // What was read is committed, so whoever asked needs not wait until the store takes something again.
                this.answer(this.parts.clock.now());
            }
        }
    }
}

impl Loop {
    async fn rebuild_until_read(&mut self, shutdown: &CancellationToken) {
        while let Err(error) = self.rebuild().await {
            tracing::warn!(%error, "roll-outs cannot read the store, trying again");
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = tokio::time::sleep(STORE_RETRY) => {}
            }
        }
    }

    /// Builds the picture from nothing.
    async fn rebuild(&mut self) -> Result<(), Error> {
        let snapshot = self.parts.store.snapshot(TABLES).await?;
        let now = self.parts.clock.now();
        let served = self.view.served_ms(&now);
        let (unusable, contacts) = (std::mem::take(&mut self.view.unusable), std::mem::take(&mut self.view.contacts));
        self.view = View { unusable, contacts, ..View::new(self.parts.site.clone(), self.started, now) };
        self.view.bugs = self.parts.bugs;
        self.view.load(&snapshot.rows, snapshot.seq)?;
        // The row is as old as the last commit; this process has served on since.
        self.view.served.site_ms = self.view.served.site_ms.max(served);
        self.seq = self.view.marks.get("ota").map_or(Seq(0), |m| m.row.seq).min(snapshot.seq);
        metrics::counter!("midshift_ota_rebuilds_total").increment(1);
        Ok(())
    }

    /// One turn; true: there is more to do at once. An error: the picture can no longer be trusted.
    async fn turn(&mut self, requests: Vec<Request>) -> Result<bool, ()> {
        let mut heard = BTreeSet::new();
        for (robot_id, live) in self.dirty.take() {
            match live {
                Some(live) => {
                    heard.insert(robot_id.clone());
                    self.board.insert(robot_id, live);
                }
                None => {
                    self.board.remove(&robot_id);
                }
            }
        }
        let now = self.parts.clock.now();
        let mut plan = Plan::default();
        let view = &mut self.view;
        follow(self.parts.store.as_ref(), &mut self.seq, LOGS, |entries| absorb(view, now, entries, &mut plan))
            .await
            .map_err(|error| tracing::warn!(%error, "roll-outs cannot read the feed"))?;
        let ota = self.parts.ota.clone();
        let Ok(opened) = ota.opened() else { return Ok(false) };
        releases::take(&mut self.view, now, opened.repository.newest().as_deref(), &mut plan);
        let replies = self.take_requests(requests, now, &mut plan);
        let signer = Signer(opened.repository.keys().directive());
        let more = cycle(&mut self.view, now, &self.board, &heard, &signer, &mut plan);
        for text in &plan.unreadable {
            tracing::error!(text, "roll-outs passed over something they cannot read");
        }
        self.commit(plan, replies).await?;
        self.answer(now);
        let served_ms = self.view.served_ms(&now);
        if served_ms >= self.say_at_ms {
            self.say_at_ms = served_ms + limits::COLLECT_EVERY_MS;
            // From rows that are committed, as answers are.
            opened.named.send_replace(Some(Named { bundles: named(&self.view, &now), served_ms }));
        }
        Ok(more)
    }

    /// Answers every question from the picture, which holds only what is committed at this moment.
    fn answer(&mut self, now: Now) {
        for look in std::mem::take(&mut self.looks) {
            look(&self.view, &self.board, &now);
        }
    }

    fn take_requests(&mut self, requests: Vec<Request>, now: Now, plan: &mut Plan) -> Replies {
        let mut replies = Vec::new();
        for request in requests {
            match request {
                Request::Look(look) => self.looks.push(look),
                Request::Do { command, seen, actor, reply } => {
                    match commands::check(&self.view, &self.board, &command, seen) {
                        Err(refusal) => {
                            drop(reply.send(Err(refusal)));
                            continue;
                        }
                        // What was asked before is in the store, or in an item before this one.
                        Ok(true) => {}
                        Ok(false) => commands::apply(&mut self.view, &self.board, now, &command, &actor, plan),
                    }
                    replies.push((reply, plan.items.len()));
                }
            }
        }
        replies
    }

    async fn commit(&mut self, plan: Plan, replies: Replies) -> Result<(), ()> {
        let entries: Vec<Option<Seq>> = plan.items.iter().map(obeyed).collect();
        let results = if plan.items.is_empty() { Vec::new() } else { self.parts.store.commit(plan.items).await };
        let mut trusted = Ok(());
        let mut newest = None;
        for (result, entry) in results.iter().zip(entries) {
            match result {
                Ok(applied) => newest = Some(applied.seq),
                Err(error) => {
                    if let (true, Some(seq)) = (error.is_final(), entry) {
                        tracing::error!(seq = seq.0, "an entry of the log cannot be obeyed and is passed over");
                        self.view.unusable.insert(seq);
                    }
                    let conflict = matches!(error, CommitError::Conflict { .. });
                    let counted =
                        metrics::counter!("midshift_ota_items_lost_total", "conflict" => conflict.to_string());
                    counted.increment(1);
                    tracing::warn!(%error, "an item of a roll-out was not applied; planning again");
                    trusted = Err(());
                }
            }
        }
        for (reply, upto) in replies {
            let lost = results.iter().take(upto).any(Result::is_err);
            let answer = if lost { Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)) } else { Ok(()) };
            drop(reply.send(answer));
        }
        if let Some(seq) = newest {
            self.changed.send_replace(seq);
        }
        trusted
    }
}
