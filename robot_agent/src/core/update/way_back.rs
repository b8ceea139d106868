//! Orders that lead back from the committed set, which was not the newest update or cannot be left any more.
//!
//! Invariant: only a directive of its own leads back, newer than any that was taken, and about the bundle that is
//! committed.

use super::directive_check::refusal_of;
use crate::core::state::AgentCore;
use crate::sets::Holdings;
use crate::storage::Update;
use midshift_bundle::directive::Rejection;
use midshift_bundle::manifest::Migration;
use midshift_core::reason::{Code, Reason};
use midshift_core::time::Now;
use midshift_core::update::{Goal, UpdateState};

impl AgentCore {
    /// Looks at a directive that leads back from the committed set though something else was tried and left since.
    /// True: it was taken.
    pub(super) fn begin_way_back(&mut self, now: &Now, holdings: &Holdings) -> bool {
        let Some(desired) = self.update.desired.clone().filter(|d| d.goal == Goal::Revert) else { return false };
        if self.is_observed() || self.names(&desired) {
            return false;
        }
        let software = self.memory.ledger.software.clone();
        let stuck = software.update.clone().filter(|update| update.state == UpdateState::Stuck);
        let is_back = stuck.as_ref().and_then(Update::set_name).is_some_and(|set| set != holdings.switch.running());
        if holdings.switch.kept().is_none() && !is_back {
            self.refuse_way_back();
            return false;
        }
        let trusted = match self.trusted() {
            Ok(trusted) => trusted,
            Err(reason) => {
                self.refuse_directive(reason);
                return false;
            }
        };
        let opened = self.verify_directive(&desired, software.directive_generation, trusted.now(self.reading(now)));
        if opened == Err(Rejection::NotSigned) && self.update.keys_asked.as_ref() != Some(&desired.directive) {
            // The server may sign with a key that came since.
            self.ask_to_refresh(now, trusted, self.reading(now));
            self.update.asks_for_keys = true;
            return true;
        }
        let directive = match opened {
            Ok(directive) => directive,
            Err(rejection) => {
                self.refuse_directive(refusal_of(&rejection));
                return false;
            }
        };
        if let Some(update) = stuck.filter(|update| update.bundle == directive.manifest) {
            // A person mended what kept it: it is gone back from once more.
            self.update.judged = Some(desired.directive.clone());
            self.put_software(software.with(&directive, &desired));
            let (state, reason) = (UpdateState::RollingBack, Some(Reason::from(Code::RevertAsked)));
            let drain_id = desired.drain_id.or(update.drain_id);
            self.put_update(Update { state, drain_id, reason, ..update });
            return true;
        }
        let committed = holdings.set(&holdings.switch.current).filter(|_| holdings.switch.trial.is_none());
        let Some(set) = committed.filter(|set| set.bundle == Some(directive.manifest)) else {
            self.refuse_directive(Reason::new(Code::DirectiveRefused, "another bundle is the committed one, or runs"));
            return false;
        };
        let row = software.with(&directive, &desired);
        self.update.judged = Some(desired.directive);
        let is_irreversible = set.components.values().any(|c| c.data_migration == Migration::Irreversible);
        let update = Update {
            state: UpdateState::Committed,
            bundle: directive.manifest,
            manifest_length: directive.manifest_length,
            rollback_floor: directive.rollback_floor,
            set: Some(set),
            raises_floor: false,
            is_irreversible,
            drain_id: desired.drain_id,
            tries: 0,
            probation_ms: desired.probation_ms,
            reason: None,
        };
        self.put_software(row);
        self.put_update(update);
        true
    }

    /// There is nothing to go back to, which the server cannot know; it is told once.
    pub(super) fn refuse_way_back(&mut self) {
        let asked = self.update.desired.as_ref().map(|d| d.generation);
        if self.update.no_way_back != asked {
            self.update.no_way_back = asked;
            self.refuse_directive(Reason::from(Code::NothingKept));
        }
    }
}
