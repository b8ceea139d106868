//! Rows of robots that come into a roll-out.
//!
//! Invariant: nothing was asked of such a robot yet.

use crate::gates::{Effort, TaskTally};
use crate::ids::RobotId;
use crate::rollout::decision::plan::Tx;
use crate::rollout::projection::rows::{Moments, Rollout, RolloutRobot, Step, WayBack};
use crate::time::{Now, Utc};

/// Gives robots their rows.
pub fn assign_robots(tx: &mut Tx, rollout: &Rollout, robots: &[(RobotId, u32, u64, String)]) {
    for (robot_id, wave, rank, from_version) in robots {
        let now = tx.now;
        tx.put_row(new_robot(&now, rollout, robot_id, *wave, *rank, from_version.clone()), "robot.assigned");
    }
}

/// A robot that nothing was asked of.
pub fn new_robot(
    now: &Now,
    rollout: &Rollout,
    robot_id: &RobotId,
    wave: u32,
    rank: u64,
    from_version: String,
) -> RolloutRobot {
    RolloutRobot {
        rollout_id: rollout.rollout_id.clone(),
        robot_id: robot_id.clone(),
        wave,
        rank,
        step: Step::Waiting,
        since: now.utc,
        from_version,
        directive_generation: 0,
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
