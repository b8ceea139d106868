//! What is wrong with a map before a robot finds out: dead ends, ways where two must meet, too few places to wait.
//!
//! Invariant: a finding is of severity [`Severity::Error`] only for an authored site, which is refused then; imports are
//! only warned about. Called by `map lint`, and by `serve` before it serves a site.

use super::{Area, AreaIx, Kind, Lane, Place, PlaceRule, Site, Source, WaypointIx};
use crate::limits;
use serde::Serialize;
use std::collections::BTreeSet;

/// Names listed in one finding; the rest is counted.
const SUBJECTS_MAX: usize = 10;
/// Endpoints times waypoints that the search for cut vertices visits at most; larger maps are told so.
const CUT_SEARCH_MAX: usize = 50_000_000;
/// Candidates tried for the root of the largest connected part.
const ROOTS_TRIED: usize = 8;

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "UPPERCASE")]
pub enum Severity {
    /// Robots can work, but worse than they could.
    Warning,
    /// Robots will block each other or cannot get somewhere; an authored site is refused.
    Error,
}

macro_rules! rules {
    ($($variant:ident = $text:literal, $severity:ident, $help:literal;)*) => {
        /// One rule of a good map.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
        pub enum Rule {
            $(#[doc = $help] #[serde(rename = $text)] $variant,)*
        }
        impl Rule {
            /// Every rule.
            pub const ALL: &'static [Rule] = &[$(Self::$variant),*];
            /// The name in reports.
            pub const fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $text),* }
            }
            /// What is wrong and what to do.
            pub const fn help(self) -> &'static str {
                match self { $(Self::$variant => $help),* }
            }
            const fn severity(self) -> Severity {
                match self { $(Self::$variant => Severity::$severity),* }
            }
        }
    };
}

rules! {
    NotConnected = "NOT_CONNECTED", Error, "These waypoints cannot be reached from the rest, or do not lead back to it. Add lanes.";
    ThroughEndpoints = "THROUGH_ENDPOINTS", Error, "The only ways to or from these waypoints lead over stations, chargers or parking places, and routes do not go there. Add a lane past them.";
    EndpointIsCut = "ENDPOINT_IS_CUT", Error, "A robot that stands here cuts the map in two. Add a lane past it.";
    ChargerInLane = "CHARGER_IN_LANE", Error, "A charging robot stands in the only way of others for a long time. Move the charger beside the lane.";
    TwoWaySingleWidth = "TWO_WAY_SINGLE_WIDTH", Error, "Two robots can meet here and neither can pass. Put both directions into an exclusive passage, make it one-way, or say ways = \"wide\".";
    NoBayBeforePassage = "NO_BAY_BEFORE_PASSAGE", Error, "Robots come from both sides of this passage and there is no standing place to wait at its end. Let the lanes into it begin at hold points.";
    FarFromPassage = "FAR_FROM_PASSAGE", Warning, "The lanes into this exclusive passage begin at no standing place, so it is kept for a robot that is still far away. Put a hold point before it.";
    AreaAdmitsNobody = "AREA_ADMITS_NOBODY", Error, "The area has fewer than two seats at standing places, so a robot inside cannot make room for another. Add one.";
    StandingBelowRobots = "STANDING_BELOW_ROBOTS", Error, "With one seat of each area left free, so that robots can make room, there are fewer seats than robots.";
    BaysBelowRobots = "BAYS_BELOW_ROBOTS", Warning, "Hold points and parking places have fewer seats than there are robots, so a robot may have to wait in a station that another needs.";
    NoBayFromStation = "NO_BAY_FROM_STATION", Error, "From this station no hold point or parking place is reached without passing another standing place, so a robot cannot make room.";
    FastNearPeople = "FAST_NEAR_PEOPLE", Warning, "People walk here, and the file lets robots drive faster than 600 mm/s or come nearer than 500 mm. Leave both values out, or know why not.";
    NoCharger = "NO_CHARGER", Warning, "The site has no charger; robots stop when they are empty.";
    NoStation = "NO_STATION", Warning, "The site has no station, so nothing can be picked up or put down.";
    CollisionsNotModelled = "COLLISIONS_NOT_MODELLED", Warning, "On this map robots drive through each other.";
    NotSearched = "NOT_SEARCHED", Warning, "The map is too large to look for endpoints that cut it in two.";
}

