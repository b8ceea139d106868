//! Free bays for robots that stand in a place which others need.
//!
//! Invariant: a robot goes aside only while it waits itself, and another waits for a place that it holds or for an order that it is in the way
//! of, or nobody can go on before it does; and only to where all can go on then, see `safe_order`. Time plays no part.

use super::desired::{Release, Releases};
use super::grants::{self, Occupancy};
use super::{remaining_routes, route_requests, routing};
use crate::desired_state::Assignment;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::HolderState;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::limits;
use crate::site::route::segments;
use crate::site::{PlaceIx, WaypointIx};
use crate::task::Attempt;

/// The robot stands in a place or passage that another waits for while its own goal is taken: it goes to a free bay on the way.
pub(super) fn step_aside(
    tx: &mut Tx,
    a: &Attempt,
    work: &Assignment,
    releases: &mut Releases,
    occupancy: &mut Occupancy,
) -> bool {
    let robot_id = &a.robot_id;
    let released = work.released_index.unwrap_or(0) as usize;
    let Some(here) = work.route.get(released).and_then(|p| tx.view.site.find(&p.waypoint)) else { return false };
    let place = tx.view.site.standing_at(here);
    let stands = match place {
        Some(place) => stands_in(tx.view, robot_id, place),
        None => route_requests::bars_passage(tx.view, robot_id),
    };
    if !stands {
        return false;
    }
    let seat = occupancy.seat_aside(robot_id);
    if seat.is_none() && !is_in_the_way(tx.view, robot_id, place) {
        return false;
    }
    let left: Vec<_> =
        work.route.iter().skip(released + 1).filter_map(|p| p.ends_step.zip(tx.view.site.find(&p.waypoint))).collect();
    let Some((_, goal)) = left.first().copied() else { return false };
    let site = tx.view.site.clone();
    let held = remaining_routes::held(tx.view, robot_id);
    // One that was on its way over a bay that it needs no more goes to its goal at once.
    let goes_round = work.route.get(released..).is_some_and(|rest| {
        let direct = routing::route(tx.view, here, None, &left);
        direct.is_some_and(|direct| direct.len() < rest.len())
    });
    let direct = goes_round.then_some(None);
    let bays: Vec<WaypointIx> = find_bays(tx.view, robot_id, (here, goal), seat, occupancy);
    for via in direct.into_iter().chain(bays.into_iter().map(Some)) {
        let Some(mut route) = routing::route(tx.view, here, via, &left) else { continue };
        route[0].ends_step = None;
        let Some(ixs) = routing::indices(&site, &route) else { continue };
        let Some(first) = segments(&site, &ixs).into_iter().next() else { continue };
        let after = remaining_routes::on_route(&site, &route, first.end, &held);
        let places = first.places();
        if first.standing == place
            || grants::check_grant(tx.view, robot_id, &places, after.as_ref(), occupancy).is_err()
        {
            continue;
        }
        grants::grant_places(tx, robot_id, &places, after, occupancy);
        tx.view.dirty.insert(a.robot_id.clone());
        releases.0.insert(robot_id.clone(), Release { route: Some(route), released_index: first.end as u32 });
        return true;
    }
    false
}

/// Whether another robot waits for a place that this one holds and that has no seat left, or for an order that this one is in the way of.
fn is_in_the_way(view: &FleetProjection, robot_id: &RobotId, stands: Option<PlaceIx>) -> bool {
    let is_meant = |ix: &PlaceIx| stands.is_none_or(|place| place == *ix);
    let held = remaining_routes::held(view, robot_id).into_iter().filter(is_meant);
    let mut held = held.map(|ix| &view.site.place(ix).place_id);
    held.any(|place_id| route_requests::is_waited_for(view, robot_id, place_id))
        || route_requests::is_in_an_orders_way(view, robot_id)
}

/// The bay that the order sends it to, then those with a seat that nobody else needs, by the whole way over them to the goal. At most so many as
/// are tried for one robot.
fn find_bays(
    view: &FleetProjection,
    robot_id: &RobotId,
    (here, goal): (WaypointIx, WaypointIx),
    seat_aside: Option<PlaceIx>,
    occupancy: &Occupancy,
) -> Vec<WaypointIx> {
    let is_fine = |seat: &PlaceIx| Some(*seat) == seat_aside || occupancy.is_spare(*seat);
    let has_seat = |bay: &WaypointIx| {
        let seat = view.site.standing_at(*bay).filter(|seat| *bay != here && is_fine(seat));
        seat.is_some_and(|seat| grants::has_way(view, robot_id, &[seat], occupancy))
    };
    let free = view.site.hold_points().chain(view.site.parks()).filter(has_seat);
    let far = |bay: WaypointIx| {
        let there_mm = view.router.distance_mm(here, bay)?;
        Some((there_mm + view.router.distance_mm(bay, goal)?, bay))
    };
    let mut bays: Vec<(u64, WaypointIx)> = free.filter_map(far).collect();
    bays.sort_unstable_by_key(|(way_mm, bay)| (view.site.standing_at(*bay) != seat_aside, *way_mm, *bay));
    bays.into_iter().take(limits::BAYS_TRIED_MAX).map(|(_, bay)| bay).collect()
}

fn stands_in(view: &FleetProjection, robot_id: &RobotId, place: PlaceIx) -> bool {
    let id = &view.site.place(place).place_id;
    view.places.get(id.as_str()).and_then(|p| p.row.holder(robot_id)).is_some_and(|h| h.state == HolderState::Inside)
}
