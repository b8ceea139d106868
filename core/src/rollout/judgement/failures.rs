//! What counts against a bundle, and which bundle a robot does not get again.
//!
//! Invariant: a robot counts against a bundle once; a worse failure takes the place of another.

use crate::reason::{Code, Reason};
use crate::rollout::decision::plan::Tx;
use crate::rollout::projection::rows::{Quarantine, RolloutRobot};

/// Notes that a robot counts against its bundle, once.
pub fn fail(tx: &mut Tx, robot: &RolloutRobot, reason: Reason) {
    let Some(robot) = tx.view.robot_of(&robot.rollout_id, &robot.robot_id).cloned() else { return };
    let is_worse = is_hard(&reason) && !robot.failure.as_ref().is_some_and(is_hard);
    if robot.failure.is_none() || is_worse {
        tx.put_row(RolloutRobot { failure: Some(reason), ..robot }, "robot.failed");
    }
}

/// One such failure ends a roll-out at once.
pub fn is_hard(reason: &Reason) -> bool {
    matches!(reason.code, Code::HardStopCode | Code::HardwareStopOnTrial | Code::RollbackFailed | Code::SelfTestFailed)
}

/// A robot that went back by itself does not get this bundle again until a person says so.
pub fn quarantine(tx: &mut Tx, robot: &RolloutRobot, reason: &Reason) {
    let Some(bundle) = tx.view.rollout(&robot.rollout_id).map(|r| r.spec.bundle.clone()) else { return };
    let row = Quarantine {
        robot_id: robot.robot_id.clone(),
        bundle,
        rollout_id: robot.rollout_id.clone(),
        reason: reason.clone(),
        since: tx.now.utc,
    };
    tx.put_row(row, "robot.quarantined");
}