/// One broken rule and where.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// How bad.
    pub severity: Severity,
    /// Which rule.
    pub rule: Rule,
    /// The first names that break it: waypoints, `from -> to` of lanes, places or areas.
    pub subjects: Vec<String>,
    /// How many break it.
    pub count: usize,
    /// One plain sentence.
    pub message: String,
}

/// Whether a site with these findings may not be served.
pub fn refuses(findings: &[Finding]) -> bool {
    findings.iter().any(|f| f.severity == Severity::Error)
}

/// Looks at a whole site. `robots`: how many will work on it, if known. Worst findings first.
pub fn lint(site: &Site, robots: Option<u64>) -> Vec<Finding> {
    let mut report = Report { site, findings: Vec::new() };
    connected(&mut report);
    cuts(&mut report);
    if site.collisions_modelled() {
        two_way(&mut report);
        passages(&mut report);
        areas(&mut report, robots);
        bays(&mut report);
    } else {
        report.add(Rule::CollisionsNotModelled, vec![String::new()]);
    }
    near_people(&mut report);
    if site.chargers().next().is_none() {
        report.add(Rule::NoCharger, vec![String::new()]);
    }
    if site.stations().next().is_none() {
        report.add(Rule::NoStation, vec![String::new()]);
    }
    report.findings.sort_by_key(|f| (std::cmp::Reverse(f.severity), f.rule));
    report.findings
}

struct Report<'a> {
    site: &'a Site,
    findings: Vec<Finding>,
}

impl Report<'_> {
    fn add(&mut self, rule: Rule, mut subjects: Vec<String>) {
        if subjects.is_empty() {
            return;
        }
        let count = subjects.len();
        subjects.truncate(SUBJECTS_MAX);
        subjects.retain(|s| !s.is_empty());
        let more = if count > SUBJECTS_MAX { format!(" and {} more", count - SUBJECTS_MAX) } else { String::new() };
        let colon = if subjects.is_empty() { String::new() } else { format!("{}{more}: ", subjects.join(", ")) };
        let message = format!("{colon}{}", rule.help());
        let severity = if self.site.source() == Source::Authored { rule.severity() } else { Severity::Warning };
        self.findings.push(Finding { severity, rule, subjects, count, message });
    }
    fn name(&self, at: WaypointIx) -> String {
        self.site.name_of(at).to_string()
    }
    fn names(&self, all: impl IntoIterator<Item = WaypointIx>) -> Vec<String> {
        all.into_iter().map(|w| self.name(w)).collect()
    }
    fn lane(&self, lane: &Lane) -> String {
        format!("{} -> {}", self.name(lane.from), self.name(lane.to))
    }
}

fn all(site: &Site) -> impl Iterator<Item = WaypointIx> + use<> {
    (0..site.waypoints().len() as u32).map(WaypointIx)
}

/// Marks what is reached from `root` along the lanes (or against them), not entering `removed` and going on only from
/// waypoints that are `through`.
fn reached(
    site: &Site,
    root: WaypointIx,
    forward: bool,
    removed: Option<WaypointIx>,
    through: &dyn Fn(WaypointIx) -> bool,
) -> Vec<bool> {
    let mut seen = vec![false; site.waypoints().len()];
    seen[root.at()] = true;
    let mut open = vec![root];
    while let Some(at) = open.pop() {
        if at != root && !through(at) {
            continue;
        }
        let mut visit = |next: WaypointIx| {
            if Some(next) != removed && !std::mem::replace(&mut seen[next.at()], true) {
                open.push(next);
            }
        };
        if forward {
            site.leaving(at).iter().for_each(|l| visit(l.to));
        } else {
            site.arriving(at).for_each(|l| visit(l.from));
        }
    }
    seen
}

