//! A process that does not lead: it keeps its projection by rows alone, answers from it, and carries out what people ask.
//!
//! Invariant: it decides nothing but commands, tells nothing but that a file which it was to hand out is damaged, and
//! signs nothing. A command is decided on the projection, committed on the condition that nothing of it has changed, and
//! decided anew if something has; the process that leads obeys what is written.

use super::reconcile::Loop;
use super::requests::Request;
use midshift_core::limits;
use midshift_core::projection;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rollout::requests::{Ask, CommandOutcome};
use midshift_core::rollout::{LOGS, Plan, decide_request, follow_rows, reread, tell_damaged};
use midshift_core::rows::{Entry, Log, Table};
use midshift_store::{CommitError, Error, follow};
use std::sync::Arc;

impl Loop {
    /// Comes up to the head of the feed. Watchers look again if something of this service changed.
    pub(super) async fn follow_rows(&mut self) -> Result<(), Error> {
        let now = self.parts.clock.now();
        let (mut unreadable, mut changed, mut seen) = (Vec::new(), None, Ok(()));
        let clock = self.parts.clock.clone();
        let Self { view, lease, .. } = self;
        let take = |entries: &[Entry]| {
            if seen.is_ok() {
                // Counted from when it was seen: a look may take long.
                seen = lease.follow(entries, clock.now().link);
            }
            let ours = |e: &&Entry| e.log == Log::Ota && e.table != Some(Table::OtaLeader);
            changed = entries.iter().rfind(ours).map(|e| e.seq).or(changed);
            follow_rows(view, now, entries, &mut unreadable);
        };
        follow(self.parts.store.as_ref(), &mut self.seq, LOGS, take).await?;
        for text in unreadable {
            tracing::error!(text, "roll-outs passed over something they cannot read");
        }
        if let Some(seq) = changed {
            self.changed.send_replace(seq);
        }
        Ok(seen?)
    }

    /// Answers, and carries out what people ask. An error: the projection can no longer be trusted.
    pub(super) async fn assist(&mut self, requests: Vec<Request>) -> Result<(), ()> {
        let unread = |error| tracing::warn!(%error, "roll-outs cannot read what has ended");
        let wanted = self.wanted(&requests);
        self.read_wanted(wanted).await.map_err(unread)?;
        let mut trusted = Ok(());
        for request in requests {
            match request {
                Request::Question(question) => self.questions.push(question),
                Request::Do(asked) => {
                    let answer = match trusted {
                        Ok(()) => self.carry_out(&asked.ask).await,
                        Err(()) => Ok(Err(Refusal::new(Kind::Unavailable, Code::MovedMeanwhile))),
                    };
                    let answer = answer.unwrap_or_else(|error| {
                        tracing::warn!(%error, "a request about a roll-out was not carried out whole");
                        trusted = Err(());
                        Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown))
                    });
                    drop(asked.reply.send(answer));
                }
            }
        }
        trusted?;
        self.tell_damaged().await;
        self.answer(self.parts.clock.now());
        Ok(())
    }

    /// Tells people of files that were found damaged here: the process that leads may never read them.
    async fn tell_damaged(&mut self) {
        let ota = self.parts.ota.clone();
        let damaged = ota.opened().map(|opened| opened.downloads.damaged()).unwrap_or_default();
        if damaged.is_empty() {
            return;
        }
        let (now, mut plan) = (self.parts.clock.now(), Plan::default());
        for digest in &damaged {
            tell_damaged(&mut self.view, now, &digest.to_string(), &mut plan);
        }
        let results = self.parts.store.commit(plan.items).await;
        match (results.into_iter().find_map(Result::err), ota.opened()) {
            (None, Ok(opened)) => opened.downloads.mark_damaged_reported(&damaged),
            (Some(error), _) => tracing::warn!(%error, "people were not told of a damaged file; it is tried again"),
            // One without keys hands nothing out.
            (None, Err(_)) => {}
        }
    }

    /// The answer to whoever asked. An error: what came of it may not be in the projection.
    async fn carry_out(&mut self, ask: &Ask) -> Result<Result<CommandOutcome, Refusal>, Error> {
        for _ in 0..limits::COMMAND_TRIES {
            let mut plan = Plan::default();
            let taken = decide_request(&mut self.view, &self.board, self.parts.clock.now(), ask, &mut plan);
            self.view.arrived.clear();
            if taken.is_err() {
                // That it was refused; whoever asked hears why, whether or not that can be written down.
                drop(self.parts.store.commit(plan.items).await);
                return Ok(taken);
            }
            if plan.items.is_empty() {
                return Ok(taken);
            }
            let keys = projection::touched(&plan.items);
            let results = self.parts.store.commit(plan.items).await;
            let any_applied = results.iter().any(Result::is_ok);
            match results.into_iter().find_map(Result::err) {
                None => return Ok(taken),
                // Part of it stands: what is left of it is asked for again.
                Some(error) if any_applied || !matches!(error, CommitError::Conflict { .. }) => {
                    return Err(Error::Unavailable(Arc::new(error)));
                }
                Some(_) => {
                    metrics::counter!("midshift_ota_commands_again_total").increment(1);
                    let rows = self.parts.store.get(keys.clone()).await?;
                    reread(&mut self.view, &keys, &rows)?;
                    self.follow_rows().await?;
                }
            }
        }
        Ok(Err(Refusal::new(Kind::Unavailable, Code::MovedMeanwhile)))
    }
}

#[cfg(test)]
mod tests;
