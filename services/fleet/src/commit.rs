//! Commits a plan, and makes good what the store did not take of it.
//!
//! Invariants:
//! 1. What the store refuses for good costs that one decision and those made on top of it: their rows are read again, and no others.
//! 2. A command whose rows others have changed meanwhile is decided anew, as it is by a process that does not lead.
//! 3. After a conflict, or where nobody knows what came of an item, the projection is not trusted any more.

use crate::reconcile::{Loop, Replies};
use crate::requests::{PendingCommand, Request};
use midshift_core::fleet::projection::named;
use midshift_core::fleet::{Plan, obeyed, put_right, refusals};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::projection::{self, DecisionKey};
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Key, Row, Seq, Table};
use midshift_core::task::figures::TaskFigures;
use midshift_core::time::Now;
use midshift_store::leadership::{self, GroupOutcome};
use midshift_store::{Applied, CommitError, Error, GET_KEYS_MAX, Store};
use std::collections::{BTreeMap, BTreeSet};

/// What is known of an item once it is with the store.
struct Sent {
    kind: &'static str,
    /// Rows that it touches.
    keys: Vec<Key>,
    /// The entry of the feed that it obeys.
    obeys: Option<Seq>,
    /// Entries that it leaves.
    entries: u64,
}

impl Sent {
    fn from_item(item: &Item) -> Self {
        let keys = item.rows.iter().map(|row| row.key.clone()).collect();
        Self { kind: projection::kind_of(item), keys, obeys: obeyed(item), entries: projection::entries_of(item) }
    }
}

/// Of tasks that have ended those whose end is in the store: what the last item that touches one says, or what others wrote.
fn committed(ended: Vec<TaskFigures>, results: &[Result<Applied, CommitError>], sent: &[Sent]) -> Vec<TaskFigures> {
    if ended.is_empty() {
        return ended;
    }
    let is_applied = sent.iter().zip(results).flat_map(|(sent, result)| {
        let tasks = sent.keys.iter().filter(|key| key.table == Table::TaskState);
        tasks.map(|key| (&*key.id, result.is_ok()))
    });
    let is_applied: BTreeMap<&str, bool> = is_applied.collect();
    ended.into_iter().filter(|task| is_applied.get(task.task_id.as_str()) != Some(&false)).collect()
}

impl Loop {
    /// Commits the plan, and before it that this process still leads, if it is time to say so. An error: the projection can no longer be trusted.
    pub(crate) async fn renew_and_commit(
        &mut self,
        renewal: Option<Item>,
        now: Now,
        plan: Plan,
        replies: Replies,
    ) -> Result<(), ()> {
        let ended = std::mem::take(&mut self.figures.ended);
        let renews = renewal.is_some();
        let items: Vec<Item> = renewal.into_iter().chain(plan.items).collect();
        let sent: Vec<Sent> = items.iter().map(Sent::from_item).collect();
        let mut results = if items.is_empty() { Vec::new() } else { self.parts.store.commit(items).await };
        if renews && results.first().is_some_and(Result::is_ok) {
            self.lease.claimed(now.link);
        }
        let lost = self.count(&results, &sent, renews);
        self.figures.count(&committed(ended, &results, &sent));
        let results = results.split_off(usize::from(renews));
        for (asked, items) in replies {
            self.settle(asked, results.get(items));
        }
        match lost {
            Some(keys) if keys.is_empty() => Ok(()),
            Some(keys) => {
                self.take_back(keys).await.map_err(|error| tracing::warn!(%error, "fleet cannot read the store"))
            }
            None => Err(()),
        }
    }