/// What cannot be reached from `root` or does not lead back to it.
fn cut_off(
    site: &Site,
    root: WaypointIx,
    removed: Option<WaypointIx>,
    through: &dyn Fn(WaypointIx) -> bool,
) -> Vec<WaypointIx> {
    let to = reached(site, root, true, removed, through);
    let back = reached(site, root, false, removed, through);
    all(site).filter(|w| Some(*w) != removed && !(to[w.at()] && back[w.at()])).collect()
}

fn connected(report: &mut Report<'_>) {
    let site = report.site;
    let passable: Vec<_> = all(site).filter(|w| site.is_through(*w)).collect();
    let step = (passable.len() / ROOTS_TRIED).max(1);
    let candidates = passable.iter().copied().step_by(step).take(ROOTS_TRIED);
    let Some((lost, root)) =
        candidates.map(|root| (cut_off(site, root, None, &|_| true), root)).min_by_key(|(lost, _)| lost.len())
    else {
        return report.add(Rule::ThroughEndpoints, report.names(all(site)));
    };
    let known: BTreeSet<_> = lost.iter().copied().collect();
    report.add(Rule::NotConnected, report.names(lost));
    let strict = cut_off(site, root, None, &|w| site.is_through(w));
    report.add(Rule::ThroughEndpoints, report.names(strict.into_iter().filter(|w| !known.contains(w))));
}

fn cuts(report: &mut Report<'_>) {
    let site = report.site;
    let endpoints: Vec<_> =
        all(site).filter(|w| !matches!(site.waypoint(*w).kind, Kind::Junction | Kind::Hold)).collect();
    if endpoints.len().saturating_mul(site.waypoints().len()) > CUT_SEARCH_MAX {
        return report.add(Rule::NotSearched, vec![String::new()]);
    }
    let (mut plain, mut chargers) = (Vec::new(), Vec::new());
    let mut before: Option<(WaypointIx, BTreeSet<WaypointIx>)> = None;
    for endpoint in endpoints {
        let others = || all(site).filter(|w| *w != endpoint);
        let Some(root) = others().find(|w| site.is_through(*w)).or_else(|| others().next()) else { continue };
        if before.as_ref().is_none_or(|(same, _)| *same != root) {
            before = Some((root, cut_off(site, root, None, &|_| true).into_iter().collect()));
        }
        let Some((_, lost_anyway)) = &before else { continue };
        if cut_off(site, root, Some(endpoint), &|_| true).iter().any(|w| !lost_anyway.contains(w)) {
            let list = if site.waypoint(endpoint).kind == Kind::Charger { &mut chargers } else { &mut plain };
            list.push(endpoint);
        }
    }
    report.add(Rule::EndpointIsCut, report.names(plain));
    report.add(Rule::ChargerInLane, report.names(chargers));
}

fn is_exclusive(place: &Place) -> bool {
    place.rule == PlaceRule::Exclusive || place.capacity == 1
}

/// The opposite of a lane where both share one width.
fn opposite<'a>(site: &'a Site, lane: &Lane) -> Option<&'a Lane> {
    site.find_lane(lane.to, lane.from).map(|l| site.lane(l)).filter(|back| !(lane.wide && back.wide))
}

fn two_way(report: &mut Report<'_>) {
    let site = report.site;
    let meets = site.lanes().iter().filter(|lane| lane.from < lane.to).filter(|lane| {
        let Some(back) = opposite(site, lane) else { return false };
        !lane.passages.iter().any(|p| back.passages.contains(p) && is_exclusive(site.place(*p)))
    });
    report.add(Rule::TwoWaySingleWidth, meets.map(|l| report.lane(l)).collect());
}

