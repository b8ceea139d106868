//! The only way into a [`Site`]: names and numbers as read, checked all together. Called by the text format and the imports.

use super::map::{
    Area, AreaDefaults, AreaIx, Inside, Kind, Lane, LaneIx, Place, PlaceExtent, PlaceIx, PlaceRule, Site, Source,
    Waypoint, WaypointIx,
};
use crate::ids::{AreaId, PlaceId, RobotId, SiteId, WaypointId};
use crate::limits::{
    MAP_VERSION_BYTES, SITE_AREAS_MAX, SITE_LANES_MAX, SITE_PLACES_MAX, SITE_ROBOTS_MAX, SITE_WAYPOINTS_MAX,
};
use crate::reason::{Refusal, Violations};
use std::collections::{BTreeMap, BTreeSet};

/// Coordinates up to this far from the origin, millimetres: 1,000 km.
const REACH_MM: i64 = 1_000_000_000;
/// Capacity of one place.
const CAPACITY_MAX: u32 = 10_000;

/// An area as read. `field` is what a violation is listed under.
pub(super) struct DraftArea {
    pub field: String,
    pub id: String,
    pub people: bool,
    pub defaults: AreaDefaults,
}

/// A waypoint as read. `area: None` is the first area; `capacity: None` is 1; `reserved: false` gives it no place.
pub(super) struct DraftWaypoint {
    pub field: String,
    pub id: String,
    pub x_mm: i64,
    pub y_mm: i64,
    pub area: Option<String>,
    pub kind: Kind,
    pub capacity: Option<u32>,
    pub reserved: bool,
}

/// One directed lane as read. `length_mm: None` is the straight line.
pub(super) struct DraftLane {
    pub field: String,
    pub from: String,
    pub to: String,
    pub length_mm: Option<u32>,
    pub speed_limit_mm_s: Option<u32>,
    pub wide: bool,
}

/// A passage as read. `capacity: None` is EXCLUSIVE.
pub(super) struct DraftPassage {
    pub field: String,
    pub id: String,
    pub capacity: Option<u32>,
    pub lanes: Vec<(String, String)>,
    pub waypoints: Vec<String>,
}

/// A robot as read, and the waypoint where it starts.
pub(super) struct DraftRobot {
    pub field: String,
    pub id: String,
    pub at: String,
}

/// A whole site as read.
pub(super) struct Draft {
    pub site_id: String,
    pub name: String,
    pub map_id: String,
    pub map_version: String,
    pub source: Source,
    pub collisions_modelled: bool,
    pub areas: Vec<DraftArea>,
    pub waypoints: Vec<DraftWaypoint>,
    pub lanes: Vec<DraftLane>,
    pub passages: Vec<DraftPassage>,
    pub robots: Vec<DraftRobot>,
}

impl Draft {
    /// Checks everything; `found` may already hold what the reader noted.
    pub fn build(self, mut found: Violations) -> Result<Site, Refusal> {
        let v = &mut found;
        let site_id = v.accept("site_id", SiteId::parse(&self.site_id));
        check_text(v, "name", &self.name, 200);
        check_text(v, "map_id", &self.map_id, 64);
        check_text(v, "map_version", &self.map_version, MAP_VERSION_BYTES);
        check_count(v, "area", self.areas.len(), 1, SITE_AREAS_MAX);
        check_count(v, "waypoint", self.waypoints.len(), 1, SITE_WAYPOINTS_MAX);
        check_count(v, "lane", self.lanes.len(), 0, SITE_LANES_MAX);
        let areas = build_areas(v, self.areas);
        let (waypoints, waypoint_names, capacities) = build_waypoints(v, self.waypoints, &areas);
        let lanes = build_lanes(v, self.lanes, &waypoints, &waypoint_names);
        let passages = build_passages(v, self.passages, &waypoint_names, &lanes);
        let mut kinds: BTreeMap<Kind, Vec<WaypointIx>> = BTreeMap::new();
        for (at, waypoint) in waypoints.iter().enumerate() {
            kinds.entry(waypoint.kind).or_default().push(WaypointIx(at as u32));
        }
        let mut site = Site {
            site_id: site_id.unwrap_or_else(nowhere),
            name: self.name,
            map_id: self.map_id,
            map_version: self.map_version,
            source: self.source,
            collisions_modelled: self.collisions_modelled,
            areas,
            leaving: Vec::new(),
            arriving: Vec::new(),
            arriving_at: Vec::new(),
            waypoints,
            kinds,
            shortest_lane_mm: lanes.iter().map(|lane| lane.length_mm).min().unwrap_or(1).max(1),
            lanes,
            places: passages,
            waypoint_names,
            place_names: BTreeMap::new(),
            starts: BTreeMap::new(),
            starting: BTreeMap::new(),
        };
        add_standing_places(v, &mut site, &capacities);
        add_starts(v, &mut site, self.robots);
        check_count(v, "place", site.places.len(), 0, SITE_PLACES_MAX);
        check_nothing_stands_inside(v, &site);
        found.finish()?;
        index_lanes(&mut site);
        Ok(site)
    }
}

