//! Rows of robots that come into a roll-out.
//!
//! Invariant: nothing was asked of such a robot yet.

use super::Tx;
use super::rows::{Moments, Rollout, RolloutRobot, Step, WayBack};
use crate::gates::{Effort, TaskTally};
use crate::ids::RobotId;
use crate::time::{Now, Utc};

/// Gives robots their rows.
pub fn add(tx: &mut Tx, rollout: &Rollout, robots: &[(RobotId, u32, u64, String)]) {
    for (robot_id, wave, place, from_version) in robots {
        let now = tx.now;
        tx.put(fresh(&now, rollout, robot_id, *wave, *place, from_version.clone()), "robot.assigned");
    }
}

/// A robot that nothing was asked of.
pub fn fresh(
    now: &Now,
    rollout: &Rollout,
    robot_id: &RobotId,
    wave: u32,
    place: u64,
    from_version: String,
) -> RolloutRobot {
    RolloutRobot {
        rollout_id: rollout.rollout_id.clone(),
        robot_id: robot_id.clone(),
        wave,
        place,
        step: Step::Waiting,
        since: now.utc,
        from_version,
        directive: 0,
        signed: Utc(0),
        way_back: WayBack::default(),
        drain_id: None,
        ready: false,
        grant: None,
        not_used: false,
        attempted: false,
        failure: None,
        why: None,
        again: false,
        before: TaskTally::default(),
        effort_before: Effort::default(),
        moments: Moments::default(),
        lost: None,
    }
}
