//! Whether places can be granted to a robot, and the grant of them: all that one stretch needs, or none.
//!
//! Invariant: a place has no more holders than seats, and a stretch is granted only if `safe_order` finds that everybody can go on behind it.
//! Grants are traffic, never a safety function.

use super::anchor::next_generation;
use super::route_requests::Request;
use super::safe_order::{Mover, SafeOrder};
use super::{blocked_places, engaged_stops, remaining_routes, starts};
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::{HolderState, PlaceBlock, PlaceHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{AreaId, PlaceId, RobotId};
use crate::limits;
use crate::site::PlaceIx;
use crate::time::Now;
use std::collections::BTreeSet;

/// Grant ids of one generation: more than the places of any one stretch.
const GRANTS_PER_GENERATION: u64 = 1024;

/// What one round of grants knows beside the rows.
#[derive(Default)]
pub(super) struct Occupancy {
    /// Places that an earlier request waits for.
    blocked: BTreeSet<PlaceIx>,
    /// Places that nobody is let into.
    barred: BTreeSet<PlaceIx>,
    /// Where all robots go. None: nobody asks, or the site has no places.
    order: Option<SafeOrder>,
}

/// Why a stretch is not granted.
pub(super) enum Refused {
    /// A place has no seat for it, is kept for an earlier request, or admits nobody.
    NoRoom,
    /// Behind the grant there would be no order for these and the robot to go on; none: they are not known.
    Unsafe(Vec<RobotId>),
}

impl Occupancy {
    /// As the rows are now, for these requests in their order.
    pub fn gather(view: &FleetProjection, board: &Board, now: &Now, requests: &[Request]) -> Self {
        let barred = blocked_places::barred(view);
        let order = (!requests.is_empty() && !view.site.places().is_empty())
            .then(|| remaining_routes::gather(view, board, now, requests, &barred));
        Self { barred, order, ..Self::default() }
    }

    /// Keeps these from later requests.
    pub fn block(&mut self, places: Vec<PlaceIx>) {
        self.blocked.extend(places);
    }

    /// Whether the robot would leave a seat of the place to others that need one.
    pub fn is_spare(&self, place: PlaceIx) -> bool {
        self.order.as_ref().is_none_or(|order| order.is_spare(place))
    }

    /// The seat of the bay that the robot should go to, since in the order nobody goes on before it. None: it need not.
    pub fn seat_aside(&mut self, robot_id: &RobotId) -> Option<PlaceIx> {
        self.order.as_mut().and_then(|order| order.seat_aside(robot_id))
    }

    /// Checks that the robot may stand where a grant lets it drive to.
    fn check_order(&mut self, view: &FleetProjection, robot_id: &RobotId, after: &Mover) -> Result<(), Refused> {
        match &mut self.order {
            // The twin that forgets capacities knows of no order either.
            Some(order) if !view.bugs.capacity_is_forgotten() => {
                order.check_grant(robot_id, after).map_err(Refused::Unsafe)
            }
            _ => Ok(()),
        }
    }
}

/// Robots that hold a standing place in the area.
pub fn robots_in_area(view: &FleetProjection, area: &AreaId) -> BTreeSet<RobotId> {
    let inside = |id: &str| {
        let place = PlaceId::parse(id).ok().and_then(|p| view.site.find_place(&p)).map(|p| view.site.place(p));
        place.and_then(|p| p.waypoint()).is_some_and(|w| view.site.area_of(w).area_id == *area)
    };
    view.held_places.iter().filter(|(_, ids)| ids.iter().any(|id| inside(id))).map(|(r, _)| r.clone()).collect()
}

/// Whether the robot holds the place, or may enter it.
pub(super) fn holds(view: &FleetProjection, robot_id: &RobotId, place: PlaceIx) -> bool {
    let row = view.places.get(view.site.place(place).place_id.as_str());
    row.is_some_and(|place| place.row.holder(robot_id).is_some())
}

/// Whether the robot can have all of them now, whatever becomes of others.
pub(super) fn has_way(view: &FleetProjection, robot_id: &RobotId, needed: &[PlaceIx], occupancy: &Occupancy) -> bool {
    let is_open = |place: &PlaceIx| !occupancy.barred.contains(place) || holds(view, robot_id, *place);
    needed.iter().all(is_open) && have_room(view, robot_id, needed, occupancy)
}

/// Checks that the robot can have all of them now, and that all can go on once it stands `after` them.
///
/// # Errors
/// Why not.
pub(super) fn check_grant(
    view: &FleetProjection,
    robot_id: &RobotId,
    needed: &[PlaceIx],
    after: Option<&Mover>,
    occupancy: &mut Occupancy,
) -> Result<(), Refused> {
    if !has_way(view, robot_id, needed, occupancy) {
        return Err(Refused::NoRoom);
    }
    // Where nothing is reserved, nobody is kept from anything.
    match after.filter(|_| !needed.is_empty()) {
        Some(after) => occupancy.check_order(view, robot_id, after),
        None => Ok(()),
    }
}

/// The same of places on a stretch that was released to it already: a block since then takes nothing back, a fleet stop does.
pub(super) fn can_grant_again(
    view: &FleetProjection,
    robot_id: &RobotId,
    needed: &[PlaceIx],
    occupancy: &Occupancy,
) -> bool {
    let stopped = engaged_stops::closed(view);
    let is_open = |place: &PlaceIx| !stopped.contains(place) || holds(view, robot_id, *place);
    needed.iter().all(is_open) && have_room(view, robot_id, needed, occupancy)
}

fn have_room(view: &FleetProjection, robot_id: &RobotId, needed: &[PlaceIx], occupancy: &Occupancy) -> bool {
    let held = view.held_places.get(robot_id).map_or(0, BTreeSet::len);
    if held + needed.len() > limits::PLACES_OF_ROBOT_MAX {
        return false;
    }
    needed.iter().all(|ix| {
        if view.refused.is_place_aside(&view.site.place(*ix).place_id) {
            return false;
        }
        let place = view.places.get(view.site.place(*ix).place_id.as_str()).map(|p| &p.row);
        place.is_some_and(|p| match p.holder(robot_id) {
            Some(holder) => holder.state != HolderState::Revoking,
            None => starts::has_room(view, *ix, p, robot_id) && !occupancy.blocked.contains(ix),
        })
    })
}

/// Places that a refused request keeps free for itself.
///
/// While there is no seat where it goes to, only that seat: who leaves the seat may need the same passage. Nothing, if it could not have them
/// though all were free: others must go first then.
pub(super) fn kept_free(
    view: &FleetProjection,
    robot_id: &RobotId,
    needed: &[PlaceIx],
    after: Option<&Mover>,
    occupancy: &mut Occupancy,
) -> Vec<PlaceIx> {
    if occupancy.order.as_ref().is_some_and(|order| order.is_walled(robot_id)) {
        return Vec::new();
    }
    let is_seat = |ix: &PlaceIx| view.site.place(*ix).waypoint().is_some();
    let (seats, passages): (Vec<PlaceIx>, Vec<PlaceIx>) = needed.iter().copied().partition(is_seat);
    let is_barred = |ix: &PlaceIx| occupancy.blocked.contains(ix) || occupancy.barred.contains(ix);
    if !seats.iter().all(|ix| has_seat(view, robot_id, *ix) && !is_barred(ix)) {
        return seats;
    }
    match after.map_or(Ok(()), |after| occupancy.check_order(view, robot_id, after)) {
        Ok(()) => [seats, passages].concat(),
        Err(_) => Vec::new(),
    }
}

fn has_seat(view: &FleetProjection, robot_id: &RobotId, ix: PlaceIx) -> bool {
    let place = view.places.get(view.site.place(ix).place_id.as_str()).map(|p| &p.row);
    place.is_some_and(|p| p.holder(robot_id).is_some() || starts::has_room(view, ix, p, robot_id))
}

/// Notes that the robot was refused for want of an order.
pub(super) fn note_refused(robot_id: &RobotId, occupancy: &mut Occupancy) {
    if let Some(order) = &mut occupancy.order {
        order.note_refused(robot_id);
    }
}

/// Writes the robot into each of them that it does not hold. It stands `after` them then; none: on a stretch that it had before.
pub(super) fn grant_places(
    tx: &mut Tx,
    robot_id: &RobotId,
    needed: &[PlaceIx],
    after: Option<Mover>,
    occupancy: &mut Occupancy,
) {
    if let Some((order, after)) = occupancy.order.as_mut().zip(after) {
        order.note_grant(robot_id, after);
    }
    let first = next_generation(tx.view, robot_id, &tx.now) * GRANTS_PER_GENERATION;
    for (grant_id, ix) in (first..).zip(needed) {
        let id = tx.view.site.place(*ix).place_id.clone();
        let Some(mut place) = tx.view.places.get(id.as_str()).map(|p| p.row.clone()) else { continue };
        if place.holder(robot_id).is_none() {
            // A person may have blocked it by another process a moment ago.
            tx.rely::<PlaceBlock>(id.as_str());
            place.holders.push(PlaceHolder {
                robot_id: robot_id.clone(),
                grant_id,
                state: HolderState::Granted,
                since: tx.now.utc,
                claimed: false,
            });
            tx.put_row(place, "place.granted");
        }
    }
}
