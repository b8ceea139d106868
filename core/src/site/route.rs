//! Ways through a site: shortest routes from distance fields, one per goal, and their cut into what is released at once.
//!
//! Invariant: the same site, ends and blocked places give the same route, whatever was asked before; never all pairs, and
//! what is remembered is bounded by [`crate::limits::ROUTE_FIELDS_BYTES`]. Called by fleet's planner and the simulator.

use super::{PlaceIx, Site, WaypointIx};
use crate::limits::ROUTE_FIELDS_BYTES;
use lru::LruCache;
use std::cmp::Reverse;
use std::collections::{BTreeSet, BinaryHeap, VecDeque};
use std::num::NonZeroUsize;
use std::sync::{Arc, Mutex, PoisonError};

/// No way to the goal.
const NEVER: u32 = u32::MAX;

/// Places that no route may lead into: quarantined or closed ones. Routes may leave them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Blocked(Arc<[PlaceIx]>);

impl Blocked {
    /// These places, in any order.
    pub fn new(places: impl IntoIterator<Item = PlaceIx>) -> Self {
        Self(places.into_iter().collect::<BTreeSet<_>>().into_iter().collect())
    }
    /// Whether a place is among them.
    pub fn contains(&self, place: PlaceIx) -> bool {
        self.0.binary_search(&place).is_ok()
    }
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// The way from everywhere to one goal.
#[derive(Debug)]
pub struct DistanceField {
    goal: WaypointIx,
    distance_mm: Vec<u32>,
    next: Vec<WaypointIx>,
}

impl DistanceField {
    /// Where it leads.
    pub fn goal(&self) -> WaypointIx {
        self.goal
    }
    /// Millimetres to drive from `from`; none if no lanes lead there.
    pub fn distance_mm(&self, from: WaypointIx) -> Option<u64> {
        let distance = self.distance_mm[from.at()];
        (distance != NEVER).then_some(u64::from(distance))
    }
    /// The waypoint to drive to next; none at the goal and where no way leads.
    pub fn next(&self, from: WaypointIx) -> Option<WaypointIx> {
        (from != self.goal && self.distance_mm[from.at()] != NEVER).then(|| self.next[from.at()])
    }
    /// The whole route with both ends; only the goal if `from` is the goal.
    pub fn route(&self, from: WaypointIx) -> Option<Vec<WaypointIx>> {
        self.distance_mm(from)?;
        Some(std::iter::successors(Some(from), |at| self.next(*at)).collect())
    }

    fn compute(site: &Site, goal: WaypointIx, blocked: &Blocked, mut ahead: Frontier) -> Self {
        let count = site.waypoints().len();
        let mut field = Self { goal, distance_mm: vec![NEVER; count], next: vec![goal; count] };
        let mut settled = vec![false; count];
        let shut = |at: WaypointIx| site.standing_at(at).is_some_and(|p| blocked.contains(p));
        if !shut(goal) {
            ahead.push(0, goal);
        }
        field.distance_mm[goal.at()] = 0;
        while let Some((distance, at)) = ahead.pop() {
            if std::mem::replace(&mut settled[at.at()], true) || (at != goal && (!site.is_through(at) || shut(at))) {
                continue;
            }
            for lane in site.arriving(at).filter(|l| !l.passages.iter().any(|p| blocked.contains(*p))) {
                let from = lane.from.at();
                let longer = distance.saturating_add(lane.length_mm);
                let known = field.distance_mm[from];
                if longer < known || (longer == known && longer != NEVER && !settled[from] && at < field.next[from]) {
                    field.distance_mm[from] = longer;
                    field.next[from] = at;
                    ahead.push(longer, lane.from);
                }
            }
        }
        field
    }
}

/// Waypoints that a field has reached and not looked behind, the nearest first.
#[derive(Debug)]
enum Frontier {
    /// Of lanes of any length.
    Ordered(BinaryHeap<Reverse<(u32, WaypointIx)>>),
    /// Of lanes of one length, as on a grid: what is reached later is never nearer.
    Queued(VecDeque<(u32, WaypointIx)>),
}

impl Frontier {
    fn new(lanes: LaneLengths) -> Self {
        match lanes {
            LaneLengths::Any => Self::Ordered(BinaryHeap::new()),
            LaneLengths::Equal => Self::Queued(VecDeque::new()),
        }
    }
    fn push(&mut self, distance_mm: u32, at: WaypointIx) {
        match self {
            Self::Ordered(heap) => heap.push(Reverse((distance_mm, at))),
            Self::Queued(queue) => queue.push_back((distance_mm, at)),
        }
    }
    fn pop(&mut self) -> Option<(u32, WaypointIx)> {
        match self {
            Self::Ordered(heap) => heap.pop().map(|Reverse(nearest)| nearest),
            Self::Queued(queue) => queue.pop_front(),
        }
    }
}

/// Whether all lanes of a site are equally long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LaneLengths {
    Any,
    Equal,
}

