//! Items of a cycle: each decision is one item, and what the store would never take is given up.
//!
//! Invariant: a decision that is given up leaves the projection as it was.

use super::refusals;
use super::report::Report;
use super::slice::Slice;
use crate::fleet::projection::rows::FleetMark;
use crate::fleet::projection::state::FleetProjection;
use crate::identity::Actor;
use crate::item::Item;
use crate::rows::Seq;
use crate::time::Now;

/// A decision of fleet under way.
pub type Tx<'a> = crate::projection::Tx<'a, FleetProjection>;

/// Items to commit, in order, and the report.
#[derive(Debug, Default)]
pub struct Plan {
    /// Each atomic by itself; later ones expect the revisions that earlier ones write.
    pub items: Vec<Item>,
    /// What was done and why not.
    pub report: Report,
    /// What this turn may still do.
    pub slice: Slice,
}

impl Plan {
    /// An empty plan of a turn that may do so much.
    pub fn for_slice(slice: Slice) -> Self {
        Self { slice, ..Self::default() }
    }
    /// Makes one decision; nothing is added if it changed nothing. False: it was given up, since the store would never take it.
    pub fn decide(
        &mut self,
        view: &mut FleetProjection,
        now: Now,
        actor: impl Into<Actor>,
        decision: impl FnOnce(&mut Tx),
    ) -> bool {
        let mut tx = Tx::new(view, now, actor);
        decision(&mut tx);
        self.keep_decision(tx)
    }

    /// Adds a decision that was made. False: it was given up, since the store would never take it, or since it touches a row of a newer
    /// version.
    pub fn keep_decision(&mut self, mut tx: Tx) -> bool {
        if tx.unknown_row().is_some() {
            tx.take_back();
            return false;
        }
        let is_aside = tx.view.refused.keeps_any() && tx.view.refused.is_aside(&tx.decision_key());
        if !is_aside && !tx.is_too_large() {
            let item = tx.finish();
            self.slice.decide(usize::from(item.is_some()));
            self.items.extend(item);
            return true;
        }
        self.slice.decide(1);
        let decision_key = tx.decision_key();
        let view = tx.take_back();
        if !is_aside {
            refusals::note_refusal(view, decision_key);
        }
        false
    }
    /// Whether a stage goes on in the next turn; then the next turn comes at once.
    pub(in crate::fleet) fn is_cut(&mut self) -> bool {
        let is_cut = self.slice.is_spent();
        self.report.more |= is_cut;
        is_cut
    }
}

pub(in crate::fleet) fn mark(tx: &mut Tx, seq: Seq) {
    tx.put_row(FleetMark { seq }, "fleet.consumed");
}