impl Site {
    /// The same site whose robots start here instead, and nowhere else.
    ///
    /// # Errors
    /// The rules for `robot` in a site file.
    pub fn with_starts(mut self, robots: &[(RobotId, WaypointId)]) -> Result<Self, Refusal> {
        self.starts.clear();
        self.starting.clear();
        let draft = |(id, at): &(RobotId, WaypointId)| DraftRobot {
            field: "robot".to_owned(),
            id: id.to_string(),
            at: at.to_string(),
        };
        let mut violations = Violations::default();
        add_starts(&mut violations, &mut self, robots.iter().map(draft).collect());
        violations.finish()?;
        Ok(self)
    }
}

/// Stands in for a name that was refused; the draft ends in an error then.
#[expect(clippy::expect_used, reason = "the text is a constant that keeps the rule")]
fn nowhere() -> SiteId {
    SiteId::parse("nowhere").expect("a valid site_id")
}

fn check_text(v: &mut Violations, field: &str, text: &str, most: usize) {
    if text.is_empty() || text.len() > most || text.chars().any(char::is_control) {
        v.add(field, format!("must be 1-{most} bytes without control characters"));
    }
}

fn check_count(v: &mut Violations, field: &str, count: usize, least: usize, most: usize) {
    if count < least || count > most {
        v.add(field, format!("there must be {least}..{most} of them, not {count}"));
    }
}

fn check_speed(v: &mut Violations, field: &str, speed: Option<u32>) {
    if speed.is_some_and(|s| !(50..=5_000).contains(&s)) {
        v.add(format!("{field}.speed_limit_mm_s"), "must be 50..5000 mm/s");
    }
}

fn build_areas(v: &mut Violations, drafts: Vec<DraftArea>) -> Vec<Area> {
    let mut areas: Vec<Area> = Vec::new();
    for draft in drafts {
        let Some(area_id) = v.accept(&format!("{}.id", draft.field), AreaId::parse(&draft.id)) else { continue };
        if areas.iter().any(|a| a.area_id == area_id) {
            v.add(format!("{}.id", draft.field), format!("area {area_id} is there twice"));
            continue;
        }
        let area = Area { area_id, people: draft.people, defaults: draft.defaults };
        area.policy().check(&draft.field, v);
        areas.push(area);
    }
    areas
}

type Names = BTreeMap<WaypointId, WaypointIx>;

fn build_waypoints(v: &mut Violations, drafts: Vec<DraftWaypoint>, areas: &[Area]) -> (Vec<Waypoint>, Names, Vec<u32>) {
    let (mut waypoints, mut names, mut capacities) = (Vec::new(), Names::new(), Vec::new());
    for draft in drafts {
        let field = &draft.field;
        let Some(waypoint_id) = v.accept(&format!("{field}.id"), WaypointId::parse(&draft.id)) else { continue };
        if names.insert(waypoint_id.clone(), WaypointIx(waypoints.len() as u32)).is_some() {
            v.add(format!("{field}.id"), format!("waypoint {waypoint_id} is there twice"));
        }
        if draft.x_mm.abs() > REACH_MM || draft.y_mm.abs() > REACH_MM {
            v.add(format!("{field}.at"), format!("must lie within {REACH_MM} mm of the origin"));
        }
        let area = match &draft.area {
            None => Some(0),
            Some(name) => areas.iter().position(|a| a.area_id.as_str() == name),
        };
        if area.is_none() {
            v.add(format!("{field}.area"), format!("there is no area {}", draft.area.as_deref().unwrap_or_default()));
        }
        let stands = draft.reserved && draft.kind != Kind::Junction;
        if draft.capacity.is_some() && !stands {
            v.add(format!("{field}.capacity"), "only a station, charger, park or hold has a capacity");
        }
        let capacity = draft.capacity.unwrap_or(1);
        if capacity == 0 || capacity > CAPACITY_MAX {
            v.add(format!("{field}.capacity"), format!("must be 1..{CAPACITY_MAX}"));
        }
        capacities.push(if stands { capacity } else { 0 });
        waypoints.push(Waypoint {
            waypoint_id,
            x_mm: draft.x_mm,
            y_mm: draft.y_mm,
            area: AreaIx(area.unwrap_or(0) as u32),
            kind: draft.kind,
            standing: None,
        });
    }
    (waypoints, names, capacities)
}