impl LaneLengths {
    fn from_site(site: &Site) -> Self {
        let mut lengths = site.lanes().iter().map(|lane| lane.length_mm);
        let first = lengths.next();
        if lengths.all(|length| Some(length) == first) { Self::Equal } else { Self::Any }
    }
}

/// Answers route questions on one site, remembering the fields of the newest goals.
#[derive(Debug)]
pub struct Router {
    site: Arc<Site>,
    lanes: LaneLengths,
    fields: Mutex<LruCache<(WaypointIx, Blocked), Arc<DistanceField>>>,
}

impl Router {
    /// A router with nothing remembered.
    pub fn new(site: Arc<Site>) -> Self {
        let field_bytes = site.waypoints().len() * size_of::<(u32, WaypointIx)>() + 64;
        let most = NonZeroUsize::new(ROUTE_FIELDS_BYTES / field_bytes).unwrap_or(NonZeroUsize::MIN);
        let lanes = LaneLengths::from_site(&site);
        Self { site, lanes, fields: Mutex::new(LruCache::new(most)) }
    }
    /// The site.
    pub fn site(&self) -> &Arc<Site> {
        &self.site
    }
    /// The way from everywhere to `goal`.
    pub fn field(&self, goal: WaypointIx) -> Arc<DistanceField> {
        self.field_around(goal, &Blocked::default())
    }
    /// The way from everywhere to `goal` around blocked places. A blocked goal is reached from nowhere but itself.
    pub fn field_around(&self, goal: WaypointIx, blocked: &Blocked) -> Arc<DistanceField> {
        let key = (goal, blocked.clone());
        if let Some(field) = self.remembered().get(&key) {
            return field.clone();
        }
        let field = Arc::new(DistanceField::compute(&self.site, goal, blocked, Frontier::new(self.lanes)));
        self.remembered().put(key, field.clone());
        field
    }
    /// Millimetres from one waypoint to another; none if no lanes lead there.
    pub fn distance_mm(&self, from: WaypointIx, to: WaypointIx) -> Option<u64> {
        self.field(to).distance_mm(from)
    }
    /// The shortest route with both ends; none if no lanes lead there.
    pub fn route(&self, from: WaypointIx, to: WaypointIx) -> Option<Vec<WaypointIx>> {
        self.field(to).route(from)
    }
    /// As [`Self::route`], around blocked places.
    pub fn route_around(&self, from: WaypointIx, to: WaypointIx, blocked: &Blocked) -> Option<Vec<WaypointIx>> {
        self.field_around(to, blocked).route(from)
    }
    fn remembered(&self) -> std::sync::MutexGuard<'_, LruCache<(WaypointIx, Blocked), Arc<DistanceField>>> {
        self.fields.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// One passage on a route, from the first waypoint before it to the first behind it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crossing {
    /// The passage.
    pub place: PlaceIx,
    /// Index into the route of the waypoint at which the robot enters: it must not leave that one without the grant.
    pub enter: usize,
    /// Index into the route of the first waypoint at which the robot is outside again.
    pub leave: usize,
}

/// The part of a route that is released at once: up to the next standing place or the end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Segment {
    /// Index into the route where it begins.
    pub start: usize,
    /// Index into the route where it ends.
    pub end: usize,
    /// Passages crossed, by (enter, place), each once; the last one may reach the end of the segment, none goes beyond.
    pub crossings: Vec<Crossing>,
    /// The standing place at the end; none only where nothing is reserved.
    pub standing: Option<PlaceIx>,
}

impl Segment {
    /// Everything to be granted before this segment is released: passages and the standing place, ascending.
    pub fn places(&self) -> Vec<PlaceIx> {
        let all: BTreeSet<_> = self.crossings.iter().map(|c| c.place).chain(self.standing).collect();
        all.into_iter().collect()
    }
}