fn passages(report: &mut Report<'_>) {
    let site = report.site;
    let (mut bayless, mut far) = (Vec::new(), Vec::new());
    for place in site.places().iter().filter(|p| is_exclusive(p)) {
        let Some(inside) = place.inside() else { continue };
        let lanes: Vec<_> = inside.lanes.iter().map(|l| site.lane(*l)).collect();
        let ours = site.find_place(&place.place_id);
        let is_inside = |lane: &Lane| ours.is_some_and(|p| lane.passages.contains(&p));
        let entries: BTreeSet<_> = lanes
            .iter()
            .map(|l| l.from)
            .filter(|w| !inside.waypoints.contains(w) && site.arriving(*w).any(|l| !is_inside(l)))
            .filter(|w| !site.is_standing(*w))
            .collect();
        let list = if lanes.iter().any(|l| opposite(site, l).is_some_and(is_inside)) { &mut bayless } else { &mut far };
        list.extend(entries.into_iter().map(|w| format!("{} at {}", place.place_id, report.name(w))));
    }
    report.add(Rule::NoBayBeforePassage, bayless);
    report.add(Rule::FarFromPassage, far);
}

fn areas(report: &mut Report<'_>, robots: Option<u64>) {
    let site = report.site;
    let seats: Vec<_> = (0..site.areas().len() as u32).map(|a| site.area_capacity(AreaIx(a))).collect();
    let used = |at: usize| site.waypoints().iter().any(|w| w.area.at() == at);
    let small = site.areas().iter().enumerate().filter(|(i, _)| seats[*i] < 2 && used(*i));
    report.add(Rule::AreaAdmitsNobody, small.map(|(_, a)| a.area_id.to_string()).collect());
    let Some(robots) = robots else { return };
    let admitted: u64 = seats.iter().map(|s| s.saturating_sub(1)).sum();
    if admitted < robots {
        report.add(Rule::StandingBelowRobots, vec![format!("{admitted} admitted, {robots} robots")]);
    }
    let bays = site.standing_capacity(Kind::Hold) + site.standing_capacity(Kind::Park);
    if bays < robots {
        report.add(Rule::BaysBelowRobots, vec![format!("{bays} seats, {robots} robots")]);
    }
}

fn near_people(report: &mut Report<'_>) {
    let is_bold = |area: &&Area| {
        let rules = area.policy();
        let fast = rules.speed_limit_mm_s.is_some_and(|v| v > limits::PEOPLE_SPEED_MM_S);
        area.people && (fast || rules.avoidance_distance_mm.is_some_and(|v| v < limits::PEOPLE_AVOIDANCE_MM))
    };
    let bold = report.site.areas().iter().filter(is_bold).map(|area| area.area_id.to_string()).collect();
    report.add(Rule::FastNearPeople, bold);
}

