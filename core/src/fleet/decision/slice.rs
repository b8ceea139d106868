//! How much one turn of fleet does before it commits and people are answered: what is left goes on in the next turn.
//!
//! Counted, never timed: core has no clock. The service gives smaller slices when turns take too long.

use crate::limits;

/// What each stage of a turn may do.
#[derive(Clone, Copy, Debug)]
pub struct Slice {
    /// Looks that are left: of a task, or of a robot for a task.
    looks: usize,
    /// Decisions that are left.
    decisions: usize,
    /// Decisions of a whole stage.
    whole: usize,
}

impl Default for Slice {
    fn default() -> Self {
        Self::for_decisions(limits::DECISIONS_PER_STAGE)
    }
}

impl Slice {
    /// So many decisions a stage, and as many looks as take the same time.
    pub const fn for_decisions(decisions: usize) -> Self {
        Self { looks: decisions * limits::LOOKS_PER_DECISION, decisions, whole: decisions }
    }
    /// The next stage begins.
    pub const fn renew(&mut self) {
        *self = Self::for_decisions(self.whole);
    }
    /// Looks were taken.
    pub(in crate::fleet) const fn count_looks(&mut self, looks: usize) {
        self.looks = self.looks.saturating_sub(looks);
    }
    /// Decisions were made.
    pub(in crate::fleet) const fn decide(&mut self, decisions: usize) {
        self.decisions = self.decisions.saturating_sub(decisions);
    }
    /// Decisions that are left.
    pub(in crate::fleet) const fn decisions(&self) -> usize {
        self.decisions
    }
    /// Whether the rest of a stage comes in the next turn.
    pub const fn is_spent(&self) -> bool {
        self.looks == 0 || self.decisions == 0
    }
}
