//! Import of VDMA LIF, the Layout Interchange Format for driverless transport systems (JSON, version 1.0.0; lengths in metres).
//!
//! Invariant: what the format can say and a [`Site`] cannot (curves, orientations, per-vehicle rules) is named in a warning,
//! never silently dropped; a node, edge or station that contradicts itself is a violation. Called by the command line for `--map`.

use super::draft::{Draft, DraftArea, DraftLane, DraftWaypoint};
use super::grid::site_id_of;
use super::map::{AreaDefaults, Kind, Site, Source};
use crate::limits::SITE_FILE_BYTES;
use crate::reason::{Refusal, Violations};
use serde::Deserialize;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// Metres from the origin that are still believed: 1,000 km.
const REACH_M: f64 = 1_000_000.0;
/// Speeds that a lane limit may have, millimetres per second.
const SPEED_MM_S: std::ops::RangeInclusive<f64> = 50.0..=5_000.0;
/// Warnings listed of one file.
const WARNINGS_MAX: usize = 200;

/// A read layout and what was left out of it.
#[derive(Debug)]
pub struct Import {
    /// The site.
    pub site: Site,
    /// What the file says that the site does not, one sentence each.
    pub warnings: Vec<String>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct File {
    meta_information: Meta,
    layouts: Vec<Layout>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Meta {
    project_identification: String,
    lif_version: String,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Layout {
    layout_id: String,
    #[serde(default)]
    layout_version: String,
    #[serde(default)]
    nodes: Vec<Node>,
    #[serde(default)]
    edges: Vec<Edge>,
    #[serde(default)]
    stations: Vec<Station>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Node {
    node_id: String,
    #[serde(default)]
    map_id: Option<String>,
    node_position: Position,
    #[serde(default)]
    vehicle_type_node_properties: Vec<NodeRule>,
}

#[derive(Deserialize)]
struct Position {
    x: f64,
    y: f64,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct NodeRule {
    #[serde(default)]
    theta: Option<f64>,
    #[serde(default)]
    actions: Vec<Action>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Action {
    action_type: String,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Edge {
    edge_id: String,
    start_node_id: String,
    end_node_id: String,
    #[serde(default)]
    vehicle_type_edge_properties: Vec<EdgeRule>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct EdgeRule {
    #[serde(default)]
    max_speed: Option<f64>,
    #[serde(default)]
    trajectory: Option<Value>,
    #[serde(default)]
    load_restriction: Option<Value>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Station {
    station_id: String,
    #[serde(default)]
    interaction_node_ids: Vec<String>,
}

/// Reads a LIF file. `name` becomes the site's id. Errors: text that is no LIF, or every contradiction in it.
pub fn parse(name: &str, text: &str) -> Result<Import, Refusal> {
    if text.len() > SITE_FILE_BYTES {
        return Err(Refusal::field("file", format!("must be at most {SITE_FILE_BYTES} bytes")));
    }
    let file: File = serde_json::from_str(text)
        .map_err(|e| Refusal::field(&format!("line {}", e.line()), format!("is no LIF: {e}")))?;
    let mut reader = Reader::default();
    if !file.meta_information.lif_version.starts_with("1.") {
        let version = &file.meta_information.lif_version;
        reader.warn(format!("LIF version {version} is not 1.x; it is read as 1.0.0"));
    }
    let kinds = kinds(&file, &mut reader);
    for (at, layout) in file.layouts.iter().enumerate() {
        reader.layout(&format!("layouts[{at}]"), layout, &kinds);
    }
    let first = file.layouts.first();
    let map_id =
        first.and_then(|l| l.nodes.iter().find_map(|n| n.map_id.clone()).or_else(|| Some(l.layout_id.clone())));
    let version = first.map(|l| l.layout_version.clone()).filter(|v| !v.is_empty());
    let title = &file.meta_information.project_identification;
    let draft = Draft {
        site_id: site_id_of(name),
        name: if title.is_empty() { name.to_owned() } else { title.clone() },
        map_id: map_id.unwrap_or_else(|| site_id_of(name)),
        map_version: version.unwrap_or_else(|| "1".to_owned()),
        source: Source::Lif,
        collisions_modelled: true,
        areas: reader.areas,
        waypoints: reader.waypoints,
        lanes: reader.lanes,
        passages: Vec::new(),
        robots: Vec::new(),
    };
    let site = draft.build(reader.violations)?;
    Ok(Import { site, warnings: reader.warnings })
}

/// Which nodes are stations (a station interacts there) or chargers (an action charges there, and no station is there).
fn kinds(file: &File, reader: &mut Reader) -> BTreeMap<String, Kind> {
    let mut kinds = BTreeMap::new();
    let known: BTreeSet<&str> = file.layouts.iter().flat_map(|l| &l.nodes).map(|n| n.node_id.as_str()).collect();
    for node in file.layouts.iter().flat_map(|l| &l.nodes) {
        let mut actions = node.vehicle_type_node_properties.iter().flat_map(|r| &r.actions);
        if actions.any(|a| a.action_type == "startCharging") {
            kinds.insert(node.node_id.clone(), Kind::Charger);
        }
    }
    for (at, layout) in file.layouts.iter().enumerate() {
        for (number, station) in layout.stations.iter().enumerate() {
            let field = format!("layouts[{at}].stations[{number}]");
            if station.interaction_node_ids.is_empty() {
                reader.violations.add(&field, format!("station {} has no interaction node", station.station_id));
            }
            for node in &station.interaction_node_ids {
                if !known.contains(node.as_str()) {
                    reader.violations.add(format!("{field}.interactionNodeIds"), format!("there is no node {node:?}"));
                }
                if kinds.insert(node.clone(), Kind::Station) == Some(Kind::Station) {
                    reader.warn(format!("node {node} belongs to several stations; they share one standing place"));
                }
            }
        }
    }
    kinds
}

#[derive(Default)]
struct Reader {
    violations: Violations,
    warnings: Vec<String>,
    areas: Vec<DraftArea>,
    waypoints: Vec<DraftWaypoint>,
    lanes: Vec<DraftLane>,
    ends: BTreeSet<(String, String)>,
}

impl Reader {
    fn warn(&mut self, text: String) {
        if self.warnings.len() < WARNINGS_MAX {
            self.warnings.push(text);
        }
    }

    /// A name in our letters; others become underscores.
    fn plain(&mut self, name: &str) -> String {
        let plain: String = name
            .chars()
            .map(|c| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' })
            .take(64)
            .collect();
        if plain != name {
            self.warn(format!("{name:?} is called {plain} here"));
        }
        plain
    }

    fn layout(&mut self, field: &str, layout: &Layout, kinds: &BTreeMap<String, Kind>) {
        let area = self.plain(&layout.layout_id);
        let defaults = AreaDefaults::default();
        self.areas.push(DraftArea { field: format!("{field}.layoutId"), id: area.clone(), people: false, defaults });
        for (at, node) in layout.nodes.iter().enumerate() {
            self.node(format!("{field}.nodes[{at}]"), node, &area, kinds);
        }
        for (at, edge) in layout.edges.iter().enumerate() {
            self.edge(format!("{field}.edges[{at}]"), edge);
        }
    }

    fn node(&mut self, field: String, node: &Node, area: &str, kinds: &BTreeMap<String, Kind>) {
        let Position { x, y } = node.node_position;
        if !(x.abs() <= REACH_M && y.abs() <= REACH_M) {
            self.violations.add(format!("{field}.nodePosition"), format!("must lie within {REACH_M} m of the origin"));
            return;
        }
        let turned = node.vehicle_type_node_properties.iter().filter_map(|r| r.theta);
        if turned.into_iter().any(|t| t.abs() > std::f64::consts::PI + 0.001) {
            self.warn(format!("node {}: theta is not within -pi..pi; orientations are not used", node.node_id));
        }
        let kind = kinds.get(&node.node_id).copied().unwrap_or(Kind::Junction);
        let id = self.plain(&node.node_id);
        let (x_mm, y_mm) = ((x * 1_000.0).round() as i64, (y * 1_000.0).round() as i64);
        let area = Some(area.to_owned());
        self.waypoints.push(DraftWaypoint { field, id, x_mm, y_mm, area, kind, capacity: None, reserved: true });
    }

    fn edge(&mut self, field: String, edge: &Edge) {
        let (from, to) = (self.plain(&edge.start_node_id), self.plain(&edge.end_node_id));
        if !self.ends.insert((from.clone(), to.clone())) {
            return self.warn(format!("edge {} is a second one from {from} to {to}; it is left out", edge.edge_id));
        }
        let rules = &edge.vehicle_type_edge_properties;
        if rules.iter().any(|r| r.trajectory.is_some()) {
            self.warn(format!("edge {}: its curve is taken as a straight line", edge.edge_id));
        }
        if rules.iter().any(|r| r.load_restriction.is_some()) {
            self.warn(format!("edge {}: its load restriction is not kept", edge.edge_id));
        }
        let slowest = rules.iter().filter_map(|r| r.max_speed).min_by(f64::total_cmp).map(|m_s| m_s * 1_000.0);
        let kept = slowest.map(|s| s.clamp(*SPEED_MM_S.start(), *SPEED_MM_S.end()));
        if kept != slowest {
            self.warn(format!("edge {}: its speed is brought into {SPEED_MM_S:?} mm/s", edge.edge_id));
        }
        let speed_limit_mm_s = kept.map(|s| s.round() as u32);
        self.lanes.push(DraftLane { field, from, to, length_mm: None, speed_limit_mm_s, wide: false });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::WaypointId;
    use serde_json::json;

    fn two_rooms() -> Value {
        let node = |id: &str, x: f64, y: f64| json!({"nodeId": id, "nodePosition": {"x": x, "y": y}, "vehicleTypeNodeProperties": []});
        let edge = |id: &str, from: &str, to: &str, speed: f64| {
            json!({"edgeId": id, "startNodeId": from, "endNodeId": to,
                "vehicleTypeEdgeProperties": [{"vehicleTypeId": "v", "maxSpeed": speed}, {"vehicleTypeId": "w"}]})
        };
        let mut charger = node("n 3", 3.0, 4.0);
        charger["vehicleTypeNodeProperties"] =
            json!([{"vehicleTypeId": "v", "actions": [{"actionType": "startCharging"}]}]);
        json!({
            "metaInformation": {"projectIdentification": "Two rooms", "creator": "us", "exportTimestamp": "2026-01-01T00:00:00Z", "lifVersion": "1.0.0"},
            "layouts": [
                {"layoutId": "room-1", "layoutVersion": "3", "nodes": [node("n1", 0.0, 0.0), node("n2", 1.2346, 0.0)],
                    "edges": [edge("e1", "n1", "n2", 1.5), edge("e2", "n2", "n1", 9.0), edge("e3", "n2", "n1", 1.0)],
                    "stations": [{"stationId": "s1", "interactionNodeIds": ["n2"]}]},
                {"layoutId": "room-2", "layoutVersion": "1", "nodes": [charger],
                    "edges": [edge("e4", "n1", "n 3", 0.5)], "stations": []},
            ]
        })
    }

    #[test]
    fn nodes_edges_and_stations_become_waypoints_lanes_and_places_in_millimetres() {
        let Import { site, warnings } = parse("Two-Rooms.lif", &two_rooms().to_string()).expect("reads");
        let at = |name: &str| site.find(&WaypointId::parse(name).expect("a name")).expect(name);
        assert_eq!((site.name(), site.map_id(), site.map_version()), ("Two rooms", "room-1", "3"));
        assert_eq!((site.source(), site.lanes().len()), (Source::Lif, 3));
        let station = site.waypoint(at("n2"));
        assert_eq!((station.x_mm, station.kind, station.standing.is_some()), (1235, Kind::Station, true));
        assert_eq!(site.waypoint(at("n_3")).kind, Kind::Charger);
        assert_eq!(site.area_of(at("n_3")).area_id.as_str(), "room-2");
        let lane = site.lane(site.find_lane(at("n1"), at("n_3")).expect("a lane"));
        assert_eq!((lane.length_mm, lane.speed_limit_mm_s), (5000, Some(500)));
        let all = warnings.join("\n");
        for part in ["\"n 3\" is called n_3", "e2: its speed is brought into", "e3 is a second one from n2 to n1"] {
            assert!(all.contains(part), "{part} is not in:\n{all}");
        }
    }

    #[test]
    fn contradictions_are_listed_and_text_that_is_no_layout_is_refused() {
        let mut file = two_rooms();
        file["layouts"][0]["edges"][0]["endNodeId"] = json!("n9");
        file["layouts"][0]["stations"][0]["interactionNodeIds"] = json!(["n8"]);
        file["layouts"][1]["nodes"][0]["nodePosition"]["x"] = json!(1e12);
        let refusal = parse("x", &file.to_string()).expect_err("contradictions");
        let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
        let want = [
            "layouts[0].stations[0].interactionNodeIds",
            "layouts[1].nodes[0].nodePosition",
            "layouts[0].edges[0]",
            "layouts[1].edges[0]",
        ];
        assert_eq!(fields, want);
        assert!(parse("x", "{}").is_err() && parse("x", "[").is_err());
    }

    #[test]
    fn a_whole_file_reads_and_names_what_a_site_cannot_say() {
        let text = include_str!("../../tests/data/cell.lif.json");
        let Import { site, warnings } = parse("cell", text).expect("reads");
        assert_eq!((site.name(), site.map_id(), site.map_version()), ("Press cell", "hall-2", "7"));
        assert_eq!((site.waypoints().len(), site.lanes().len(), site.stations().count()), (4, 4, 2));
        let at = |name: &str| site.find(&WaypointId::parse(name).expect("a name")).expect(name);
        assert_eq!((site.waypoint(at("plug")).kind, site.waypoint(at("gate")).kind), (Kind::Charger, Kind::Junction));
        let slow = site.lane(site.find_lane(at("press"), at("buffer")).expect("a lane"));
        assert_eq!((slow.length_mm, slow.speed_limit_mm_s), (3_500, Some(300)), "the slowest vehicle's speed");
        let all = warnings.join("\n");
        for part in [
            "node press: theta is not within",
            "node press belongs to several stations",
            "edge press-buffer: its curve is taken as a straight line",
            "edge buffer-plug: its load restriction is not kept",
        ] {
            assert!(all.contains(part), "{part} is not in:\n{all}");
        }
        assert_eq!(warnings.len(), 4, "{all}");
    }
}
