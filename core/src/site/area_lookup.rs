//! Finds the areas in which waypoints, tasks and places lie, to check rights that hold in some areas only.
//!
//! Invariant: no area is left out. What is not on the map lies in no area, and so needs a right over the whole site.

use super::{PlaceIx, Site};
use crate::ids::{AreaId, PlaceId, WaypointId};
use crate::task::TaskSpec;
use std::collections::BTreeSet;

impl Site {
    /// The area of a waypoint that is told by its name; none: it is not known, or not on the map.
    pub fn area_at(&self, waypoint: Option<&WaypointId>) -> Option<&AreaId> {
        Some(&self.area_of(self.find(waypoint?)?).area_id)
    }

    /// The areas of all goals of a task; none if it has no goal, or one that is not on the map.
    pub fn areas_of_task(&self, spec: &TaskSpec) -> BTreeSet<AreaId> {
        let areas: Option<BTreeSet<AreaId>> = spec.goals(0).map(|goal| self.area_at(Some(goal)).cloned()).collect();
        areas.unwrap_or_default()
    }

    /// The areas of a place: of a passage all that it leads through; none if the site does not have it.
    pub fn areas_of_place(&self, place_id: &PlaceId) -> BTreeSet<AreaId> {
        self.find_place(place_id).map(|at| self.areas_of_floor(at)).unwrap_or_default()
    }

    fn areas_of_floor(&self, at: PlaceIx) -> BTreeSet<AreaId> {
        let place = self.place(at);
        let inside = place.inside().into_iter();
        let ways = inside.flat_map(|inside| {
            let ends = inside.lanes.iter().map(|lane| self.lane(*lane)).flat_map(|lane| [lane.from, lane.to]);
            ends.chain(inside.waypoints.iter().copied())
        });
        place.waypoint().into_iter().chain(ways).map(|at| self.area_of(at).area_id.clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use crate::ids::{AreaId, PlaceId, WaypointId};
    use crate::site::{DEMO, Site, text};
    use std::collections::BTreeSet;

    fn demo() -> Site {
        text::parse(DEMO).expect("the demo reads")
    }

    #[test]
    fn a_standing_place_lies_in_the_area_of_its_waypoint_and_a_passage_in_all_that_it_leads_through() {
        let site = demo();
        let areas = |id: &str| site.areas_of_place(&PlaceId::parse(id).expect("an id"));
        let a01 = site.area_at(Some(&WaypointId::parse("A01").expect("a name"))).expect("an area").clone();
        assert_eq!(areas("A01"), BTreeSet::from([a01]));
        assert_eq!(areas("nowhere"), BTreeSet::new());
        for place in site.places() {
            assert!(!site.areas_of_place(&place.place_id).is_empty(), "{}", place.place_id);
        }
        assert!(areas("door").len() > 1, "{:?}", areas("door"));
    }

    #[test]
    fn what_is_not_on_the_map_lies_nowhere() {
        let site = demo();
        let gone = WaypointId::parse("gone").expect("a name");
        assert_eq!([site.area_at(None), site.area_at(Some(&gone))], [None::<&AreaId>; 2]);
    }
}