fn bays(report: &mut Report<'_>) {
    let site = report.site;
    let stuck = site.stations().filter(|station| {
        let seen = reached(site, *station, true, None, &|w| !site.is_standing(w));
        !all(site).any(|w| seen[w.at()] && matches!(site.waypoint(w).kind, Kind::Hold | Kind::Park))
    });
    report.add(Rule::NoBayFromStation, report.names(stuck));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::site::{CORRIDOR, DEMO, text};

    fn ring(more_waypoints: &str, lanes: &str, passages: &str) -> Site {
        let text = format!(
            "site_id = \"s\"\nname = \"S\"\nmap_id = \"s\"\nmap_version = \"1\"\narea = [{{ id = \"a\" }}]\nwaypoint = [\n\
             {{ id = \"n\", at = [0, 9000] }}, {{ id = \"e\", at = [9000, 0] }}, {{ id = \"w\", at = [-9000, 0] }},\n\
             {{ id = \"h\", at = [0, 5000], kind = \"hold\", capacity = 3 }},\n\
             {{ id = \"c\", at = [3000, 5000], kind = \"charger\" }},\n\
             {{ id = \"s\", at = [9000, 9000], kind = \"station\" }}, {more_waypoints}]\nlane = [\n\
             {{ path = [\"n\", \"w\", \"e\", \"n\"] }}, {{ path = [\"n\", \"h\", \"w\"] }}, {{ path = [\"n\", \"c\", \"w\"] }},\n\
             {{ path = [\"e\", \"s\", \"n\"] }}, {lanes}]\npassage = [{passages}]\n"
        );
        text::parse(&text).expect("reads")
    }

    fn rules(site: &Site) -> Vec<Rule> {
        lint(site, None).into_iter().map(|f| f.rule).collect()
    }

    #[test]
    fn the_sites_that_we_ship_are_clean() {
        for (text, robots) in [(DEMO, 20), (CORRIDOR, 3)] {
            let site = text::parse(text).expect("reads");
            assert_eq!(lint(&site, Some(robots)), [], "{}", site.name());
        }
        assert_eq!(rules(&ring("", "", "")), []);
    }

    #[test]
    fn a_waypoint_without_a_way_back_is_not_connected() {
        let found = lint(&ring("{ id = \"x\", at = [0, 20000] }", "{ path = [\"n\", \"x\"] }", ""), None);
        assert_eq!((found[0].rule, found[0].subjects.as_slice()), (Rule::NotConnected, ["x".to_owned()].as_slice()));
        assert!(refuses(&found));
    }

    #[test]
    fn a_station_and_a_charger_in_the_only_way_are_found() {
        let spur = "{ id = \"t\", at = [0, 20000], kind = \"KIND\" }, { id = \"u\", at = [0, 30000] }";
        let lanes = "{ path = [\"n\", \"t\", \"u\"], ways = \"wide\" }";
        for (kind, rule) in [("station", Rule::EndpointIsCut), ("charger", Rule::ChargerInLane)] {
            let found = rules(&ring(&spur.replace("KIND", kind), lanes, ""));
            assert_eq!(found, [Rule::ThroughEndpoints, rule]);
        }
    }

    #[test]
    fn a_single_width_two_way_lane_needs_an_exclusive_passage_with_bays() {
        let waypoints = "{ id = \"x\", at = [0, 20000] }";
        let lanes = "{ path = [\"n\", \"x\"], ways = \"two\" }";
        assert_eq!(rules(&ring(waypoints, lanes, "")), [Rule::TwoWaySingleWidth]);
        let passage = "{ id = \"p\", rule = \"exclusive\", lanes = [[\"n\", \"x\"], [\"x\", \"n\"]] }";
        assert_eq!(rules(&ring(waypoints, lanes, passage)), [Rule::NoBayBeforePassage]);
        assert_eq!(rules(&ring(waypoints, &lanes.replace("two", "wide"), "")), []);
    }

    #[test]
    fn an_area_where_people_walk_is_slow_and_a_file_that_lets_robots_be_faster_or_nearer_is_told() {
        let lint = |rules: &str| {
            let text = CORRIDOR.replace("speed_limit_mm_s = 1500", &format!("people = true{rules}"));
            let site = text::parse(&text).expect("reads");
            let policy = site.areas()[0].policy();
            let rules: Vec<_> = lint(&site, None).into_iter().map(|f| (f.severity, f.rule)).collect();
            (policy.speed_limit_mm_s, policy.avoidance_distance_mm, rules)
        };
        let told = vec![(Severity::Warning, Rule::FastNearPeople)];
        assert_eq!(lint(""), (Some(600), Some(500), Vec::new()));
        assert_eq!(lint(", speed_limit_mm_s = 300"), (Some(300), Some(500), Vec::new()));
        assert_eq!(lint(", speed_limit_mm_s = 601"), (Some(601), Some(500), told.clone()));
        assert_eq!(lint(", avoidance_distance_mm = 499"), (Some(600), Some(499), told));
    }

    #[test]
    fn more_robots_than_seats_are_too_many() {
        let found = lint(&ring("", "", ""), Some(5));
        let found: Vec<_> = found.iter().map(|f| (f.rule, f.subjects[0].as_str())).collect();
        let few = (Rule::BaysBelowRobots, "3 seats, 5 robots");
        assert_eq!(found, [(Rule::StandingBelowRobots, "4 admitted, 5 robots"), few]);
    }
}
