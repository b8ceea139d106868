//! What each robot holds at the end of its released stretch and needs of its remaining route, gathered once for a round of grants.
//!
//! Invariant: who does not drive now is a wall at all that it holds, and what is left of its route is still needed: it may drive again. A robot
//! without work that the planner would park is none, since it leaves its place as soon as there is another.

use super::bay_ways::BayWays;
use super::route_requests::{self, Request};
use super::safe_order::{Mover, SafeOrder};
use super::{engaged_stops, routing, starts};
use crate::desired_state::RoutePoint;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::state::{self, FleetProjection};
use crate::fleet::tasks::{eligibility, plausible};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::presence::Presence;
use crate::site::{Kind, PlaceIx, Site, WaypointIx};
use crate::task::{Attempt, AttemptPhase};
use crate::time::Now;
use std::collections::BTreeSet;

/// All robots that hold a place or are at work: those that ask in their order, then the others by name. `barred`: places that nobody is let into.
pub(super) fn gather(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    requests: &[Request],
    barred: &BTreeSet<PlaceIx>,
) -> SafeOrder {
    let asking: BTreeSet<&RobotId> = requests.iter().map(|request| &request.robot_id).collect();
    let at_work = view.robots_at_work().map(|(robot_id, _)| robot_id);
    let others: BTreeSet<&RobotId> = at_work.chain(view.held_places.keys()).filter(|id| !asking.contains(id)).collect();
    let in_order = requests.iter().map(|request| &request.robot_id).chain(others);
    let movers = in_order.map(|robot_id| (robot_id.clone(), find_mover(view, board, now, robot_id))).collect();
    let bays = BayWays::new(view.site.clone(), view.router.clone(), routing::closed(view).clone());
    SafeOrder::new(bays, count_seats(view, barred), movers)
}

/// Where the robot stands once it has driven up to an index of this route. `held`: places that it holds now.
pub(super) fn on_route(site: &Site, route: &[RoutePoint], released: usize, held: &[PlaceIx]) -> Option<Mover> {
    let way = routing::indices(site, route)?;
    let ahead = route.iter().zip(&way).skip(released + 1);
    let goals: Vec<WaypointIx> = ahead.filter(|(point, _)| point.ends_step.is_some()).map(|(_, at)| *at).collect();
    Mover::on_route(site, &way, released, goals, held)
}

/// Places that the robot holds, ascending.
pub(super) fn held(view: &FleetProjection, robot_id: &RobotId) -> Vec<PlaceIx> {
    let places = state::held(view, robot_id).filter_map(|(place, _)| view.site.find_place(&place.place_id));
    places.collect::<BTreeSet<_>>().into_iter().collect()
}

/// Seats of each place, none of one that nobody is let into, and how many are kept for robots that start there and were not heard yet.
fn count_seats(view: &FleetProjection, barred: &BTreeSet<PlaceIx>) -> Vec<(u32, u32)> {
    let mut seats: Vec<(u32, u32)> = vec![(0, 0); view.site.places().len()];
    for row in view.places.values().map(|place| &place.row) {
        let Some(ix) = view.site.find_place(&row.place_id) else { continue };
        let is_open = row.quarantine.is_none() && !barred.contains(&ix) && !view.refused.is_place_aside(&row.place_id);
        seats[ix.at()].0 = if is_open { row.capacity } else { 0 };
    }
    for (_, ix) in starts::all_awaited(view) {
        seats[ix.at()].1 += 1;
    }
    seats
}

fn find_mover(view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId) -> Mover {
    let held = held(view, robot_id);
    let live = board.get(robot_id).map(|live| &**live).filter(|live| plausible::keeps_back(view, live).is_ok());
    let attempt = view.held_by(robot_id).and_then(|id| view.attempt(id));
    let wall = |mover: Mover| Mover { is_wall: true, ..mover };
    let Some(a) = attempt.filter(|a| a.phase != AttemptPhase::Offered) else {
        let at = live.filter(|live| would_park(view, board, now, live));
        let at = at.and_then(|live| routing::find(view, live.report.vitals.waypoint.as_ref()));
        let leaves = at.is_some_and(|at| !matches!(view.site.waypoint(at).kind, Kind::Park | Kind::Charger));
        let mover = Mover::standing(at, held);
        return if leaves { mover } else { wall(mover) };
    };
    let on_route = find_route(view, a, &held);
    match live.filter(|live| route_requests::may_drive(view, a, live, board, now) && can_move(view, live)) {
        Some(live) => {
            on_route.unwrap_or_else(|| Mover::standing(routing::find(view, live.report.vitals.waypoint.as_ref()), held))
        }
        None => {
            let is_over = a.phase.is_terminal();
            let route = on_route.filter(|_| !is_over).unwrap_or_default();
            wall(Mover { here: held, ..route })
        }
    }
}

fn find_route(view: &FleetProjection, a: &Attempt, held: &[PlaceIx]) -> Option<Mover> {
    let work = route_requests::assignment(view, &a.robot_id, a)?;
    on_route(&view.site, &work.route, work.released_index.unwrap_or(0) as usize, held)
}

/// Whether nothing that the robot says of itself, and no fleet stop, keeps it where it is.
fn can_move(view: &FleetProjection, live: &NewestHeartbeat) -> bool {
    eligibility::reported(live).is_ok() && engaged_stops::check_stops(view, &live.robot_id, Some(live)).is_ok()
}

/// Whether a robot without work would take an errand.
fn would_park(view: &FleetProjection, board: &Board, now: &Now, live: &NewestHeartbeat) -> bool {
    let robot_id = &live.robot_id;
    let is_held = view.desired_work.get(robot_id.as_str()).is_some_and(|desired| desired.row.held);
    let is_unwilling = view.unwilling.get(robot_id).is_some_and(|until| now.link < *until);
    liveness::presence(board, robot_id, now) == Presence::Online
        && view.site.collisions_modelled()
        && !is_held
        && !is_unwilling
        && view.drain_of(robot_id).is_none()
        && eligibility::decided_by_people(view, robot_id, Some(live)).is_ok()
        && can_move(view, live)
}
