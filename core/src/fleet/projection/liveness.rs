//! Whether a robot is heard, and whether what it says may be compared with the rows. Reads only; called by every room that acts on a heartbeat.

use super::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::limits;
use crate::presence::Presence;
use crate::robot::Lane;
use crate::time::Now;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Whether a robot is heard, from the board alone. After a start of fleet every lease counts as renewed at that moment.
pub fn presence(board: &Board, robot_id: &RobotId, now: &Now) -> Presence {
    Presence::since(board.get(robot_id).map(|live| live.processed_at), now.link)
}

/// Whether the robot may still have authority to go on.
pub fn lease_stands(view: &FleetProjection, board: &Board, robot_id: &RobotId, now: &Now) -> bool {
    if view.bugs.silence_frees_task() {
        return presence(board, robot_id, now) == Presence::Online;
    }
    let renewed = board.get(robot_id).map_or(view.started.link, |l| l.processed_at.max(view.started.link));
    now.link.since(renewed) <= limits::LEASE
}

/// The robot's differences count: it has applied everything and everything it said has been consumed.
pub fn is_settled(view: &FleetProjection, live: &NewestHeartbeat) -> bool {
    let id = live.robot_id.as_str();
    let Some(session) = view.sessions.get(id) else { return false };
    let current = session.row.session_epoch == live.report.session_epoch;
    let applied = view.desired_work.get(id).is_none_or(|d| live.report.applied_work >= d.row.generation);
    let mark = view.lane_marks.get(format!("{id}/{}", session.row.ring).as_str()).map(|m| &m.row);
    current && applied && (view.bugs.heartbeat_overtakes_events() || live.is_consumed(mark))
}

/// The heartbeat is not older than the robot's events that were consumed: an older one lists what has ended since.
pub fn is_fresh(view: &FleetProjection, live: &NewestHeartbeat) -> bool {
    let id = live.robot_id.as_str();
    let Some(session) = view.sessions.get(id) else { return false };
    let mark = view.lane_marks.get(format!("{id}/{}", session.row.ring).as_str()).map_or(0, |m| m.row.event);
    live.report.produced.get(&Lane::Event).copied().unwrap_or(0) >= mark
}

/// The newest heartbeat of every robot.
pub type Board = BTreeMap<RobotId, Arc<NewestHeartbeat>>;
