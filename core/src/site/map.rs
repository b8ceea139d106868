//! The waypoints, lanes, places and areas of one site, as they are looked up.

use crate::ids::{AreaId, PlaceId, RobotId, SiteId, WaypointId};
use crate::limits;
use crate::policy::{AreaPolicy, SoftwareRules};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

macro_rules! index {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub u32);
        impl $name {
            /// As a subscript.
            pub const fn at(self) -> usize {
                self.0 as usize
            }
        }
    };
}
index!(/// A waypoint of one [`Site`]; means nothing for another.
    WaypointIx);
index!(/// A lane of one [`Site`].
    LaneIx);
index!(/// A place of one [`Site`].
    PlaceIx);
index!(/// An area of one [`Site`].
    AreaIx);

/// What a waypoint is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// Only to drive over.
    Junction,
    /// Items are picked up and put down here.
    Station,
    /// Batteries are charged here.
    Charger,
    /// Robots without work stand here.
    Park,
    /// Robots wait here on their way.
    Hold,
}

impl Kind {
    /// The word in site files.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Junction => "junction",
            Self::Station => "station",
            Self::Charger => "charger",
            Self::Park => "park",
            Self::Hold => "hold",
        }
    }
}

/// A point that routes are made of.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Waypoint {
    /// Its name, unique in the site.
    pub waypoint_id: WaypointId,
    /// East, millimetres in the site's frame.
    pub x_mm: i64,
    /// North, millimetres in the site's frame.
    pub y_mm: i64,
    /// The one area it lies in.
    pub area: AreaIx,
    /// What it is for.
    pub kind: Kind,
    /// The standing place at it; none where nothing is reserved (junctions, imported grids).
    pub standing: Option<PlaceIx>,
}

/// A directed way from one waypoint to another. Two directions are two lanes.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Lane {
    /// Where it begins.
    pub from: WaypointIx,
    /// Where it ends.
    pub to: WaypointIx,
    /// Millimetres to drive; at least 1.
    pub length_mm: u32,
    /// Speed limit of the lane itself, millimetres per second.
    pub speed_limit_mm_s: Option<u32>,
    /// The opposite lane lies beside this one, so that robots can meet.
    pub wide: bool,
    /// Passages that a robot on this lane is inside of, ascending.
    pub passages: Box<[PlaceIx]>,
}

/// What a place is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlaceKind {
    /// Driven through.
    Passage,
    /// Stood on: reserved before a route is released to it.
    Standing,
}

/// How many robots a place admits at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlaceRule {
    /// One robot.
    Exclusive,
    /// As many as its capacity says.
    Capacity,
}

/// The floor that a place covers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PlaceExtent {
    /// Of a passage.
    Passage(Inside),
    /// Of a standing place.
    Standing(WaypointIx),
}

/// What lies inside a passage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Inside {
    /// Lanes on which a robot is inside, ascending; never empty.
    pub lanes: Vec<LaneIx>,
    /// Waypoints inside, ascending; every lane from or to one of them is inside too. None is a standing place.
    pub waypoints: Vec<WaypointIx>,
}

/// Floor that is granted before it is entered.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Place {
    /// Its name, unique in the site; a standing place is called like its waypoint.
    pub place_id: PlaceId,
    /// Its lanes and waypoints, which say what it is for.
    pub extent: PlaceExtent,
    /// By the site file: a standing place of capacity 1 is exclusive.
    pub rule: PlaceRule,
    /// Robots at a time; at least 1, and 1 for [`PlaceRule::Exclusive`].
    pub capacity: u32,
}

impl Place {
    /// The waypoint of a standing place.
    pub fn waypoint(&self) -> Option<WaypointIx> {
        match self.extent {
            PlaceExtent::Standing(at) => Some(at),
            PlaceExtent::Passage(_) => None,
        }
    }
    /// What lies inside, if it is a passage.
    pub fn inside(&self) -> Option<&Inside> {
        match &self.extent {
            PlaceExtent::Passage(inside) => Some(inside),
            PlaceExtent::Standing(_) => None,
        }
    }
    /// What it is for.
    pub const fn kind(&self) -> PlaceKind {
        match self.extent {
            PlaceExtent::Passage(_) => PlaceKind::Passage,
            PlaceExtent::Standing(_) => PlaceKind::Standing,
        }
    }
    /// PASSAGE or STANDING.
    pub const fn kind_str(&self) -> &'static str {
        match self.kind() {
            PlaceKind::Passage => "PASSAGE",
            PlaceKind::Standing => "STANDING",
        }
    }
    /// EXCLUSIVE or CAPACITY.
    pub const fn rule_str(&self) -> &'static str {
        match self.rule {
            PlaceRule::Exclusive => "EXCLUSIVE",
            PlaceRule::Capacity => "CAPACITY",
        }
    }
}

