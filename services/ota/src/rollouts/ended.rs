//! Roll-outs that have ended, and used request_ids: read from the store when somebody asks for them, or when the
//! projection names them.
//!
//! Invariant: a roll-out is read with all its robots, at one moment.

use super::reconcile::Loop;
use super::requests::Request;
use midshift_core::ids::RolloutId;
use midshift_core::rollout::ended;
use midshift_core::rows::{Key, RowSelection, Table};
use midshift_store::Error;
use std::collections::BTreeSet;

/// What is to be read of ended roll-outs.
pub(super) struct EndedQuery {
    /// Roll-outs that the projection names.
    named: BTreeSet<RolloutId>,
    keys: Vec<Key>,
}

impl Loop {
    /// What the projection, `requests` and open questions want to know and is not in the projection.
    pub(super) fn wanted(&self, requests: &[Request]) -> EndedQuery {
        let named = self.view.wanted();
        let mut ids: BTreeSet<RolloutId> =
            self.questions.iter().flat_map(|question| &question.about).cloned().collect();
        let mut keys = Vec::new();
        for request in requests {
            match request {
                Request::Question(question) => ids.extend(question.about.iter().cloned()),
                Request::Do(asked) => {
                    ids.extend(asked.ask.command.rollouts().into_iter().cloned());
                    keys.extend(asked.ask.request_id.iter().map(|id| Key::new(Table::OtaCommandKey, id)));
                }
            }
        }
        ids.retain(|id| !self.view.rollouts.contains_key(id.as_str()));
        keys.extend(ids.union(&named).map(|id| Key::new(Table::Rollout, id.as_str())));
        EndedQuery { named, keys }
    }
    /// Reads it into the projection.
    pub(super) async fn read_wanted(&mut self, EndedQuery { named, keys }: EndedQuery) -> Result<(), Error> {
        if keys.is_empty() {
            return Ok(());
        }
        let snapshot = self.parts.store.read(&[RowSelection::Rows(keys), ended::robots()], ended::named).await?;
        Ok(self.view.absorb_past(named, &snapshot.rows)?)
    }
}
