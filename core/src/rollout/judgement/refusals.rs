//! Sorts what robots refuse: the content of a bundle, room for it, an order, or the bundle itself.
//!
//! Invariant: what robots refused runs nowhere, so refusals hold a roll-out and never end it.

use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use crate::rollout::projection::rows::{Pause, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;
use std::collections::BTreeSet;

/// So many robots hold a roll-out by refusing its content; in the first wave one does.
const REFUSALS_HOLD: usize = 2;

/// Robots that refused the bytes or the documents of a roll-out.
pub fn refused_content<'a>(
    view: &'a RolloutProjection,
    rollout: &'a Rollout,
) -> impl Iterator<Item = &'a RolloutRobot> {
    let is_content = |why: &Reason| matches!(why.code, Code::BundleCorrupt | Code::MetadataRefused);
    view.robots_of(&rollout.rollout_id)
        .filter(move |r| r.step == Step::Skipped && r.why.as_ref().is_some_and(is_content))
}

/// Why a roll-out has to stand still: robots refused its content, and one more than a person has seen.
pub fn find_pause(view: &RolloutProjection, rollout: &Rollout) -> Option<Pause> {
    let refused: Vec<&RolloutRobot> = refused_content(view, rollout).collect();
    // One that a person has seen may be on its way once more, and refuses nothing at this moment.
    let named: BTreeSet<&RobotId> = rollout.refusals_seen.iter().chain(refused.iter().map(|r| &r.robot_id)).collect();
    let holds = named.len() >= REFUSALS_HOLD || refused.iter().any(|r| r.wave == 0);
    (holds && named.len() > rollout.refusals_seen.len()).then_some(Pause::Content)
}
