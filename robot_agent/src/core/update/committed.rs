//! What follows a commit: migrations of the robot's data, one after the other, and what is told of them.
//!
//! Invariant: a migration begins only after COMMITTED is on the ledger.

use crate::core::state::AgentCore;
use crate::sets::Holdings;
use crate::storage::{DueMigration, Update};
use crate::update::Job;
use midshift_core::reason::{Code, Reason};
use midshift_core::update::UpdateState;

impl AgentCore {
    /// The next migration of a committed set. False: nothing is due.
    pub(super) fn migrate(&mut self, holdings: &Holdings) -> bool {
        let Some(due) = self.memory.ledger.software.due.first().cloned() else { return false };
        let Ok(set) = holdings.switch.running().parse() else { return false };
        self.ask_for(Job::Migrate { set, due });
        true
    }

    pub(super) fn migrated(&mut self, done: &DueMigration) {
        let mut row = self.memory.ledger.software.clone();
        row.due.retain(|due| due != done);
        let reason = row.due.first().map(Self::is_due);
        let update = row.update.clone();
        self.put_software(row);
        self.tell_of_migration(update, reason);
    }

    pub(super) fn not_migrated(&mut self, due: &DueMigration, why: &str) {
        let reason = Reason::from(Code::MigrationFailed).with("component", &due.component).with("why", why);
        self.tell_of_migration(self.memory.ledger.software.update.clone(), Some(reason));
    }

    /// What a committed update waits for.
    pub(super) fn is_due(due: &DueMigration) -> Reason {
        Reason::from(Code::MigrationDue).with("component", &due.component)
    }

    fn tell_of_migration(&mut self, update: Option<Update>, reason: Option<Reason>) {
        let is_committed = |update: &Update| update.state == UpdateState::Committed && update.reason != reason;
        if let Some(update) = update.filter(is_committed) {
            self.put_update(Update { reason, ..update });
        }
    }
}
