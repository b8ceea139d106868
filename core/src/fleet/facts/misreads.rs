//! Robots that dial and are refused because what they say cannot be read, as telemetry stated it.
//!
//! Called once a sweep, and by explanations. Invariants:
//! 1. The open incident is the one record of it: nothing else is kept.
//! 2. It closes by itself once the robot was served for [`limits::UNDERSTOOD_AFTER`] heartbeats of one session: who is refused in each session
//!    anew does not come so far.

use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::time::{Now, Utc};

/// Open incidents of this kind: whose, since when, why.
fn open(view: &FleetProjection) -> impl Iterator<Item = (&RobotId, Utc, &Reason)> {
    let incidents = view.incidents.values().map(|i| &i.row);
    let open = incidents.filter(|i| i.closed.is_none() && i.reason.code == Code::RobotNotUnderstood);
    open.filter_map(|i| Some((i.robot_id.as_ref()?, i.opened_unix_ms, &i.reason)))
}

/// Why a robot that is not heard is not; none: nobody knows, or it is heard.
pub(in crate::fleet) fn unheard(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    robot_id: &RobotId,
) -> Option<Reason> {
    if liveness::presence(board, robot_id, now) == Presence::Online {
        return None;
    }
    open(view).find(|(of, ..)| *of == robot_id).map(|(.., reason)| reason.clone())
}

/// Closes what is over.
pub(in crate::fleet) fn close_understood(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) {
    let seen: &FleetProjection = view;
    let over: Vec<RobotId> = open(seen)
        .filter(|(robot_id, opened, _)| is_understood(seen, board, &now, robot_id, *opened))
        .map(|(robot_id, ..)| robot_id.clone())
        .collect();
    for robot_id in over {
        plan.decide(view, now, "fleet", |tx| {
            incidents::close_about(tx, Code::RobotNotUnderstood, &robot_id, "the robot is served again");
        });
    }
}

/// Its newest heartbeat is of after the incident, and of a session that has stood for long.
fn is_understood(view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId, opened: Utc) -> bool {
    let session = view.sessions.get(robot_id.as_str()).map(|s| s.row.session_epoch);
    let Some(live) = board.get(robot_id).filter(|live| session == Some(live.report.session_epoch)) else {
        return false;
    };
    let is_newer = now.site.since(live.processed_site).as_ms() < now.utc.ms_since(opened);
    liveness::presence(board, robot_id, now) == Presence::Online
        && is_newer
        && live.report.hb >= limits::UNDERSTOOD_AFTER
}
