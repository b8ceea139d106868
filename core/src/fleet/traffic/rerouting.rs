//! Another way for a robot that stands before a closed place.
//!
//! Called by `allocation` for a robot whose next stretch cannot be granted. Invariant: a way changes only where the robot stands at the end of
//! what was released to it, only if a closed place lies on the rest of it, and only to one that leads around all that are closed.

use super::desired::{Release, Releases};
use super::{route_requests, routing};
use crate::desired_state::Assignment;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::site::WaypointIx;
use crate::task::Attempt;

/// Gives the robot a way around closed places, if there is one. It stays where it is until the first stretch of that is granted.
pub(super) fn reroute(
    tx: &mut Tx,
    live: &NewestHeartbeat,
    a: &Attempt,
    work: &Assignment,
    releases: &mut Releases,
) -> bool {
    let view = &*tx.view;
    let released = work.released_index.unwrap_or(0) as usize;
    if routing::closed(view).is_empty() || !route_requests::is_out_of_route(view, live, a) {
        return false;
    }
    let Some(rest) = work.route.get(released..).and_then(|rest| routing::indices(&view.site, rest)) else {
        return false;
    };
    // What it says must be of this way: it has applied the newest one, and stands where that is released to.
    let stands_at = routing::find(view, live.report.vitals.waypoint.as_ref());
    if !liveness::is_settled(view, live) || stands_at != rest.first().copied() {
        return false;
    }
    if !meets_closed(view, &rest) {
        return false;
    }
    let ahead = work.route[released..].iter().zip(&rest).skip(1);
    let left: Vec<(u32, WaypointIx)> = ahead.filter_map(|(point, at)| Some((point.ends_step?, *at))).collect();
    let Some(route) = routing::route(view, rest[0], None, &left) else { return false };
    if routing::indices(&view.site, &route).is_none_or(|around| meets_closed(view, &around)) {
        return false;
    }
    tx.view.dirty.insert(a.robot_id.clone());
    releases.0.insert(a.robot_id.clone(), Release { route: Some(route), released_index: 0 });
    true
}

/// Whether a closed place lies on the way behind its first waypoint.
fn meets_closed(view: &FleetProjection, way: &[WaypointIx]) -> bool {
    let closed = routing::closed(view);
    way.windows(2).any(|pair| {
        let passages = view.site.passages_of_lane(pair[0], pair[1]).iter().copied();
        passages.chain(view.site.standing_at(pair[1])).any(|place| closed.contains(place))
    })
}