    /// Answers a command of which these items were committed, or decides it anew.
    fn settle(&mut self, mut asked: Box<PendingCommand>, results: Option<&[Result<Applied, CommitError>]>) {
        asked.lost += 1;
        let answer = match results.map(leadership::group_outcome) {
            Some(GroupOutcome::Done) => Ok(()),
            Some(GroupOutcome::Moved) if asked.lost < limits::COMMAND_TRIES => {
                metrics::counter!("midshift_fleet_commands_again_total").increment(1);
                self.again.push(Request::Do(asked));
                return;
            }
            Some(GroupOutcome::Moved) => Err(Refusal::new(Kind::Unavailable, Code::MovedMeanwhile)),
            Some(GroupOutcome::Unknown) | None => Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown)),
        };
        drop(asked.reply.send(answer));
    }

    /// Counts what was applied and what was not. Rows of decisions that have to be taken back; none: more than these may be wrong.
    fn count(
        &mut self,
        results: &[Result<Applied, CommitError>],
        sent: &[Sent],
        renews: bool,
    ) -> Option<BTreeSet<Key>> {
        let mut lost = Some(BTreeSet::new());
        for (n, (result, sent)) in results.iter().zip(sent).enumerate() {
            let error = match result {
                Ok(applied) => {
                    self.own.wrote(applied.seq.0, sent.entries);
                    continue;
                }
                Err(error) => error,
            };
            let taken_back = lost.as_ref().is_some_and(|keys| follows(error, keys));
            let is_conflict = matches!(error, CommitError::Conflict { .. }) && !taken_back;
            metrics::counter!("midshift_fleet_items_lost_total", "conflict" => is_conflict.to_string()).increment(1);
            tracing::warn!(%error, kind = sent.kind, "fleet's item was not applied; planning again");
            let is_renewal = renews && n == 0;
            if error.is_final() && !is_renewal {
                self.note_refusal(sent);
            }
            lost = lost.filter(|_| !is_renewal && (error.is_final() || taken_back));
            lost.iter_mut().for_each(|keys| keys.extend(sent.keys.iter().cloned()));
        }
        lost
    }

    fn note_refusal(&mut self, sent: &Sent) {
        if let Some(seq) = sent.obeys {
            tracing::error!(seq = seq.0, sent.kind, "an entry of the log cannot be obeyed and is passed over");
            self.view.unusable.insert(seq);
        } else {
            refusals::undone(&mut self.view, DecisionKey::new(sent.kind, sent.keys.iter()));
        }
    }

    /// Puts rows back to what the store has. Entries of the feed that were obeyed by what was lost are taken again.
    async fn take_back(&mut self, lost: BTreeSet<Key>) -> Result<(), Error> {
        metrics::counter!("midshift_fleet_decisions_taken_back_total").increment(1);
        let keys: Vec<Key> = lost.iter().cloned().collect();
        let mut rows = rows_of(self.parts.store.as_ref(), &keys).await?;
        let more: BTreeSet<Key> = named(&rows).into_iter().filter(|key| !lost.contains(key)).collect();
        rows.extend(rows_of(self.parts.store.as_ref(), &Vec::from_iter(more)).await?);
        put_right(&mut self.view, &keys, &rows)?;
        if keys.iter().any(|key| key.table == Table::FleetMark) {
            let consumed = self.view.marks.get("fleet").map_or(Seq(0), |mark| mark.row.seq);
            // Their rows are in the projection already; only what they ask for is not done.
            self.view.read_at = self.view.read_at.max(self.view.absorbed);
            self.seq = self.seq.min(consumed);
            self.behind = None;
        }
        self.news = true;
        Ok(())
    }
}

async fn rows_of(store: &dyn Store, keys: &[Key]) -> Result<Vec<Row>, Error> {
    let mut rows = Vec::new();
    for some in keys.chunks(GET_KEYS_MAX) {
        rows.extend(store.get(some.to_vec()).await?);
    }
    Ok(rows)
}

/// Whether an item was lost only because one before it was: it expected what that one was to write.
fn follows(error: &CommitError, lost: &BTreeSet<Key>) -> bool {
    matches!(error, CommitError::Conflict { key, .. } if lost.contains(key))
}
