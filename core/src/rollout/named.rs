//! Which bundles are still needed though the newest release may list them no more: the server keeps their files.
//!
//! Called by the rollout service now and then. Invariant: when in doubt a bundle is named; one that the newest release lists needs no
//! name here.

use super::rows::{RobotSoftware, Rollout};
use super::view::View;
use crate::ids::BundleId;
use crate::limits;
use crate::time::Now;
use std::collections::BTreeSet;

/// Milliseconds of a day.
const DAY_MS: u64 = 24 * 3_600_000;

/// Bundles that a roll-out, a rule for newcomers or a robot names.
pub fn named(view: &View, now: &Now) -> BTreeSet<BundleId> {
    let rollouts = view.rollouts.values().map(|r| &r.row).filter(|r| names(view, r, now));
    let served = view.area_bundles.values().flat_map(|a| a.row.rollouts.values()).filter_map(|id| view.rollout(id));
    let mut named: BTreeSet<BundleId> = rollouts.chain(served).map(|r| r.spec.bundle.clone()).collect();
    let retired = |s: &RobotSoftware| view.control.get(s.robot_id.as_str()).is_some_and(|c| c.row.retired.is_some());
    for robot in view.software.values().map(|s| &s.row).filter(|s| !retired(s)) {
        let update = robot.report.as_ref().filter(|report| !report.state.is_over()).map(|report| &report.bundle);
        named.extend([&robot.committed, &robot.previous, &robot.on_trial].into_iter().flatten().cloned());
        named.extend(update.cloned());
    }
    named
}

/// It is open, something is still due for one of its robots, or it ended not long ago. A clock that went back says nothing of its end.
fn names(view: &View, rollout: &Rollout, now: &Now) -> bool {
    !rollout.phase.is_over()
        || now.ms_since(rollout.since) < limits::ROLLOUT_NAMES_DAYS * DAY_MS
        || view.robots_of(&rollout.rollout_id).any(|r| !r.step.is_over())
}