fn find(v: &mut Violations, field: &str, names: &Names, name: &str) -> Option<WaypointIx> {
    let found = WaypointId::parse(name).ok().and_then(|id| names.get(&id).copied());
    if found.is_none() {
        v.add(field, format!("there is no waypoint {name:?}"));
    }
    found
}

fn build_lanes(v: &mut Violations, drafts: Vec<DraftLane>, waypoints: &[Waypoint], names: &Names) -> Vec<Lane> {
    let mut lanes = Vec::new();
    let mut seen = BTreeSet::new();
    for draft in drafts {
        let field = &draft.field;
        check_speed(v, field, draft.speed_limit_mm_s);
        let ends = (find(v, field, names, &draft.from), find(v, field, names, &draft.to));
        let (Some(from), Some(to)) = ends else { continue };
        if from == to {
            v.add(field, format!("a lane from {} to itself", draft.from));
            continue;
        }
        if !seen.insert((from, to)) {
            v.add(field, format!("the lane {} -> {} is there twice", draft.from, draft.to));
            continue;
        }
        let (a, b) = (&waypoints[from.at()], &waypoints[to.at()]);
        let straight = ((a.x_mm - b.x_mm) as f64).hypot((a.y_mm - b.y_mm) as f64).round() as u32;
        let length_mm = draft.length_mm.unwrap_or(straight.max(1));
        if length_mm == 0 || u64::from(length_mm) + 1 < u64::from(straight) {
            v.add(format!("{field}.length_mm"), format!("must be at least the straight line, {straight} mm"));
        }
        let (speed_limit_mm_s, wide) = (draft.speed_limit_mm_s, draft.wide);
        lanes.push(Lane { from, to, length_mm, speed_limit_mm_s, wide, passages: Box::default() });
    }
    lanes.sort_by_key(|l| (l.from, l.to));
    lanes
}

fn build_passages(v: &mut Violations, drafts: Vec<DraftPassage>, names: &Names, lanes: &[Lane]) -> Vec<Place> {
    let mut places = Vec::new();
    for draft in drafts {
        let field = &draft.field;
        let Some(place_id) = v.accept(&format!("{field}.id"), PlaceId::parse(&draft.id)) else { continue };
        if draft.capacity.is_some_and(|c| c == 0 || c > CAPACITY_MAX) {
            v.add(format!("{field}.capacity"), format!("must be 1..{CAPACITY_MAX}"));
        }
        let waypoint_field = format!("{field}.waypoints");
        let inner: BTreeSet<_> =
            draft.waypoints.iter().filter_map(|name| find(v, &waypoint_field, names, name)).collect();
        let mut inside = BTreeSet::new();
        for (from, to) in &draft.lanes {
            let lane_field = format!("{field}.lanes");
            let ends = (find(v, &lane_field, names, from), find(v, &lane_field, names, to));
            let (Some(a), Some(b)) = ends else { continue };
            match lanes.binary_search_by_key(&(a, b), |l| (l.from, l.to)) {
                Ok(at) => drop(inside.insert(LaneIx(at as u32))),
                Err(_) => v.add(lane_field, format!("there is no lane {from} -> {to}")),
            }
        }
        if !inner.is_empty() {
            let touching = lanes.iter().enumerate().filter(|(_, l)| inner.contains(&l.from) || inner.contains(&l.to));
            inside.extend(touching.map(|(i, _)| LaneIx(i as u32)));
        }
        if inside.is_empty() {
            v.add(field, "a passage needs lanes, or waypoints with lanes, inside");
        }
        let inside = Inside { lanes: inside.into_iter().collect(), waypoints: inner.into_iter().collect() };
        let (rule, capacity) = match draft.capacity {
            None => (PlaceRule::Exclusive, 1),
            Some(n) => (PlaceRule::Capacity, n),
        };
        places.push(Place { place_id, extent: PlaceExtent::Passage(inside), rule, capacity });
    }
    places
}

