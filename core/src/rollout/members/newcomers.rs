//! Robots that come to an area after a roll-out was completed there get its bundle too, one by one, under the same
//! rules.

use super::area_bundles::{forget_area_bundles, is_served};
use super::assign::new_robot;
use super::matching;
use crate::fleet::Board;
use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use crate::rollout::decision::plan::{Tx, incident};
use crate::rollout::projection::queue::{is_newcomer, is_retried};
use crate::rollout::projection::rows::{Phase, Rollout, RolloutRobot, Step};
use crate::rollout::projection::state::RolloutProjection;

/// The completed roll-out that a robot should have had a part in, if there is one.
pub fn find_rollout(view: &RolloutProjection, board: &Board, robot_id: &RobotId) -> Option<Rollout> {
    let stratum = matching::stratum_of(view, board, robot_id)?;
    let area = view.area_bundles.get(stratum.area.as_ref()?.as_str())?;
    let rollout = view.rollout(area.row.rollouts.get(&stratum.model)?)?;
    let bundle = view.bundles.get(rollout.spec.bundle.as_str())?;
    let good = bundle.row.listed && bundle.row.revoked.is_none() && rollout.phase == Phase::Completed;
    // Whom the roll-out was not for does not get it for having come again.
    let meant = matching::is_meant_for(view, robot_id, &stratum, &rollout.spec);
    // One that could not be had when it came is tried when it can.
    let passed = |r: &RolloutRobot| r.step == Step::Skipped && is_newcomer(rollout, r) && is_retried(r);
    let new = meant && view.robot_of(&rollout.rollout_id, robot_id).is_none_or(passed);
    let free = matching::claimed_by(view, robot_id, &rollout.rollout_id).is_none();
    let may = matching::may_have(view, robot_id, &stratum, &bundle.row).is_ok();
    (good && new && free && may).then(|| rollout.clone())
}

/// A robot that came later failed: they come one by one, so each is a wave of one, and nobody comes behind it. A robot
/// that a person tried again says nothing of the others.
pub fn stop_serving(tx: &mut Tx, rollout: &Rollout, r: &RolloutRobot) {
    if rollout.phase != Phase::Completed || !is_newcomer(rollout, r) || r.again || !is_served(tx.view, &r.rollout_id) {
        return;
    }
    let told = Reason::from(Code::NewcomerFailed).with("rollout_id", &r.rollout_id);
    incident(tx, Some(&r.robot_id), &told);
    forget_area_bundles(tx, &r.rollout_id);
}

/// Gives a robot that came later a place behind the last wave.
pub fn add_newcomer(tx: &mut Tx, board: &Board, robot_id: &RobotId, rollout: &Rollout) {
    let wave = rollout.spec.waves.len() as u32 + 1;
    let rank = matching::rank_of(&rollout.rollout_id, robot_id);
    let from_version = matching::stratum_of(tx.view, board, robot_id).map(|s| s.from_version).unwrap_or_default();
    let row = new_robot(&tx.now, rollout, robot_id, wave, rank, from_version);
    tx.put_row(row, "robot.newcomer");
}
