//! Keeps the starting places of the site for robots that have not been heard yet.
//!
//! Invariant: such a place counts as taken for every other robot: no grant, no errand, no seat of its area. It is no row, so nothing is ever
//! given back: a robot is awaited until its first settled heartbeat was compared with the rows, which then say where it stands.
//! Called by `grants`, by errands and by the explanations.

use crate::fleet::projection::rows::Place;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::RobotId;
use crate::robot::Duty;
use crate::site::PlaceIx;

/// Whether nobody knows yet where the robot stands. A retired robot is not awaited.
fn is_awaited(view: &FleetProjection, robot_id: &RobotId) -> bool {
    let holds = view.held_places.get(robot_id).is_some_and(|places| !places.is_empty());
    let duty = view.control.get(robot_id.as_str()).map(|c| c.row.duty());
    !holds && !view.compared.contains_key(robot_id) && duty != Some(Duty::Retired)
}

/// Robots that start in the place and have not been heard yet, by name.
pub fn awaited(view: &FleetProjection, place: PlaceIx) -> impl Iterator<Item = &RobotId> {
    view.site.starting_in(place).iter().filter(|robot_id| is_awaited(view, robot_id))
}

/// All robots that have not been heard yet, with the standing place where each starts.
pub fn all_awaited(view: &FleetProjection) -> impl Iterator<Item = (&RobotId, PlaceIx)> {
    let starts = view.site.starts().iter();
    let placed = starts.filter_map(|(robot_id, at)| Some((robot_id, view.site.standing_at(*at)?)));
    placed.filter(|(robot_id, _)| is_awaited(view, robot_id))
}

/// Robots that the place must have room for beside `robot_id`: its holders, and those that it awaits.
pub fn taken(view: &FleetProjection, place: PlaceIx, row: &Place, robot_id: &RobotId) -> usize {
    row.holders.len() + awaited(view, place).filter(|other| *other != robot_id).count()
}

/// Whether `robot_id` may be admitted beside them.
pub fn has_room(view: &FleetProjection, place: PlaceIx, row: &Place, robot_id: &RobotId) -> bool {
    let is_free = taken(view, place, row, robot_id) < row.capacity as usize;
    row.quarantine.is_none() && (is_free || view.bugs.capacity_is_forgotten())
}
