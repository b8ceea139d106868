//! Which roll-out serves robots that come to an area later.
//!
//! Invariant: a roll-out serves nobody once one that it served failed, once it was taken back, or once it was aborted.

use crate::ids::{AreaId, RolloutId};
use crate::rollout::decision::plan::Tx;
use crate::rollout::projection::rows::{AreaBundle, Rollout, Step};
use crate::rollout::projection::state::RolloutProjection;
use std::collections::BTreeMap;

/// Robots that come get this roll-out's bundle somewhere.
pub fn is_served(view: &RolloutProjection, id: &RolloutId) -> bool {
    view.area_bundles.values().any(|a| a.row.rollouts.values().any(|r| r == id))
}

/// Robots that come later to an area get its bundle, if robots of their model have it there and no roll-out was
/// completed after it whose bundle they get.
pub fn serve_newcomers(tx: &mut Tx, rollout: &Rollout) {
    let id = &rollout.rollout_id;
    let mut by_area: BTreeMap<AreaId, Vec<String>> = BTreeMap::new();
    for r in tx.view.robots_of(id).filter(|r| matches!(r.step, Step::Trial | Step::Committing | Step::Committed)) {
        let area = tx.view.software.get(r.robot_id.as_str()).and_then(|s| s.row.area.clone());
        let model = tx.view.sessions.get(r.robot_id.as_str()).map(|s| s.row.inventory.model.clone());
        if let Some((area, model)) = area.zip(model) {
            by_area.entry(area).or_default().push(model);
        }
    }
    for (area_id, models) in by_area {
        let known = tx.view.area_bundles.get(area_id.as_str()).map(|a| a.row.clone());
        let mut row = known.unwrap_or_else(|| AreaBundle { area_id, rollouts: BTreeMap::new() });
        let is_newer = |known: &RolloutId| tx.view.rollout(known).is_some_and(|known| known.since > rollout.since);
        let models = models.into_iter().filter(|model| row.rollouts.get(model).is_none_or(|known| !is_newer(known)));
        let models: Vec<(String, RolloutId)> = models.map(|model| (model, id.clone())).collect();
        row.rollouts.extend(models);
        tx.put_row(row, "area.bundle_set");
    }
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
        tx.put_row(row, "area.bundle_forgotten");
    }
}
