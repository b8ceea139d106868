//! Items of a cycle: each decision is one item, or nothing.
//!
//! Invariant: a decision that touches a row of a newer version is given up and leaves the projection as it was.

use crate::drain_request::INCIDENT;
use crate::identity::Actor;
use crate::ids::RobotId;
use crate::item::Item;
use crate::reason::Reason;
use crate::rollout::projection::state::RolloutProjection;
use crate::time::Now;

/// A decision of the rollout service under way.
pub type Tx<'a> = crate::projection::Tx<'a, RolloutProjection>;

/// Items to commit, in order, and what could not be read.
#[derive(Debug, Default)]
pub struct Plan {
    /// Each atomic by itself; later ones expect the revisions that earlier ones write.
    pub items: Vec<Item>,
    /// Rows or entries that could not be read; each was passed over and is logged.
    pub unreadable: Vec<String>,
}

impl Plan {
    /// Makes one decision; nothing is added if it changed nothing, or if it touches a row of a newer version.
    pub fn decide(
        &mut self,
        view: &mut RolloutProjection,
        now: Now,
        actor: impl Into<Actor>,
        decision: impl FnOnce(&mut Tx),
    ) {
        let mut tx = Tx::new(view, now, actor);
        decision(&mut tx);
        if tx.unknown_row().is_some() {
            tx.take_back();
            return;
        }
        self.items.extend(tx.finish());
    }
}

/// States that a person should look into something.
pub(in crate::rollout) fn incident(tx: &mut Tx, robot_id: Option<&RobotId>, reason: &Reason) {
    tx.add_fact(robot_id.map_or("", RobotId::as_str), INCIDENT, reason);
}
