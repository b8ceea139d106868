//! Another way for a robot that stands before a closed place.
//!
//! Called by `allocation` for a robot whose next stretch cannot be granted. Invariants:
//! 1. A way changes only where the robot stands at the end of what was released to it, and only if a closed place that it does not hold
//!    already is part of its next stretch.
//! 2. The other way leads to its next goal around all that are closed, and its charge lasts for it and the way to a charger behind.

use super::desired::{Release, Releases};
use super::{grants, route_requests, routing};
use crate::desired_state::Assignment;
use crate::energy::Trip;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::limits;
use crate::site::{PlaceIx, WaypointIx};
use crate::task::Attempt;

/// Gives the robot a way around closed places, if there is one. It stays where it is until the first stretch of that is granted.
pub(super) fn reroute(
    tx: &mut Tx,
    live: &NewestHeartbeat,
    a: &Attempt,
    work: &Assignment,
    needed: &[PlaceIx],
    releases: &mut Releases,
) -> bool {
    let view = &*tx.view;
    let released = work.released_index.unwrap_or(0) as usize;
    // What it says must be of this way: it has applied the newest one, and stands where that is released to.
    if !route_requests::is_out_of_route(view, live, a) || !liveness::is_settled(view, live) {
        return false;
    }
    let Some(rest) = work.route.get(released..).and_then(|rest| routing::indices(&view.site, rest)) else {
        return false;
    };
    if routing::find(view, live.report.vitals.waypoint.as_ref()) != rest.first().copied() {
        return false;
    }
    let closed = routing::closed(view);
    let barring = needed.iter().filter(|place| closed.contains(**place) && !grants::holds(view, &a.robot_id, **place));
    let barring: Vec<String> = barring.map(|place| view.site.place(*place).place_id.to_string()).collect();
    if barring.is_empty() {
        return false;
    }
    let ahead = work.route[released..].iter().zip(&rest).skip(1);
    let left: Vec<(u32, WaypointIx)> = ahead.filter_map(|(point, at)| Some((point.ends_step?, *at))).collect();
    let Some(route) = routing::route(view, rest[0], None, &left) else { return false };
    let Some(way) = routing::indices(&view.site, &route) else { return false };
    let to_goal = route.iter().position(|point| point.ends_step.is_some()).unwrap_or(route.len() - 1);
    if meets_closed(view, &way[..=to_goal]) || !has_charge_for(view, live, &way) {
        return false;
    }
    let told = serde_json::json!({"attempt": a.attempt.to_string(), "around": barring});
    tx.view.dirty.insert(a.robot_id.clone());
    tx.add_fact(a.robot_id.as_str(), "robot.rerouted", &told);
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

/// Whether the charge lasts for the whole way, all of it with a load, and to a charger behind it, on a site that has some.
fn has_charge_for(view: &FleetProjection, live: &NewestHeartbeat, way: &[WaypointIx]) -> bool {
    let Some(last) = way.last() else { return true };
    let mut chargers = view.site.chargers().peekable();
    if chargers.peek().is_none() {
        return true;
    }
    let home_mm = chargers.filter_map(|charger| routing::way_mm(view, *last, charger)).min();
    let lanes = way.windows(2).filter_map(|pair| view.site.find_lane(pair[0], pair[1]));
    let way_mm: u64 = lanes.map(|lane| u64::from(view.site.lane(lane).length_mm)).sum();
    let mut trip = Trip::new(view.energy_of(&live.robot_id), true, None);
    trip.drive(way_mm + home_mm.unwrap_or(0));
    u64::from(live.report.vitals.battery_permille) >= trip.needed_permille() + limits::CHARGE_RESERVE_PERMILLE
}