/// Policy values that the site file gives an area; what a person puts later goes before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaDefaults {
    /// Millimetres per second.
    pub speed_limit_mm_s: Option<u32>,
    /// Millimetres kept to people and things.
    pub avoidance_distance_mm: Option<u32>,
    /// Below this a robot must charge, permille.
    pub charge_mandatory_permille: Option<u16>,
    /// Above this a charging robot may be called to work, permille.
    pub charge_preemptible_permille: Option<u16>,
    /// Below this an idle robot charges, permille.
    pub charge_opportunistic_permille: Option<u16>,
    /// Charging ends here, permille.
    pub charge_stop_permille: Option<u16>,
    /// Rates of task failures end roll-outs here; see [`crate::policy::SoftwareRules::acts_on_rates`].
    #[serde(default)]
    pub acts_on_rates: bool,
}

/// A part of the site with its own policy.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Area {
    /// Its name.
    pub area_id: AreaId,
    /// People walk here.
    pub people: bool,
    /// What the site file sets.
    pub defaults: AreaDefaults,
}

impl Area {
    /// The policy of this area as long as nobody has put another.
    pub fn policy(&self) -> AreaPolicy {
        let base = AreaPolicy::default_of(self.area_id.clone());
        let d = &self.defaults;
        self.near_people(AreaPolicy {
            speed_limit_mm_s: d.speed_limit_mm_s,
            avoidance_distance_mm: d.avoidance_distance_mm,
            charge_mandatory_permille: d.charge_mandatory_permille.unwrap_or(base.charge_mandatory_permille),
            charge_preemptible_permille: d.charge_preemptible_permille.unwrap_or(base.charge_preemptible_permille),
            charge_opportunistic_permille: d
                .charge_opportunistic_permille
                .unwrap_or(base.charge_opportunistic_permille),
            charge_stop_permille: d.charge_stop_permille.unwrap_or(base.charge_stop_permille),
            software: SoftwareRules { acts_on_rates: d.acts_on_rates, ..base.software },
            ..base
        })
    }

    /// `rules` as they hold here: where people walk, a speed and a distance that they leave open are those for people near.
    pub fn near_people(&self, rules: AreaPolicy) -> AreaPolicy {
        if !self.people {
            return rules;
        }
        AreaPolicy {
            speed_limit_mm_s: rules.speed_limit_mm_s.or(Some(limits::PEOPLE_SPEED_MM_S)),
            avoidance_distance_mm: rules.avoidance_distance_mm.or(Some(limits::PEOPLE_AVOIDANCE_MM)),
            ..rules
        }
    }
}

/// Where a site came from; authored sites must pass the lint, imported ones are only warned about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// A person wrote it in the site format.
    Authored,
    /// A grid map of squares.
    Grid,
    /// A VDMA Layout Interchange Format file.
    Lif,
}

/// One site. Built by [`super::text::parse`] and the imports only.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Site {
    pub(super) site_id: SiteId,
    pub(super) name: String,
    pub(super) map_id: String,
    pub(super) map_version: String,
    pub(super) source: Source,
    pub(super) collisions_modelled: bool,
    pub(super) areas: Vec<Area>,
    pub(super) waypoints: Vec<Waypoint>,
    /// Waypoints of each kind, ascending.
    pub(super) kinds: BTreeMap<Kind, Vec<WaypointIx>>,
    pub(super) lanes: Vec<Lane>,
    pub(super) shortest_lane_mm: u32,
    pub(super) places: Vec<Place>,
    pub(super) waypoint_names: BTreeMap<WaypointId, WaypointIx>,
    pub(super) place_names: BTreeMap<PlaceId, PlaceIx>,
    /// Where robots start, as the site file says.
    pub(super) starts: BTreeMap<RobotId, WaypointIx>,
    /// Robots that start in a standing place, by name.
    pub(super) starting: BTreeMap<PlaceIx, Vec<RobotId>>,
    /// `lanes` is sorted by (from, to): those from waypoint w are `leaving[w]..leaving[w + 1]`.
    pub(super) leaving: Vec<u32>,
    /// Lanes sorted by (to, from) ...
    pub(super) arriving: Vec<LaneIx>,
    /// ... and those to waypoint w are `arriving[arriving_at[w]..arriving_at[w + 1]]`.
    pub(super) arriving_at: Vec<u32>,
}

