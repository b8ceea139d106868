//! Roll-outs that have ended, and used request_ids: read from the store when somebody asks for them, or when the picture names them.
//!
//! Invariant: a roll-out is read with all its robots, at one moment.

use super::Request;
use super::reconcile::Loop;
use midshift_core::ids::RolloutId;
use midshift_core::rollout::past;
use midshift_core::rows::{Key, Part, Table};
use midshift_store::Error;
use std::collections::BTreeSet;

impl Loop {
    /// Reads what the picture, `requests` and open questions want to know and is not in the picture.
    pub(super) async fn ask(&mut self, requests: &[Request]) -> Result<(), Error> {
        let wanted = self.view.wanted();
        let mut ids: BTreeSet<RolloutId> = self.looks.iter().flat_map(|look| &look.about).cloned().collect();
        let mut keys = Vec::new();
        for request in requests {
            match request {
                Request::Look(look) => ids.extend(look.about.iter().cloned()),
                Request::Do(asked) => {
                    ids.extend(asked.ask.command.rollouts().into_iter().cloned());
                    keys.extend(asked.ask.request_id.iter().map(|id| Key::new(Table::OtaCommandKey, id)));
                }
            }
        }
        ids.retain(|id| !self.view.rollouts.contains_key(id.as_str()));
        keys.extend(ids.union(&wanted).map(|id| Key::new(Table::Rollout, id.as_str())));
        if keys.is_empty() {
            return Ok(());
        }
        let snapshot = self.parts.store.read(&[Part::Rows(keys), past::robots()], past::named).await?;
        Ok(self.view.tell(wanted, &snapshot.rows)?)
    }
}
