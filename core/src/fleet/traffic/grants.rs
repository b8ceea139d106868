//! Whether places can be granted to a robot, and the grant of them: all that one stretch needs, or none.
//!
//! Invariant: a place has no more holders than seats, and an area admits one robot less than it has. Grants are traffic, never a safety function.

use super::anchor::next_generation;
use super::{blocked_places, engaged_stops, starts};
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::rows::{HolderState, PlaceBlock, PlaceHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{AreaId, PlaceId, RobotId};
use crate::limits;
use crate::site::{AreaIx, PlaceIx};
use std::collections::{BTreeMap, BTreeSet};

/// Grant ids of one generation: more than the places of any one stretch.
const GRANTS_PER_GENERATION: u64 = 1024;

/// What one round of grants knows beside the rows.
#[derive(Default)]
pub(super) struct Occupancy {
    /// Places that an earlier request waits for.
    blocked: BTreeSet<PlaceIx>,
    /// Places that nobody is let into.
    barred: BTreeSet<PlaceIx>,
    /// Robots that hold a standing place of an area, or start in one.
    inside: BTreeMap<AreaIx, BTreeSet<RobotId>>,
}

impl Occupancy {
    pub fn from_projection(view: &FleetProjection) -> Self {
        let mut occupancy = Self { barred: blocked_places::barred(view), ..Self::default() };
        let standing = view.site.places().iter().filter(|p| p.waypoint().is_some());
        for place in standing {
            let Some(row) = view.places.get(place.place_id.as_str()).map(|p| &p.row) else { continue };
            for holder in &row.holders {
                occupancy.enter(view, &holder.robot_id, place);
            }
        }
        for (robot_id, place) in starts::all_awaited(view) {
            occupancy.enter(view, robot_id, view.site.place(place));
        }
        occupancy
    }
    fn enter(&mut self, view: &FleetProjection, robot_id: &RobotId, place: &crate::site::Place) {
        let Some(area) = place.waypoint().map(|w| view.site.waypoint(w).area) else { return };
        self.inside.entry(area).or_default().insert(robot_id.clone());
    }

    /// Keeps these from later requests.
    pub fn block(&mut self, places: Vec<PlaceIx>) {
        self.blocked.extend(places);
    }

    /// An area admits one robot less than it has seats, so that those inside can move.
    fn admits(&self, view: &FleetProjection, robot_id: &RobotId, place: &crate::site::Place) -> bool {
        let Some(area) = place.waypoint().map(|w| view.site.waypoint(w).area) else { return true };
        let Some(inside) = self.inside.get(&area).filter(|inside| !inside.contains(robot_id)) else { return true };
        (inside.len() as u64) < view.site.area_capacity(area).saturating_sub(1).max(1)
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

/// Whether the robot can have all of them now.
pub(super) fn can_grant(view: &FleetProjection, robot_id: &RobotId, needed: &[PlaceIx], occupancy: &Occupancy) -> bool {
    let is_open = |place: &PlaceIx| !occupancy.barred.contains(place) || holds(view, robot_id, *place);
    needed.iter().all(is_open) && have_room(view, robot_id, needed, occupancy)
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
        if !occupancy.admits(view, robot_id, view.site.place(*ix)) {
            return false;
        }
        let place = view.places.get(view.site.place(*ix).place_id.as_str()).map(|p| &p.row);
        place.is_some_and(|p| match p.holder(robot_id) {
            Some(holder) => holder.state != HolderState::Revoking,
            None => starts::has_room(view, *ix, p, robot_id) && !occupancy.blocked.contains(ix),
        })
    })
}

/// Places that a request keeps free for itself. While there is no seat where it goes to, only that seat: who leaves the seat may need the same
/// passage. While the area there admits nobody, nothing: who is inside may need the seat.
pub(super) fn kept_free(
    view: &FleetProjection,
    robot_id: &RobotId,
    needed: &[PlaceIx],
    occupancy: &Occupancy,
) -> Vec<PlaceIx> {
    let place = |ix: &PlaceIx| view.site.place(*ix);
    if !needed.iter().all(|ix| occupancy.admits(view, robot_id, place(ix))) {
        return Vec::new();
    }
    let (seats, passages): (Vec<_>, Vec<_>) = needed.iter().partition(|ix| place(ix).waypoint().is_some());
    let is_barred = |ix: &PlaceIx| occupancy.blocked.contains(ix) || occupancy.barred.contains(ix);
    let is_free = |ix: &PlaceIx| has_seat(view, robot_id, *ix) && !is_barred(ix);
    if seats.iter().all(is_free) { [seats, passages].concat() } else { seats }
}

fn has_seat(view: &FleetProjection, robot_id: &RobotId, ix: PlaceIx) -> bool {
    let place = view.places.get(view.site.place(ix).place_id.as_str()).map(|p| &p.row);
    place.is_some_and(|p| p.holder(robot_id).is_some() || starts::has_room(view, ix, p, robot_id))
}

/// Writes the robot into each of them that it does not hold.
pub(super) fn grant_places(tx: &mut Tx, robot_id: &RobotId, needed: &[PlaceIx], occupancy: &mut Occupancy) {
    let first = next_generation(tx.view, robot_id, &tx.now) * GRANTS_PER_GENERATION;
    for (grant_id, ix) in (first..).zip(needed) {
        occupancy.enter(tx.view, robot_id, tx.view.site.place(*ix));
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
