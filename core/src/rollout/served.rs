//! Which roll-out serves robots that come to an area later.
//!
//! Invariant: a roll-out serves nobody once one that it served failed, once it was taken back, or once it was aborted.

use super::Tx;
use super::rows::AreaBundle;
use super::view::View;
use crate::ids::RolloutId;

/// Robots that come get this roll-out's bundle somewhere.
pub fn is_served(view: &View, id: &RolloutId) -> bool {
    view.area_bundles.values().any(|a| a.row.rollouts.values().any(|r| r == id))
}

/// Robots that come later do not get it any more.
pub fn forget_area_bundles(tx: &mut Tx, id: &RolloutId) {
    let named: Vec<AreaBundle> = tx
        .view
        .area_bundles
        .values()
        .map(|a| &a.row)
        .filter(|a| a.rollouts.values().any(|r| r == id))
        .cloned()
        .collect();
    for mut row in named {
        row.rollouts.retain(|_, rollout| rollout != id);
        tx.put(row, "area.bundle_forgotten");
    }
}
