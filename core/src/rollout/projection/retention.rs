//! Which bundles are still needed though the newest release may list them no more: the server keeps their files.
//!
//! Called by the rollout service now and then. Invariant: when in doubt a bundle is named; one that the newest release
//! lists needs no name here.

use super::rows::{RobotSoftware, Rollout};
use super::state::RolloutProjection;
use crate::ids::BundleId;
use crate::limits;
use crate::time::{Now, Utc};
use std::collections::BTreeSet;

/// Milliseconds of a day.
const DAY_MS: u64 = 24 * 3_600_000;

/// Bundles that a roll-out, one that ended not long ago, a rule for newcomers or a robot names.
pub fn needed_bundles(view: &RolloutProjection, now: &Now) -> BTreeSet<BundleId> {
    let rollouts = view.rollouts.values().map(|r| &r.row).filter(|r| needs_bundle(view, r));
    let served = view.area_bundles.values().flat_map(|a| a.row.rollouts.values()).filter_map(|id| view.rollout(id));
    let mut named: BTreeSet<BundleId> = rollouts.chain(served).map(|r| r.spec.bundle.clone()).collect();
    // A clock that went back says nothing of an end.
    let lately = |ended: Utc| now.ms_since(ended) < limits::ROLLOUT_NAMES_DAYS * DAY_MS;
    let ended = view.bundles.values().map(|b| &b.row).filter(|b| b.ended.is_some_and(lately));
    named.extend(ended.map(|b| b.bundle.clone()));
    let retired = |s: &RobotSoftware| view.control.get(s.robot_id.as_str()).is_some_and(|c| c.row.retired.is_some());
    for robot in view.software.values().map(|s| &s.row).filter(|s| !retired(s)) {
        let update = robot.report.as_ref().filter(|report| !report.state.is_over()).map(|report| &report.bundle);
        named.extend([&robot.committed, &robot.previous, &robot.on_trial].into_iter().flatten().cloned());
        named.extend(update.cloned());
    }
    named
}

/// It is open, or something is still due for one of its robots.
fn needs_bundle(view: &RolloutProjection, rollout: &Rollout) -> bool {
    !rollout.phase.is_over() || view.robots_of(&rollout.rollout_id).any(|r| !r.step.is_over())
}
