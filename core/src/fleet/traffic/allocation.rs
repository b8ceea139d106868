//! Serves every robot that needs more of its route: all passages up to the next standing place are granted together with it, or nothing is.
//!
//! Invariants:
//! 1. A place is given on only by the robot's own report or by a person, never by time.
//! 2. A new stretch is granted only if all can go on behind it, see `safe_order`. A stretch that was released before needs no such check.
//! 3. A request that finds no room keeps the place that it goes to from later ones, and once that has a seat the passages on the way too. One
//!    that is refused for want of an order keeps nothing: others must go first.

use super::desired::{Release, Releases};
use super::grants::{self, Occupancy, Refused};
use super::safe_order::Mover;
use super::{bays, remaining_routes, rerouting, route_requests};
use crate::desired_state::Assignment;
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
    let mut occupancy = Occupancy::gather(view, board, &now, &requests);
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
        let free = needed.iter().copied().filter(|ix| grants::has_way(tx.view, robot_id, &[*ix], occupancy));
        let free: Vec<PlaceIx> = free.collect();
        grants::grant_places(tx, robot_id, &free, None, occupancy);
    }
    let after = released.and_then(|end| stand_at(tx, robot_id, &work, end as usize));
    let checked = match is_whole {
        true => grants::check_grant(tx.view, robot_id, &needed, after.as_ref(), occupancy),
        false if grants::can_grant_again(tx.view, robot_id, &needed, occupancy) => Ok(()),
        false => Err(Refused::NoRoom),
    };
    let Err(refused) = checked else {
        grants::grant_places(tx, robot_id, &needed, after, occupancy);
        tx.view.waits.remove(robot_id);
        tx.view.dirty.insert(robot_id.clone());
        if let Some(released_index) = released {
            releases.0.insert(robot_id.clone(), Release { route: None, released_index });
        }
        return;
    };
    if is_whole && rerouting::reroute(tx, live, &a, &work, &needed, releases) {
        return;
    }
    let since = note_waiting(tx, robot_id, &needed, &refused);
    // It asks for one stretch ahead: with way left before it, it does not stand for that.
    if !is_whole || route_requests::is_out_of_route(tx.view, live, &a) {
        note_wait(tx, robot_id, since);
    }
    if bays::step_aside(tx, &a, &work, releases, occupancy) {
        return;
    }
    match refused {
        Refused::Unsafe(_) => grants::note_refused(robot_id, occupancy),
        Refused::NoRoom if is_whole => {
            let kept = grants::kept_free(tx.view, robot_id, &needed, after.as_ref(), occupancy);
            occupancy.block(kept);
        }
        // A robot that lost places may stand in them.
        Refused::NoRoom => occupancy.block(needed),
    }
}

/// Where the robot stands once it has driven up to this index of its route.
fn stand_at(tx: &Tx, robot_id: &RobotId, work: &Assignment, end: usize) -> Option<Mover> {
    remaining_routes::on_route(&tx.view.site, &work.route, end, &remaining_routes::held(tx.view, robot_id))
}

/// Remembers what the robot waits for. Since when it does.
fn note_waiting(tx: &mut Tx, robot_id: &RobotId, needed: &[PlaceIx], refused: &Refused) -> SiteTime {
    let places = needed.iter().map(|p| tx.view.site.place(*p).place_id.clone()).collect();
    let for_order = match refused {
        Refused::NoRoom => None,
        Refused::Unsafe(robots) => Some(robots.clone()),
    };
    tx.view.place_waits += u64::from(!tx.view.waits.contains_key(robot_id));
    let since = tx.view.waits.get(robot_id).map_or(tx.now.site, |known| known.since);
    tx.view.waits.insert(robot_id.clone(), Waiting { places, for_order, since });
    since
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