impl Site {
    /// The site's name for machines.
    pub fn site_id(&self) -> &SiteId {
        &self.site_id
    }
    /// The site's name for people.
    pub fn name(&self) -> &str {
        &self.name
    }
    /// Which map; part of every pose.
    pub fn map_id(&self) -> &str {
        &self.map_id
    }
    /// Which version of the map; part of every pose.
    pub fn map_version(&self) -> &str {
        &self.map_version
    }
    /// Where it came from.
    pub fn source(&self) -> Source {
        self.source
    }
    /// False if bodies may drive through each other (imported grids).
    pub fn collisions_modelled(&self) -> bool {
        self.collisions_modelled
    }
    /// Every area, by [`AreaIx`].
    pub fn areas(&self) -> &[Area] {
        &self.areas
    }
    /// Every waypoint, by [`WaypointIx`].
    pub fn waypoints(&self) -> &[Waypoint] {
        &self.waypoints
    }
    /// Every lane, by [`LaneIx`], sorted by (from, to).
    pub fn lanes(&self) -> &[Lane] {
        &self.lanes
    }
    /// Millimetres of the shortest lane, at least 1.
    pub fn shortest_lane_mm(&self) -> u32 {
        self.shortest_lane_mm
    }
    /// Every place, by [`PlaceIx`]; passages first, then standing places in the order of their waypoints.
    pub fn places(&self) -> &[Place] {
        &self.places
    }
    /// One waypoint. Panics on an index of another site.
    pub fn waypoint(&self, at: WaypointIx) -> &Waypoint {
        &self.waypoints[at.at()]
    }
    /// One lane. Panics on an index of another site.
    pub fn lane(&self, at: LaneIx) -> &Lane {
        &self.lanes[at.at()]
    }
    /// One place. Panics on an index of another site.
    pub fn place(&self, at: PlaceIx) -> &Place {
        &self.places[at.at()]
    }
    /// One area. Panics on an index of another site.
    pub fn area(&self, at: AreaIx) -> &Area {
        &self.areas[at.at()]
    }
    /// The area that a waypoint lies in.
    pub fn area_of(&self, at: WaypointIx) -> &Area {
        self.area(self.waypoint(at).area)
    }
    /// Finds a waypoint by name.
    pub fn find(&self, name: &WaypointId) -> Option<WaypointIx> {
        self.waypoint_names.get(name).copied()
    }
    /// Finds a place by name.
    pub fn find_place(&self, name: &PlaceId) -> Option<PlaceIx> {
        self.place_names.get(name).copied()
    }
    /// Finds an area by name.
    pub fn find_area(&self, name: &AreaId) -> Option<AreaIx> {
        self.areas.iter().position(|a| a.area_id == *name).map(|i| AreaIx(i as u32))
    }
    /// The name of a waypoint.
    pub fn name_of(&self, at: WaypointIx) -> &WaypointId {
        &self.waypoint(at).waypoint_id
    }
    /// The lanes that leave a waypoint, by the index of their ends.
    pub fn leaving(&self, at: WaypointIx) -> &[Lane] {
        &self.lanes[self.leaving[at.at()] as usize..self.leaving[at.at() + 1] as usize]
    }
    /// The lanes that arrive at a waypoint, by the index of their beginnings.
    pub fn arriving(&self, at: WaypointIx) -> impl Iterator<Item = &Lane> {
        let range = self.arriving_at[at.at()] as usize..self.arriving_at[at.at() + 1] as usize;
        self.arriving[range].iter().map(|l| self.lane(*l))
    }
    /// The lane between two waypoints, in this direction.
    pub fn find_lane(&self, from: WaypointIx, to: WaypointIx) -> Option<LaneIx> {
        let first = self.leaving[from.at()];
        let found = self.leaving(from).binary_search_by_key(&to, |l| l.to).ok()?;
        Some(LaneIx(first + found as u32))
    }
    /// The passages that a robot on the lane between these waypoints is inside of; empty if there is no such lane.
    pub fn passages_of_lane(&self, from: WaypointIx, to: WaypointIx) -> &[PlaceIx] {
        self.find_lane(from, to).map_or(&[], |l| &self.lane(l).passages)
    }
    /// The lowest limit that the lane and the areas of both its ends set, millimetres per second.
    pub fn lane_speed_limit_mm_s(&self, lane: &Lane) -> Option<u32> {
        let area = |at| self.area_of(at).policy().speed_limit_mm_s;
        [lane.speed_limit_mm_s, area(lane.from), area(lane.to)].into_iter().flatten().min()
    }
    /// The standing place at a waypoint.
    pub fn standing_at(&self, at: WaypointIx) -> Option<PlaceIx> {
        self.waypoint(at).standing
    }
    /// Whether a robot may stand here reserved.
    pub fn is_standing(&self, at: WaypointIx) -> bool {
        self.waypoint(at).standing.is_some()
    }
    /// Whether routes may lead over this waypoint to somewhere else. Hold points yes; stations, chargers and parking
    /// places no, unless nothing is reserved there.
    pub fn is_through(&self, at: WaypointIx) -> bool {
        let waypoint = self.waypoint(at);
        waypoint.standing.is_none() || waypoint.kind == Kind::Hold
    }
    /// Whether an item can be picked up or put down here: stations, and every cell of an imported grid.
    pub fn can_handle(&self, at: WaypointIx) -> bool {
        self.source == Source::Grid || self.waypoint(at).kind == Kind::Station
    }
    /// Every waypoint of a kind, ascending.
    pub fn of_kind(&self, kind: Kind) -> impl Iterator<Item = WaypointIx> + use<'_> {
        self.kinds.get(&kind).into_iter().flatten().copied()
    }
    /// Every station.
    pub fn stations(&self) -> impl Iterator<Item = WaypointIx> {
        self.of_kind(Kind::Station)
    }
    /// Every charger.
    pub fn chargers(&self) -> impl Iterator<Item = WaypointIx> {
        self.of_kind(Kind::Charger)
    }
    /// Every parking place.
    pub fn parks(&self) -> impl Iterator<Item = WaypointIx> {
        self.of_kind(Kind::Park)
    }
    /// Every hold point.
    pub fn hold_points(&self) -> impl Iterator<Item = WaypointIx> {
        self.of_kind(Kind::Hold)
    }
    /// Robots that can stand reserved at the waypoints of `kind` at the same time.
    pub fn standing_capacity(&self, kind: Kind) -> u64 {
        self.of_kind(kind).filter_map(|w| self.standing_at(w)).map(|p| u64::from(self.place(p).capacity)).sum()
    }
    /// Robots that can stand reserved in one area at the same time. One more than should: those inside need room to move.
    pub fn area_capacity(&self, area: AreaIx) -> u64 {
        let inside = self.waypoints.iter().filter(|w| w.area == area).filter_map(|w| w.standing);
        inside.map(|p| u64::from(self.place(p).capacity)).sum()
    }
    /// Where robots start, as the site file names them.
    pub fn starts(&self) -> &BTreeMap<RobotId, WaypointIx> {
        &self.starts
    }
    /// Robots that start in this standing place. Empty: the site file names none.
    pub fn starting_in(&self, place: PlaceIx) -> &[RobotId] {
        self.starting.get(&place).map_or(&[], Vec::as_slice)
    }
    /// Where each of `robots` starts: where the site file says, else in the next of [`Site::starting_places`] that it gives to nobody. May be
    /// shorter than asked.
    pub fn starts_of(&self, robots: &[RobotId]) -> Vec<WaypointIx> {
        let mut named: BTreeMap<WaypointIx, usize> = BTreeMap::new();
        for at in self.starts.values() {
            *named.entry(*at).or_default() += 1;
        }
        let seats = self.starting_places(robots.len() + self.starts.len());
        let mut free = seats.into_iter().filter(|at| match named.get_mut(at) {
            Some(left) if *left > 0 => {
                *left -= 1;
                false
            }
            _ => true,
        });
        robots.iter().map_while(|robot| self.starts.get(robot).copied().or_else(|| free.next())).collect()
    }
    /// Where `robots` may stand when a site is set up from nothing: parking places first, then chargers, hold points, and
    /// last, where nothing is reserved, any waypoint; each place up to its capacity. May be shorter than asked.
    pub fn starting_places(&self, robots: usize) -> Vec<WaypointIx> {
        let mut seats = Vec::new();
        for kind in [Kind::Park, Kind::Charger, Kind::Hold] {
            for at in self.of_kind(kind) {
                let capacity = self.standing_at(at).map_or(0, |p| self.place(p).capacity);
                seats.extend(std::iter::repeat_n(at, capacity as usize));
            }
        }
        if seats.is_empty() && !self.collisions_modelled {
            let step = (self.waypoints.len() / robots.max(1)).max(1);
            seats.extend((0..self.waypoints.len()).step_by(step).map(|i| WaypointIx(i as u32)));
        }
        seats.truncate(robots);
        seats
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::site::{CORRIDOR, DEMO, route, text};

    fn at(site: &Site, name: &str) -> WaypointIx {
        site.find(&WaypointId::parse(name).expect("a name")).expect(name)
    }

    #[test]
    fn the_demo_factory_has_what_its_heading_says() {
        let site = text::parse(DEMO).expect("reads");
        assert_eq!((site.waypoints().len(), site.stations().count(), site.chargers().count()), (56, 17, 5));
        let seats = [Kind::Station, Kind::Hold, Kind::Park].map(|k| site.standing_capacity(k));
        assert_eq!(seats, [49, 31, 12]);
        for name in ["A01", "B03", "D01", "L1-in", "P01", "Q01"] {
            assert!(site.can_handle(at(&site, name)), "{name}");
        }
        assert_eq!(site.starting_places(20).len(), 20);
    }

    #[test]
    fn in_the_demo_only_ways_through_the_door_or_the_aisle_pass_a_hold_point() {
        let site = std::sync::Arc::new(text::parse(DEMO).expect("reads"));
        let router = route::Router::new(site.clone());
        let (mut sum, mut count) = (0, 0);
        for from in site.stations() {
            for to in site.stations().filter(|to| *to != from) {
                let way = router.route(from, to).expect("a way");
                let far = [from, to].iter().any(|w| ["Q01", "C01"].contains(&site.name_of(*w).as_str()));
                assert!(far || route::segments(&site, &way).len() == 1, "{way:?}");
                sum += router.distance_mm(from, to).expect("a way");
                count += 1;
            }
        }
        assert!((21_000..23_000).contains(&(sum / count)), "mean way is {} mm", sum / count);
    }

    #[test]
    fn lanes_are_found_from_both_ends_and_know_their_passages_and_limits() {
        let site = text::parse(DEMO).expect("reads");
        let (door, room) = (at(&site, "door-1"), at(&site, "door-2"));
        let inside = site.passages_of_lane(door, room);
        assert_eq!(inside.iter().map(|p| site.place(*p).place_id.as_str()).collect::<Vec<_>>(), ["door"]);
        let lane = site.lane(site.find_lane(door, room).expect("a lane"));
        assert_eq!(site.lane_speed_limit_mm_s(lane), Some(1000), "the slower of both areas");
        let ends: Vec<_> = site.arriving(door).map(|l| site.name_of(l.from).as_str()).collect();
        assert_eq!(ends, ["door-hall", "door-2"]);
        assert_eq!(site.passages_of_lane(room, at(&site, "j11")), []);
    }

    #[test]
    fn an_area_without_values_of_its_own_has_the_default_policy() {
        let site = text::parse(CORRIDOR).expect("reads");
        let area = &site.areas()[0];
        let policy = area.policy();
        assert_eq!(policy, AreaPolicy { speed_limit_mm_s: Some(1500), ..AreaPolicy::default_of(area.area_id.clone()) });
    }
}
