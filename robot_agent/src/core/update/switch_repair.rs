//! A switch record that is behind the ledger: it names a trial that the ledger knows nothing of, or one that the ledger
//! has committed.
//!
//! Invariant: a set that the ledger has committed is not gone back from for that: floors have risen with it.

use crate::core::state::AgentCore;
use crate::launcher::switch::Switch;
use crate::storage::Update;
use midshift_core::update::UpdateState;

impl AgentCore {
    /// Ends a trial that is none by the ledger. A set that was committed, and that an older record has on trial, is
    /// committed there too; any other is left for the one that was committed. True: a job is on its way.
    pub(super) fn end_unknown_trial(&mut self, switch: &Switch) -> bool {
        let Some(trial) = &switch.trial else { return false };
        let update = self.memory.ledger.software.update.as_ref().filter(|u| u.state == UpdateState::Committed);
        let is_committed = update.and_then(Update::set_name).is_some_and(|name| name == trial.set);
        let mut switch = switch.clone();
        if is_committed {
            tracing::warn!(robot_id = %self.config.robot_id, set = %trial.set, "the switch record was behind the ledger");
            switch.commit();
        } else {
            switch.go_back();
            self.update.went_back = true;
        }
        self.write_switch(switch);
        true
    }
}
