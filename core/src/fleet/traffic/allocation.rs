//! Serves every robot that needs more of its route: all passages up to the next standing place are granted together with it, or nothing is.
//!
//! Invariant: a place is given on only by the robot's own report or by a person, never by time. A request that cannot be served keeps the place
//! that it goes to from later ones, and once that has a seat the passages on the way too.

use super::desired::{Release, Releases};
use super::grants::{self, Occupancy};
use super::{bays, rerouting, route_requests};
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::memory::Waiting;
use crate::fleet::projection::rows::RobotControl;
use crate::fleet::projection::state::FleetProjection;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::RobotId;
use crate::limits;
use crate::site::PlaceIx;
use crate::time::{Now, SiteTime, Utc};

/// Grants places to all robots that wait, in queue order. Each grant is an item of its own.
pub fn allocate_places(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) -> Releases {
    let requests = route_requests::in_order(view, board, &now);
    let mut releases = Releases::default();
    let mut occupancy = if requests.is_empty() { Occupancy::default() } else { Occupancy::from_projection(view) };
    for request in &requests {
        if plan.is_cut() {
            break;
        }
        let Some(live) = board.get(&request.robot_id) else { continue };
        plan.decide(view, now, "fleet", |tx| allocate(tx, live, &mut releases, &mut occupancy));
    }
    plan.report.tally.waiting_for_place = view.waits.len() as u64;
    releases
}

fn allocate(tx: &mut Tx, live: &NewestHeartbeat, releases: &mut Releases, occupancy: &mut Occupancy) {
    let robot_id = &live.robot_id;
    let Some(a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned() else { return };
    let Some(work) = route_requests::assignment(tx.view, robot_id, &a).cloned() else { return };
    let lost = route_requests::missing(tx.view, live, &a);
    let is_whole = lost.is_empty();
    let (needed, released) = match route_requests::next_segment(tx.view, robot_id, &a, &work) {
        _ if !is_whole => (lost, None),
        Some(segment) => (segment.places(), Some(segment.end as u32)),
        None => return,
    };
    if tx.view.bugs.grants_one_by_one() {
        let free = needed.iter().copied().filter(|ix| grants::can_grant(tx.view, robot_id, &[*ix], occupancy));
        let free: Vec<PlaceIx> = free.collect();
        grants::grant_places(tx, robot_id, &free, occupancy);
    }
    let can_grant = match is_whole {
        true => grants::can_grant(tx.view, robot_id, &needed, occupancy),
        false => grants::can_grant_again(tx.view, robot_id, &needed, occupancy),
    };
    if can_grant {
        grants::grant_places(tx, robot_id, &needed, occupancy);
        tx.view.waits.remove(robot_id);
        tx.view.dirty.insert(robot_id.clone());
        if let Some(released_index) = released {
            releases.0.insert(robot_id.clone(), Release { route: None, released_index });
        }
        return;
    }
    if is_whole && rerouting::reroute(tx, live, &a, &work, &needed, releases) {
        return;
    }
    let names = needed.iter().map(|p| tx.view.site.place(*p).place_id.clone()).collect();
    let now = tx.now.site;
    tx.view.place_waits += u64::from(!tx.view.waits.contains_key(robot_id));
    let since = tx.view.waits.entry(robot_id.clone()).or_insert(Waiting { places: Vec::new(), since: now }).since;
    tx.view.waits.insert(robot_id.clone(), Waiting { places: names, since });
    // It asks for one stretch ahead: with way left before it, it does not stand for that.
    if !is_whole || route_requests::is_out_of_route(tx.view, live, &a) {
        note_wait(tx, robot_id, since);
    }
    if bays::step_aside(tx, &a, &work, since, releases, occupancy) {
        return;
    }
    // A robot that lost places may stand in them.
    let kept = if is_whole { grants::kept_free(tx.view, robot_id, &needed, occupancy) } else { needed };
    occupancy.block(kept);
}

/// Writes down once a minute that the robot stands for a place: who judges its software must not blame it for that.
fn note_wait(tx: &mut Tx, robot_id: &RobotId, since: SiteTime) {
    let is_long = tx.now.site.since(since) >= limits::PLACE_WAIT_NOTED;
    let Some(control) = tx.view.control.get(robot_id.as_str()).map(|c| &c.row).filter(|_| is_long) else { return };
    let is_noted = |at: Utc| tx.now.ms_since(at) < limits::PLACE_WAIT_NOTED.as_ms();
    if !control.waited_for_place.is_some_and(is_noted) {
        let control = RobotControl { waited_for_place: Some(tx.now.utc), ..control.clone() };
        tx.put_row(control, "robot.waits");
    }
}