/// Cuts a route at its standing places. A route of one waypoint has no segment.
pub fn segments(site: &Site, route: &[WaypointIx]) -> Vec<Segment> {
    let mut cut = Vec::new();
    let mut start = 0;
    let mut crossings: Vec<Crossing> = Vec::new();
    for end in 1..route.len() {
        for place in site.passages_of_lane(route[end - 1], route[end]) {
            match crossings.iter_mut().find(|c| c.place == *place) {
                Some(crossing) => crossing.leave = end,
                None => crossings.push(Crossing { place: *place, enter: end - 1, leave: end }),
            }
        }
        let standing = site.standing_at(route[end]);
        if standing.is_some() || end + 1 == route.len() {
            cut.push(Segment { start, end, crossings: std::mem::take(&mut crossings), standing });
            start = end;
        }
    }
    cut
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::WaypointId;
    use crate::site::{CORRIDOR, DEMO, text};

    fn site(text: &str) -> Arc<Site> {
        Arc::new(text::parse(text).expect("reads"))
    }
    fn at(site: &Site, name: &str) -> WaypointIx {
        site.find(&WaypointId::parse(name).expect("a name")).expect(name)
    }
    fn names(site: &Site, route: &[WaypointIx]) -> Vec<String> {
        route.iter().map(|w| site.name_of(*w).to_string()).collect()
    }

    #[test]
    fn a_route_is_released_up_to_each_standing_place_with_its_passages() {
        let site = site(CORRIDOR);
        let router = Router::new(site.clone());
        let route = router.route(at(&site, "A"), at(&site, "B")).expect("a way");
        assert_eq!(names(&site, &route), ["A", "a-out", "wait-a", "c-1", "c-2", "b-in", "B"]);
        let cut = segments(&site, &route);
        assert_eq!(cut.len(), 2);
        assert_eq!((cut[0].start, cut[0].end, cut[0].crossings.len()), (0, 2, 0));
        assert_eq!(cut[0].standing, site.standing_at(at(&site, "wait-a")));
        let corridor = cut[1].crossings[0];
        assert_eq!(site.place(corridor.place).place_id.as_str(), "corridor");
        assert_eq!((corridor.enter, corridor.leave), (2, 5));
        assert_eq!(cut[1].places().len(), 2);
        assert_eq!(segments(&site, &route[..1]), []);
    }

    #[test]
    fn a_route_never_leads_over_a_station_charger_or_park() {
        let site = site(DEMO);
        let router = Router::new(site.clone());
        for goal in 0..site.waypoints().len() as u32 {
            for from in 0..site.waypoints().len() as u32 {
                let route =
                    router.route(WaypointIx(from), WaypointIx(goal)).expect("every waypoint reaches every other");
                let inner = route.iter().skip(1).rev().skip(1);
                assert!(inner.copied().all(|w| site.is_through(w)), "{:?}", names(&site, &route));
                let driven = route.windows(2).map(|p| site.lane(site.find_lane(p[0], p[1]).expect("a lane")).length_mm);
                let driven: u64 = driven.map(u64::from).sum();
                assert_eq!(router.distance_mm(WaypointIx(from), WaypointIx(goal)), Some(driven));
            }
        }
    }

    #[test]
    fn blocked_places_are_driven_around_or_end_the_way() {
        let site = site(CORRIDOR);
        let router = Router::new(site.clone());
        let place = |name: &str| site.find_place(&crate::ids::PlaceId::parse(name).expect("a name")).expect(name);
        let (a, b) = (at(&site, "A"), at(&site, "B"));
        assert_eq!(router.route_around(a, b, &Blocked::new([place("corridor")])), None);
        assert_eq!(router.route_around(a, b, &Blocked::new([place("wait-a")])), None);
        assert_eq!(router.route_around(a, b, &Blocked::new([place("B")])), None);
        let leaving = router.route_around(a, at(&site, "park-a"), &Blocked::new([place("A")]));
        assert!(leaving.is_some(), "a robot may leave a blocked place");
        assert!(router.route(a, b).is_some(), "what is blocked in one question is open in the next");
    }

    #[test]
    fn a_field_of_equal_lanes_is_the_same_as_one_of_any() {
        let cells: Vec<(u32, u32)> =
            (0..6).flat_map(|x| (0..6).map(move |y| (x, y))).filter(|c| *c != (2, 3)).collect();
        let waypoint = |(x, y): &(u32, u32)| format!("{{ id = \"c{x}{y}\", at = [{}, {}] }},\n", x * 1_000, y * 1_000);
        let lanes = |(x, y): &(u32, u32)| {
            let beside = [(x + 1, *y), (*x, y + 1)].into_iter().filter(|cell| cells.contains(cell));
            beside
                .map(|(a, b)| format!("{{ path = [\"c{x}{y}\", \"c{a}{b}\"], ways = \"wide\" }},\n"))
                .collect::<String>()
        };
        let head = "site_id = \"hall\"\nname = \"hall\"\nmap_id = \"hall\"\nmap_version = \"1\"\n";
        let (waypoints, lanes): (String, String) =
            (cells.iter().map(waypoint).collect(), cells.iter().map(lanes).collect());
        let site = site(&format!("{head}area = [{{ id = \"a\" }}]\nwaypoint = [{waypoints}]\nlane = [{lanes}]\n"));
        assert_eq!(LaneLengths::from_site(&site), LaneLengths::Equal);
        for goal in (0..site.waypoints().len() as u32).map(WaypointIx) {
            let [queued, ordered] = [LaneLengths::Equal, LaneLengths::Any].map(|lanes| {
                let field = DistanceField::compute(&site, goal, &Blocked::default(), Frontier::new(lanes));
                (field.distance_mm, field.next)
            });
            assert_eq!(queued, ordered, "to {}", site.name_of(goal));
        }
    }
}
