//! The site format: TOML that a person can write, read with every mistake listed at once, and written back.
//!
//! Invariant: `parse(render(site)) == site`; an unknown key is a mistake. Called by the binary and by tests.
//!
//! ```toml
//! [site]
//! id = "shop"
//! name = "A small shop"
//! map_id = "shop"
//! map_version = "1"
//!
//! [[area]]
//! id = "floor"
//! speed_limit_mm_s = 1500
//!
//! waypoint = [ { id = "A01", at = [1000, 2000], kind = "station" } ]  # kind: junction, station, charger, park, hold
//! ```

use super::draft::{Draft, DraftArea, DraftLane, DraftPassage, DraftWaypoint};
use super::{AreaDefaults, Kind, Lane, PlaceKind, Site, Source};
use crate::limits::SITE_FILE_BYTES;
use crate::reason::{Refusal, Violations};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::fmt::Write;
use toml::Spanned;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFile {
    site: Spanned<toml::Table>,
    #[serde(default)]
    area: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    waypoint: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    lane: Vec<Spanned<toml::Table>>,
    #[serde(default)]
    passage: Vec<Spanned<toml::Table>>,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct RawSite {
    id: String,
    name: String,
    map_id: String,
    map_version: String,
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
enum Ways {
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
    ways: Ways,
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

/// Reads a site file. Errors: every mistake, each with its line.
pub fn parse(text: &str) -> Result<Site, Refusal> {
    if text.len() > SITE_FILE_BYTES {
        return Err(Refusal::field("site", format!("must be at most {SITE_FILE_BYTES} bytes")));
    }
    let file: RawFile = toml::from_str(text).map_err(|e| {
        let line = e.span().map_or_else(String::new, |s| format!("line {}", line_of(text, s.start)));
        Refusal::field(if line.is_empty() { "site" } else { &line }, e.message())
    })?;
    let mut reader = Reader { text, violations: Violations::default() };
    let site: RawSite = reader.one("site", file.site).map(|(_, s)| s).unwrap_or_else(|| RawSite {
        id: "unread".into(),
        name: "unread".into(),
        map_id: "unread".into(),
        map_version: "unread".into(),
    });
    let areas = reader.many("area", file.area).into_iter().map(area).collect();
    let waypoints = reader.many("waypoint", file.waypoint).into_iter().map(waypoint).collect();
    let mut lanes = Vec::new();
    for (field, raw) in reader.many("lane", file.lane) {
        expand_lane(&mut reader.violations, field, &raw, &mut lanes);
    }
    let raw_passages = reader.many("passage", file.passage);
    let passages = raw_passages.into_iter().map(|(f, raw)| passage(&mut reader.violations, f, raw)).collect();
    let draft = Draft {
        site_id: site.id,
        name: site.name,
        map_id: site.map_id,
        map_version: site.map_version,
        source: Source::Authored,
        collisions_modelled: true,
        areas,
        waypoints,
        lanes,
        passages,
    };
    draft.build(reader.violations)
}

struct Reader<'a> {
    text: &'a str,
    violations: Violations,
}

impl Reader<'_> {
    fn one<T: DeserializeOwned>(&mut self, name: &str, table: Spanned<toml::Table>) -> Option<(String, T)> {
        let field = format!("{name} (line {})", line_of(self.text, table.span().start));
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

fn line_of(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|b| *b == b'\n').count()
}

fn area((field, raw): (String, RawArea)) -> DraftArea {
    let defaults = AreaDefaults {
        speed_limit_mm_s: raw.speed_limit_mm_s,
        avoidance_distance_mm: raw.avoidance_distance_mm,
        charge_mandatory_permille: raw.charge_mandatory_permille,
        charge_preemptible_permille: raw.charge_preemptible_permille,
        charge_opportunistic_permille: raw.charge_opportunistic_permille,
        charge_stop_permille: raw.charge_stop_permille,
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
                wide: raw.ways == Ways::Wide,
            });
        };
        push(&pair[0], &pair[1]);
        if raw.ways != Ways::One {
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
    // The arrays stand first: in TOML nothing of the top level can follow a `[table]`.
    writeln!(out, "waypoint = [")?;
    for w in site.waypoints() {
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
        writeln!(out, " }},")?;
    }
    writeln!(out, "]\n\nlane = [")?;
    for lane in site.lanes() {
        write_lane(site, lane, out)?;
    }
    writeln!(out, "]\n\n[site]\nid = {}", quoted(site.site_id().as_str()))?;
    writeln!(out, "name = {}\nmap_id = {}", quoted(site.name()), quoted(site.map_id()))?;
    writeln!(out, "map_version = {}", quoted(site.map_version()))?;
    for area in site.areas() {
        writeln!(out, "\n[[area]]\nid = {}\npeople = {}", quoted(area.area_id.as_str()), area.people)?;
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
                writeln!(out, "{key} = {value}")?;
            }
        }
    }
    for place in site.places() {
        let Some(inside) = place.inside() else { continue };
        writeln!(out, "\n[[passage]]\nid = {}", quoted(place.place_id.as_str()))?;
        match place.kind {
            PlaceKind::Capacity(_) => writeln!(out, "rule = \"capacity\"\ncapacity = {}", place.capacity)?,
            _ => writeln!(out, "rule = \"exclusive\"")?,
        }
        let name = |at| quoted(site.name_of(at).as_str());
        let lanes = inside.lanes.iter().map(|l| site.lane(*l));
        let lanes: Vec<_> = lanes.map(|l| format!("[{}, {}]", name(l.from), name(l.to))).collect();
        let inner: Vec<_> = inside.waypoints.iter().map(|w| name(*w)).collect();
        writeln!(out, "lanes = [{}]\nwaypoints = [{}]", lanes.join(", "), inner.join(", "))?;
    }
    Ok(())
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