/// Gives every standing waypoint its place, after the passages; notes names that are there twice.
fn add_standing_places(v: &mut Violations, site: &mut Site, capacities: &[u32]) {
    for (at, capacity) in capacities.iter().enumerate().filter(|(_, c)| **c > 0) {
        let name = site.waypoints[at].waypoint_id.as_str();
        let Some(place_id) = v.accept("waypoint.id", PlaceId::parse(name)) else { continue };
        site.waypoints[at].standing = Some(PlaceIx(site.places.len() as u32));
        let extent = PlaceExtent::Standing(WaypointIx(at as u32));
        let rule = if *capacity == 1 { PlaceRule::Exclusive } else { PlaceRule::Capacity };
        site.places.push(Place { place_id, extent, rule, capacity: *capacity });
    }
    for (at, place) in site.places.iter().enumerate() {
        if site.place_names.insert(place.place_id.clone(), PlaceIx(at as u32)).is_some() {
            v.add("passage.id", format!("two places are called {}", place.place_id));
        }
    }
}

/// Gives robots their starting places. Where places are reserved, each must be one, and no more robots start there than it holds.
pub(super) fn add_starts(v: &mut Violations, site: &mut Site, robots: Vec<DraftRobot>) {
    check_count(v, "robot", robots.len(), 0, SITE_ROBOTS_MAX);
    for DraftRobot { field, id, at } in robots {
        let Some(robot_id) = v.accept(&format!("{field}.id"), RobotId::parse(&id)) else { continue };
        let Some(waypoint) = find(v, &format!("{field}.at"), &site.waypoint_names, &at) else { continue };
        if site.starts.insert(robot_id.clone(), waypoint).is_some() {
            v.add(format!("{field}.id"), format!("robot {robot_id} is there twice"));
            continue;
        }
        let Some(place) = site.standing_at(waypoint) else {
            if site.collisions_modelled {
                v.add(format!("{field}.at"), format!("{at} is no place to stand: a station, charger, park or hold is"));
            }
            continue;
        };
        let capacity = site.place(place).capacity;
        let starting = site.starting.entry(place).or_default();
        starting.push(robot_id);
        if starting.len() > capacity as usize {
            v.add(format!("{field}.at"), format!("{at} holds {capacity}, and more robots start there"));
        }
    }
}

fn check_nothing_stands_inside(v: &mut Violations, site: &Site) {
    for place in &site.places {
        for at in place.inside().into_iter().flat_map(|i| &i.waypoints) {
            if site.is_standing(*at) {
                v.add(
                    "passage.waypoints",
                    format!(
                        "{} is a standing place and cannot lie inside passage {}",
                        site.name_of(*at),
                        place.place_id
                    ),
                );
            }
        }
    }
}

fn index_lanes(site: &mut Site) {
    let mut passages: Vec<Vec<PlaceIx>> = vec![Vec::new(); site.lanes.len()];
    for (at, place) in site.places.iter().enumerate() {
        for lane in place.inside().into_iter().flat_map(|i| &i.lanes) {
            passages[lane.at()].push(PlaceIx(at as u32));
        }
    }
    for (lane, inside) in site.lanes.iter_mut().zip(passages) {
        lane.passages = inside.into_boxed_slice();
    }
    let count = site.waypoints.len();
    let starts = |ends: &mut dyn Iterator<Item = WaypointIx>| {
        let mut table = vec![0_u32; count + 1];
        ends.for_each(|w| table[w.at() + 1] += 1);
        for at in 0..count {
            table[at + 1] += table[at];
        }
        table
    };
    site.leaving = starts(&mut site.lanes.iter().map(|l| l.from));
    site.arriving_at = starts(&mut site.lanes.iter().map(|l| l.to));
    site.arriving = (0..site.lanes.len() as u32).map(LaneIx).collect();
    site.arriving.sort_by_key(|l| (site.lanes[l.at()].to, site.lanes[l.at()].from));
}
