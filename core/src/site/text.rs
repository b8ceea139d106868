//! The site format: TOML that a person can write, read with every mistake listed at once, and written back.
//!
//! Invariant: `parse(render(site)) == site`; an unknown key is a mistake. Called by `server` and by tests.
//!
//! What may stand in a file is told in docs/sites.md, whose example is read here.

use super::draft::{Draft, DraftArea, DraftLane, DraftPassage, DraftRobot, DraftWaypoint};
use super::map::{Area, AreaDefaults, Kind, Lane, Place, PlaceRule, Site, Source, Waypoint};
use crate::limits::SITE_FILE_BYTES;
use crate::reason::{Refusal, Violations};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::fmt::Write;
use toml::Spanned;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFile {
    #[serde(default)]
    site_id: String,
    #[serde(default)]
    name: String,
    #[serde(default)]
    map_id: String,
    #[serde(default)]
    map_version: String,
    #[serde(default)]
    area: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    waypoint: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    lane: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    passage: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    robot: Vec<Spanned<toml::Table>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawArea {
    id: String,
    #[serde(default)]
    people: bool,
    speed_limit_mm_s: Option<u32>,
    avoidance_distance_mm: Option<u32>,
    charge_mandatory_permille: Option<u16>,
    charge_preemptible_permille: Option<u16>,
    charge_opportunistic_permille: Option<u16>,
    charge_stop_permille: Option<u16>,
    #[serde(default)]
    acts_on_rates: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawWaypoint {
    id: String,
    at: [i64; 2],
    #[serde(default = "junction")]
    kind: Kind,
    area: Option<String>,
    capacity: Option<u32>,
}

fn junction() -> Kind {
    Kind::Junction
}

#[derive(Deserialize, Default, Clone, Copy, PartialEq)]
#[serde(rename_all = "snake_case")]
enum LaneTraffic {
    #[default]
    One,
    Two,
    Wide,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawLane {
    path: Vec<String>,
    #[serde(default)]
    ways: LaneTraffic,
    length_mm: Option<u32>,
    speed_limit_mm_s: Option<u32>,
}

#[derive(Deserialize, PartialEq)]
#[serde(rename_all = "snake_case")]
enum Rule {
    Exclusive,
    Capacity,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawPassage {
    id: String,
    rule: Rule,
    capacity: Option<u32>,
    #[serde(default)]
    lanes: Vec<(String, String)>,
    #[serde(default)]
    waypoints: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawRobot {
    id: String,
    at: String,
}

/// Reads a site file. Errors: every mistake, each with its line.
pub fn parse(text: &str) -> Result<Site, Refusal> {
    if text.len() > SITE_FILE_BYTES {
        return Err(Refusal::field("file", format!("must be at most {SITE_FILE_BYTES} bytes")));
    }
    let file: RawFile = toml::from_str(text).map_err(|e| {
        let line = e.span().map_or_else(String::new, |s| format!("line {}", Lines::new(text).at(s.start)));
        Refusal::field(if line.is_empty() { "file" } else { &line }, e.message())
    })?;
    let mut reader = Reader { lines: Lines::new(text), violations: Violations::default() };
    let areas = reader.many("area", file.area).into_iter().map(area).collect();
    let waypoints = reader.many("waypoint", file.waypoint).into_iter().map(waypoint).collect();
    let mut lanes = Vec::new();
    for (field, raw) in reader.many("lane", file.lane) {
        expand_lane(&mut reader.violations, field, &raw, &mut lanes);
    }
    let raw_passages = reader.many("passage", file.passage);
    let passages = raw_passages.into_iter().map(|(f, raw)| passage(&mut reader.violations, f, raw)).collect();
    let robots = reader.many("robot", file.robot).into_iter();
    let robots = robots.map(|(field, RawRobot { id, at })| DraftRobot { field, id, at }).collect();
    let draft = Draft {
        site_id: file.site_id,
        name: file.name,
        map_id: file.map_id,
        map_version: file.map_version,
        source: Source::Authored,
        collisions_modelled: true,
        areas,
        waypoints,
        lanes,
        passages,
        robots,
    };
    draft.build(reader.violations)
}

struct Reader {
    lines: Lines,
    violations: Violations,
}

impl Reader {
    fn one<T: DeserializeOwned>(&mut self, name: &str, table: Spanned<toml::Table>) -> Option<(String, T)> {
        let field = format!("{name} (line {})", self.lines.at(table.span().start));
        match table.into_inner().try_into::<T>() {
            Ok(value) => Some((field, value)),
            Err(e) => {
                self.violations.add(field, e.message());
                None
            }
        }
    }
    fn many<T: DeserializeOwned>(&mut self, name: &str, tables: Vec<Spanned<toml::Table>>) -> Vec<(String, T)> {
        tables.into_iter().filter_map(|t| self.one(name, t)).collect()
    }
}

/// Where the lines of a text end, in bytes. A large site has tens of thousands.
struct Lines(Vec<usize>);

impl Lines {
    fn new(text: &str) -> Self {
        Self(text.match_indices('\n').map(|(byte, _)| byte).collect())
    }
    /// Number of the line in which a byte is, from 1.
    fn at(&self, byte: usize) -> usize {
        1 + self.0.partition_point(|end| *end < byte)
    }
}

fn area((field, raw): (String, RawArea)) -> DraftArea {
    let defaults = AreaDefaults {
        speed_limit_mm_s: raw.speed_limit_mm_s,
        avoidance_distance_mm: raw.avoidance_distance_mm,
        charge_mandatory_permille: raw.charge_mandatory_permille,
        charge_preemptible_permille: raw.charge_preemptible_permille,
        charge_opportunistic_permille: raw.charge_opportunistic_permille,
        charge_stop_permille: raw.charge_stop_permille,
        acts_on_rates: raw.acts_on_rates,
    };
    DraftArea { field, id: raw.id, people: raw.people, defaults }
}

fn waypoint((field, raw): (String, RawWaypoint)) -> DraftWaypoint {
    let [x_mm, y_mm] = raw.at;
    let RawWaypoint { id, kind, area, capacity, .. } = raw;
    DraftWaypoint { field, id, x_mm, y_mm, area, kind, capacity, reserved: true }
}

fn expand_lane(v: &mut Violations, field: String, raw: &RawLane, lanes: &mut Vec<DraftLane>) {
    if raw.path.len() < 2 {
        v.add(format!("{field}.path"), "must name at least two waypoints");
    }
    if raw.length_mm.is_some() && raw.path.len() != 2 {
        v.add(format!("{field}.length_mm"), "is for a path of two waypoints only");
    }
    for pair in raw.path.windows(2) {
        let mut push = |from: &String, to: &String| {
            lanes.push(DraftLane {
                field: field.clone(),
                from: from.clone(),
                to: to.clone(),
                length_mm: raw.length_mm,
                speed_limit_mm_s: raw.speed_limit_mm_s,
                wide: raw.ways == LaneTraffic::Wide,
            });
        };
        push(&pair[0], &pair[1]);
        if raw.ways != LaneTraffic::One {
            push(&pair[1], &pair[0]);
        }
    }
}

fn passage(v: &mut Violations, field: String, raw: RawPassage) -> DraftPassage {
    if (raw.rule == Rule::Capacity) != raw.capacity.is_some() {
        v.add(format!("{field}.capacity"), "is needed for rule = \"capacity\" and for nothing else");
    }
    let capacity = if raw.rule == Rule::Exclusive { None } else { raw.capacity.or(Some(1)) };
    DraftPassage { field, id: raw.id, capacity, lanes: raw.lanes, waypoints: raw.waypoints }
}

/// Writes a site in the site format. What the format has no word for (where the site came from) is left out: a rendered
/// import reads back as an authored site.
pub fn render(site: &Site) -> String {
    let mut out = String::new();
    write_site(site, &mut out).unwrap_or_default();
    out
}

fn quoted(text: &str) -> String {
    toml::Value::from(text).to_string()
}

fn write_site(site: &Site, out: &mut String) -> std::fmt::Result {
    writeln!(out, "site_id = {}", quoted(site.site_id().as_str()))?;
    writeln!(out, "name = {}\nmap_id = {}", quoted(site.name()), quoted(site.map_id()))?;
    writeln!(out, "map_version = {}\n\narea = [", quoted(site.map_version()))?;
    site.areas().iter().try_for_each(|area| write_area(area, out))?;
    writeln!(out, "]\n\nwaypoint = [")?;
    site.waypoints().iter().try_for_each(|w| write_waypoint(site, w, out))?;
    writeln!(out, "]\n\nlane = [")?;
    site.lanes().iter().try_for_each(|lane| write_lane(site, lane, out))?;
    writeln!(out, "]\n\npassage = [")?;
    site.places().iter().try_for_each(|place| write_passage(site, place, out))?;
    writeln!(out, "]")?;
    if site.starts().is_empty() {
        return Ok(());
    }
    writeln!(out, "\nrobot = [")?;
    for (robot_id, at) in site.starts() {
        writeln!(out, "  {{ id = {}, at = {} }},", quoted(robot_id.as_str()), quoted(site.name_of(*at).as_str()))?;
    }
    writeln!(out, "]")
}

fn write_area(area: &Area, out: &mut String) -> std::fmt::Result {
    write!(out, "  {{ id = {}", quoted(area.area_id.as_str()))?;
    if area.people {
        write!(out, ", people = true")?;
    }
    let d = &area.defaults;
    for (key, value) in [
        ("speed_limit_mm_s", d.speed_limit_mm_s),
        ("avoidance_distance_mm", d.avoidance_distance_mm),
        ("charge_mandatory_permille", d.charge_mandatory_permille.map(u32::from)),
        ("charge_preemptible_permille", d.charge_preemptible_permille.map(u32::from)),
        ("charge_opportunistic_permille", d.charge_opportunistic_permille.map(u32::from)),
        ("charge_stop_permille", d.charge_stop_permille.map(u32::from)),
    ] {
        if let Some(value) = value {
            write!(out, ", {key} = {value}")?;
        }
    }
    if d.acts_on_rates {
        write!(out, ", acts_on_rates = true")?;
    }
    writeln!(out, " }},")
}

fn write_waypoint(site: &Site, w: &Waypoint, out: &mut String) -> std::fmt::Result {
    write!(out, "  {{ id = {}, at = [{}, {}]", quoted(w.waypoint_id.as_str()), w.x_mm, w.y_mm)?;
    if w.kind != Kind::Junction {
        write!(out, ", kind = \"{}\"", w.kind.as_str())?;
    }
    if w.area.0 != 0 {
        write!(out, ", area = {}", quoted(site.area(w.area).area_id.as_str()))?;
    }
    if let Some(capacity) = w.standing.map(|p| site.place(p).capacity).filter(|c| *c != 1) {
        write!(out, ", capacity = {capacity}")?;
    }
    writeln!(out, " }},")
}

fn write_passage(site: &Site, place: &Place, out: &mut String) -> std::fmt::Result {
    let Some(inside) = place.inside() else { return Ok(()) };
    write!(out, "  {{ id = {}, ", quoted(place.place_id.as_str()))?;
    match place.rule {
        PlaceRule::Capacity => write!(out, "rule = \"capacity\", capacity = {}", place.capacity)?,
        PlaceRule::Exclusive => write!(out, "rule = \"exclusive\"")?,
    }
    let name = |at| quoted(site.name_of(at).as_str());
    let lanes = inside.lanes.iter().map(|l| site.lane(*l));
    let lanes: Vec<_> = lanes.map(|l| format!("[{}, {}]", name(l.from), name(l.to))).collect();
    let inner: Vec<_> = inside.waypoints.iter().map(|w| name(*w)).collect();
    writeln!(out, ", lanes = [{}], waypoints = [{}] }},", lanes.join(", "), inner.join(", "))
}

/// Writes a lane, or both directions in one line where they are alike; the second of such a pair is left out.
fn write_lane(site: &Site, lane: &Lane, out: &mut String) -> std::fmt::Result {
    let back = site.find_lane(lane.to, lane.from).map(|l| site.lane(l));
    let alike = back.is_some_and(|b| {
        (b.length_mm, b.speed_limit_mm_s, b.wide) == (lane.length_mm, lane.speed_limit_mm_s, lane.wide)
    });
    if alike && lane.from > lane.to {
        return Ok(());
    }
    let name = |at| quoted(site.name_of(at).as_str());
    write!(out, "  {{ path = [{}, {}]", name(lane.from), name(lane.to))?;
    if alike {
        write!(out, ", ways = \"{}\"", if lane.wide { "wide" } else { "two" })?;
    }
    write!(out, ", length_mm = {}", lane.length_mm)?;
    if let Some(speed) = lane.speed_limit_mm_s {
        write!(out, ", speed_limit_mm_s = {speed}")?;
    }
    writeln!(out, " }},")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{PlaceId, RobotId};
    use crate::site::{CORRIDOR, DEMO};

    fn text_of(lanes: &str, more: &str) -> String {
        format!(
            "site_id = \"s\"\nname = \"S\"\nmap_id = \"s\"\nmap_version = \"1\"\narea = [{{ id = \"a\" }}]\n\
             waypoint = [\n{{ id = \"p\", at = [0, 0] }},\n{{ id = \"q\", at = [3000, 4000] }},\n\
             {{ id = \"st\", at = [0, 9000], kind = \"station\" }},\n]\nlane = [{lanes}]\n{more}"
        )
    }

    #[test]
    fn what_is_rendered_reads_back_as_the_same_site() {
        for text in [DEMO, CORRIDOR] {
            let site = parse(text).expect("reads");
            let again = parse(&render(&site)).expect("its own text reads");
            assert_eq!(again, site);
        }
    }

    #[test]
    fn the_example_of_the_page_about_sites_is_one() {
        let page = include_str!("../../../docs/sites.md");
        let example = page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).expect("an example");
        let site = parse(example).expect("reads");
        assert_eq!((site.site_id().as_str(), site.stations().count()), ("shop", 1));
        assert_eq!(super::super::lint::lint(&site, None), []);
    }

    #[test]
    fn an_area_says_in_the_file_that_rates_of_failures_end_roll_outs_and_others_do_not() {
        let acts = |site: &Site| site.areas()[0].policy().software.acts_on_rates;
        let plain = text_of("{ path = [\"p\", \"q\", \"st\"] }", "");
        assert!(!acts(&parse(&plain).expect("reads")));
        let site = parse(&plain.replace("id = \"a\" ", "id = \"a\", acts_on_rates = true ")).expect("reads");
        assert!(acts(&site));
        assert_eq!(parse(&render(&site)).expect("its own text reads"), site);
    }

    #[test]
    fn a_site_names_where_its_robots_start_and_who_has_no_name_there_starts_elsewhere() {
        let robots = "robot = [{ id = \"rbt-02\", at = \"park-a\" }, { id = \"rbt-03\", at = \"A\" }]\n";
        let site = parse(&format!("{CORRIDOR}\n{robots}")).expect("reads");
        assert_eq!(parse(&render(&site)).expect("its own text reads"), site);
        let ids = ["rbt-01", "rbt-02", "rbt-03"].map(|id| RobotId::parse(id).expect("an id"));
        let starts = site.starts_of(&ids).into_iter().map(|at| site.name_of(at).as_str()).collect::<Vec<_>>();
        assert_eq!(starts, ["park-b", "park-a", "A"]);
        let park = site.find_place(&PlaceId::parse("park-a").expect("an id")).expect("a place");
        assert_eq!(site.starting_in(park), &ids[1..2]);
    }

    #[test]
    fn a_robot_that_cannot_start_where_the_site_says_is_a_mistake_in_its_line() {
        let robots = "robot = [\n{ id = \"r1\", at = \"park-a\" },\n{ id = \"r2\", at = \"park-a\" },\n\
             { id = \"r3\", at = \"a-in\" },\n{ id = \"r1\", at = \"A\" },\n{ id = \"r4\", at = \"nowhere\" },\n]";
        let first = CORRIDOR.lines().count() + 2;
        let refusal = parse(&format!("{CORRIDOR}{robots}")).expect_err("four mistakes");
        let all: Vec<_> = refusal.violations.iter().map(|v| format!("{}: {}", v.field, v.description)).collect();
        let expected = [
            (1, "at: park-a holds 1, and more robots start there"),
            (2, "at: a-in is no place to stand: a station, charger, park or hold is"),
            (3, "id: robot r1 is there twice"),
            (4, "at: there is no waypoint \"nowhere\""),
        ];
        assert_eq!(all, expected.map(|(line, text)| format!("robot (line {}).{text}", first + line)));
    }

    #[test]
    fn a_lane_is_as_long_as_the_straight_line_unless_told() {
        let site = parse(&text_of("{ path = [\"p\", \"q\", \"st\"] }", "")).expect("reads");
        let lengths: Vec<_> = site.lanes().iter().map(|l| l.length_mm).collect();
        assert_eq!(lengths, [5000, 5831]);
    }

    #[test]
    fn every_mistake_is_listed_at_once_with_its_line() {
        let text = text_of(
            "\n{ path = [\"p\", \"nowhere\"] },\n{ path = [\"q\", \"p\"], colour = \"red\" },\n\
             { path = [\"p\", \"q\"], length_mm = 4000 }",
            "passage = [{ id = \"st\", rule = \"capacity\", waypoints = [\"st\"] }]",
        );
        let refusal = parse(&text).expect_err("five mistakes");
        let all: Vec<_> = refusal.violations.iter().map(|v| format!("{}: {}", v.field, v.description)).collect();
        let all = all.join("\n");
        for part in [
            "lane (line 12): there is no waypoint \"nowhere\"",
            "lane (line 13): unknown field `colour`",
            "lane (line 14).length_mm: must be at least the straight line, 5000 mm",
            "passage (line 15).capacity: is needed",
            "two places are called st",
            "st is a standing place and cannot lie inside passage st",
        ] {
            assert!(all.contains(part), "{part} is not in:\n{all}");
        }
    }

    #[test]
    fn a_file_that_is_no_toml_names_the_line() {
        let refusal = parse("site_id = \"s\"\nname = = 3\n").expect_err("no toml");
        assert_eq!(refusal.violations[0].field, "line 2");
    }

    #[test]
    fn an_empty_file_says_all_that_is_needed() {
        let refusal = parse("").expect_err("nothing there");
        let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
        assert_eq!(fields, ["site_id", "name", "map_id", "map_version", "area", "waypoint"]);
    }
}
