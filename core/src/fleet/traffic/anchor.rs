//! Generations and anchors of what is given to robots. Reads only.

use crate::authority::Authority;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::limits;
use crate::time::{LinkDuration, Now};

/// The generation that the next write of a robot's work will have.
pub fn next_generation(view: &FleetProjection, robot_id: &RobotId, now: &Now) -> u64 {
    let last = view.desired_work.get(robot_id.as_str()).map_or(0, |d| d.row.generation);
    (last + 1).max(now.wall.0.max(0) as u64)
}

/// Permission anchored to the newest heartbeat of the robot's current session; none if it is not heard.
pub fn anchor(view: &FleetProjection, robot_id: &RobotId, board: &Board, valid: LinkDuration) -> Option<Authority> {
    let live = board.get(robot_id)?;
    let session = view.sessions.get(robot_id.as_str())?;
    let current = session.row.session_epoch == live.report.session_epoch;
    current.then(|| Authority { session_epoch: live.report.session_epoch, hb: live.report.hb, valid_ms: valid.as_ms() })
}

/// Less than half of its life is left, or it belongs to another session.
pub fn is_worn(authority: &Authority, live: Option<&NewestHeartbeat>) -> bool {
    let Some(live) = live else { return false };
    let age_ms = live.report.hb.saturating_sub(authority.hb).saturating_mul(limits::HEARTBEAT.as_ms());
    authority.session_epoch != live.report.session_epoch || age_ms >= authority.valid_ms / 2
}
