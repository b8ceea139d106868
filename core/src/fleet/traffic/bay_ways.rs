//! Finds the bays near a waypoint, and the places that ways lead into.
//!
//! Invariant: the same site, closed places and ends give the same bays in the same order. At most [`limits::BAYS_LOOKED_AT_MAX`] are measured
//! for a waypoint, and [`limits::BAYS_TRIED_MAX`] found. It is made anew for each round of grants.

use crate::limits;
use crate::site::route::{Blocked, Router};
use crate::site::{PlaceIx, Site, WaypointIx};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;
use std::sync::Arc;

/// A hold point or parking place that a robot can wait in.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Bay {
    /// Its waypoint.
    pub at: WaypointIx,
    /// The standing place there.
    pub seat: PlaceIx,
    /// Places that the way to it leads into, the seat among them, ascending.
    pub way: Vec<PlaceIx>,
}

/// Ways on one site around places that are closed.
pub(super) struct BayWays {
    site: Arc<Site>,
    router: Arc<Router>,
    closed: Blocked,
    near: RefCell<BTreeMap<WaypointIx, Rc<[Bay]>>>,
}

impl BayWays {
    /// Nothing was looked for yet.
    pub fn new(site: Arc<Site>, router: Arc<Router>, closed: Blocked) -> Self {
        Self { site, router, closed, near: RefCell::default() }
    }

    /// The bays nearest to a waypoint by their ways, the nearest first; of those equally far the one that comes first in the site.
    pub fn find_near(&self, from: WaypointIx) -> Rc<[Bay]> {
        if let Some(known) = self.near.borrow().get(&from) {
            return known.clone();
        }
        let found: Rc<[Bay]> = self.measure_bays(from).into();
        self.near.borrow_mut().insert(from, found.clone());
        found
    }

    /// Places that the way from a waypoint through goals in turn leads into, ascending. None: no lanes lead there.
    pub fn find_places(&self, from: WaypointIx, goals: &[WaypointIx]) -> Option<Vec<PlaceIx>> {
        let mut all = BTreeSet::new();
        let mut at = from;
        for goal in goals {
            let around = self.router.route_around(at, *goal, &self.closed);
            all.extend(places_on(&self.site, &around.or_else(|| self.router.route(at, *goal))?));
            at = *goal;
        }
        Some(all.into_iter().collect())
    }

    /// The standing place at a waypoint.
    pub fn find_seat(&self, at: WaypointIx) -> Option<PlaceIx> {
        self.site.standing_at(at)
    }

    fn measure_bays(&self, from: WaypointIx) -> Vec<Bay> {
        let here = self.site.waypoint(from);
        let beeline = |at: &WaypointIx| {
            let there = self.site.waypoint(*at);
            (there.x_mm.abs_diff(here.x_mm) + there.y_mm.abs_diff(here.y_mm), *at)
        };
        let bays = self.site.hold_points().chain(self.site.parks()).filter(|at| *at != from);
        let mut bays: Vec<WaypointIx> = bays.collect();
        bays.sort_unstable_by_key(beeline);
        bays.truncate(limits::BAYS_LOOKED_AT_MAX);
        let far = |at: WaypointIx| Some((self.router.field_around(at, &self.closed).distance_mm(from)?, at));
        let mut reached: Vec<_> = bays.into_iter().filter_map(far).collect();
        reached.sort_unstable();
        reached.truncate(limits::BAYS_TRIED_MAX);
        let bay = |(_, at): (u64, WaypointIx)| {
            let way = self.find_places(from, &[at])?;
            Some(Bay { at, seat: self.site.standing_at(at)?, way })
        };
        reached.into_iter().filter_map(bay).collect()
    }
}

/// Places that a way leads into behind its first waypoint.
pub(super) fn places_on(site: &Site, way: &[WaypointIx]) -> BTreeSet<PlaceIx> {
    let lanes = way.windows(2);
    lanes
        .flat_map(|pair| site.passages_of_lane(pair[0], pair[1]).iter().copied().chain(site.standing_at(pair[1])))
        .collect()
}
