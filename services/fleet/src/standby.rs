//! A process that does not lead: it keeps its projection by rows alone, answers from it, and carries out what people ask.
//!
//! Invariant: it decides nothing but commands. Each is decided on the projection, committed on the condition that nothing of it has changed,
//! and decided anew if something has; the process that leads obeys what is written.

use crate::reconcile::Loop;
use crate::{PendingCommand, Request};
use midshift_core::fleet::commands;
use midshift_core::fleet::{LOGS, Tx, follow_rows, objects, reread};
use midshift_core::idempotency;
use midshift_core::identity::Actor;
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::projection;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::rows::{Entry, Key, Table};
use midshift_store::{CommitError, Error, follow};

impl Loop {
    /// Comes up to the head of the feed.
    pub(crate) async fn follow_rows(&mut self) -> Result<(), Error> {
        let now = self.parts.clock.now();
        let mut unreadable = Vec::new();
        let mut seen = Ok(());
        let clock = self.parts.clock.clone();
        let Self { view, lease, .. } = self;
        let take = |entries: &[Entry]| {
            if seen.is_ok() {
                // Counted from when it was seen: a look may take long.
                seen = lease.follow(entries, clock.now().link);
            }
            if !entries.is_empty() {
                follow_rows(view, now, entries, &mut unreadable);
            }
        };
        follow(self.parts.store.as_ref(), &mut self.seq, LOGS, take).await?;
        self.load_wanted_rows(Vec::new()).await?;
        for text in unreadable {
            tracing::error!(text, "fleet passed over something it cannot read");
        }
        Ok(seen?)
    }

    /// Answers, and carries out what people ask. An error: the projection can no longer be trusted.
    pub(crate) async fn assist(&mut self, requests: Vec<Request>) -> Result<(), ()> {
        let mut trusted = Ok(());
        for request in requests {
            match request {
                Request::Look(look) => self.looks.push(look),
                Request::Do(asked) => {
                    let answer = match trusted {
                        Ok(()) => self.carry_out(&asked).await,
                        Err(()) => Ok(Err(Refusal::new(Kind::Unavailable, Code::MovedMeanwhile))),
                    };
                    let answer = answer.unwrap_or_else(|error| {
                        tracing::warn!(%error, "fleet cannot read the store");
                        trusted = Err(());
                        Err(Refusal::new(Kind::Unavailable, Code::CommitUnknown))
                    });
                    drop(asked.reply.send(answer));
                }
            }
        }
        trusted?;
        self.answer(self.parts.clock.now());
        Ok(())
    }

    /// The answer to whoever asked. An error: what came of it may not be in the projection.
    async fn carry_out(&mut self, asked: &PendingCommand) -> Result<Result<(), Refusal>, Error> {
        let used: Vec<Key> = asked.request_id.iter().map(|id| Key::new(Table::CommandKey, id)).collect();
        for _ in 0..limits::COMMAND_TRIES {
            self.load_wanted_rows(used.clone()).await?;
            let item = match self.decide(asked) {
                Ok(Some(item)) => item,
                Ok(None) => return Ok(Ok(())),
                Err(refusal) => {
                    // Whoever asked hears why, whether or not that can be written down.
                    drop(self.parts.store.commit(self.refused(asked, &refusal)).await);
                    return Ok(Err(refusal));
                }
            };
            let keys = projection::touched(std::slice::from_ref(&item));
            match self.parts.store.commit(vec![item]).await.pop() {
                Some(Ok(_)) => return Ok(Ok(())),
                Some(Err(CommitError::Conflict { .. })) => {
                    metrics::counter!("midshift_fleet_commands_again_total").increment(1);
                    let rows = self.parts.store.get(keys.clone()).await?;
                    reread(&mut self.view, &keys, &rows)?;
                    self.follow_rows().await?;
                }
                Some(Err(error)) => return Err(Error::Unavailable(std::sync::Arc::new(error))),
                None => unreachable!("one result an item"),
            }
        }
        Ok(Err(Refusal::new(Kind::Unavailable, Code::MovedMeanwhile)))
    }

    /// What a refusal leaves in the audit.
    fn refused(&self, asked: &PendingCommand, refusal: &Refusal) -> Vec<Item> {
        let PendingCommand { command, validate_only, by, request_id, .. } = asked;
        let item = commands::refusal(&self.view, command, by, request_id.as_deref(), refusal);
        item.into_iter().filter(|_| !validate_only).collect()
    }

    /// What has to be written; none: nothing has.
    fn decide(&mut self, asked: &PendingCommand) -> Result<Option<Item>, Refusal> {
        let PendingCommand { command, seen, validate_only, by, request_id, .. } = asked;
        objects::permit(&self.view, &self.board, by, command)?;
        if let Some(id) = request_id
            && idempotency::is_repeat(&self.view.command_keys, id, command, *seen)?
        {
            return Ok(None);
        }
        let now = self.parts.clock.now();
        commands::check(&self.view, &self.board, &now, command, *seen)?;
        if *validate_only {
            return Ok(None);
        }
        let actor = Actor::from(by);
        let mut tx = Tx::new(&mut self.view, now, &actor).on_request(request_id.as_deref());
        commands::apply(&mut tx, &self.board, command, actor.name());
        if let Some(id) = request_id {
            idempotency::remember(&mut tx, id, command, *seen);
        }
        let item = tx.finish();
        self.view.rest();
        Ok(item)
    }
}
