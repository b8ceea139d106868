//! The verbs of the update's row: put, move on, report, and ask for a job once the row is durable.
//!
//! Invariant: the update moves only along [`UpdateState::transitions`].

use crate::core::state::AgentCore;
use crate::sets::Holdings;
use crate::storage::{Op, SoftwareRow, Update};
use crate::update::Job;
use midshift_core::reason::Reason;
use midshift_core::robot::Lane;
use midshift_core::robot_events::RobotEvent;
use midshift_core::update::{UpdateEvent, UpdateReport, UpdateState};

impl AgentCore {
    pub(super) fn put_software(&mut self, row: SoftwareRow) {
        self.note_directive(row.directive_generation);
        self.write(Op::Software(Box::new(row)), true);
    }

    /// Moves the update on, on the ledger and in a report.
    pub(super) fn move_to(&mut self, state: UpdateState, reason: Option<Reason>) {
        let Some(update) = self.memory.ledger.software.update.clone() else { return };
        let reason = reason.or(update.reason.clone());
        self.put_update(Update { state, reason, ..update });
    }

    pub(super) fn put_update(&mut self, update: Update) {
        let from = self.memory.ledger.software.update.as_ref().filter(|u| u.bundle == update.bundle).map(|u| u.state);
        if from.is_some_and(|from| from != update.state && !from.transitions().contains(&update.state)) {
            tracing::error!(?from, to = ?update.state, "no step of an update");
            return;
        }
        tracing::info!(robot_id = %self.config.robot_id, bundle = %update.bundle, state = ?update.state, reason = update.reason.as_ref().map(|reason| reason.name()), "update");
        self.update.collected = false;
        self.put_software(SoftwareRow { update: Some(update), ..self.memory.ledger.software.clone() });
        if let Some(report) = self.update_report() {
            self.emit(Lane::Event, RobotEvent::Update(UpdateEvent::Changed(report)));
        }
    }

    /// What the robot says of its update.
    pub(crate) fn update_report(&self) -> Option<UpdateReport> {
        let (there, needed) = self.update.progress;
        let permille = there.saturating_mul(1000).checked_div(needed).unwrap_or(0);
        self.memory.ledger.software.report(permille.min(1000) as u16)
    }

    pub(super) fn ask_for(&mut self, job: Job) {
        let barrier = self.written();
        self.update.next = Some((job, barrier));
    }

    pub(super) fn hold(&mut self, change: impl FnOnce(&mut Holdings)) {
        if let Some(holdings) = &mut self.update.holdings {
            change(holdings);
        }
    }

    /// The newest directive is not taken; it is not looked at again.
    pub(super) fn refuse_directive(&mut self, reason: Reason) {
        let Some(desired) = &self.update.desired else { return };
        tracing::warn!(robot_id = %self.config.robot_id, reason = reason.name(), "directive refused");
        self.update.judged = Some(desired.directive.clone());
        let refused = UpdateEvent::DirectiveRefused { generation: desired.generation, reason };
        self.emit(Lane::Event, RobotEvent::Update(refused));
    }
}
