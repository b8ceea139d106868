//! `midshift map …`: site files. Only `map show --robots` needs a server.

use super::client::{Call, Exit};
use super::out::{Format, Out};
use super::{robot, zone};
use crate::site_file;
use clap::Subcommand;
use midshift_core::ids::WaypointId;
use midshift_core::site::show::{Occupants, PlacedRobot};
use midshift_core::site::{Site, grid, lif, lint, show, text};
use midshift_proto::{fleet::v1 as fleet, telemetry::v1};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Verbs of maps.
#[derive(Subcommand)]
pub enum Verb {
    /// Look for rules of maps that a site breaks.
    Lint {
        /// The site file; without it the demo.
        file: Option<PathBuf>,
        /// For so many robots.
        #[arg(long)]
        robots: Option<u64>,
    },
    /// Show a site as text.
    Show {
        /// The site file; without it the demo.
        file: Option<PathBuf>,
        /// Draw the robots of a server where they are, and who has which place.
        #[arg(long)]
        robots: bool,
        #[command(flatten)]
        call: Call,
    },
}

/// Runs one verb.
pub async fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Show { file, robots, call } => {
            let site = site_file::load(file.as_deref(), None, None)?.site;
            let occupants = if robots { Some(find_occupants(&call, &site).await?) } else { None };
            match out.format {
                Format::Json | Format::Jsonl => out.line(&document(&site, occupants.as_ref()).to_string()),
                Format::Name => site.waypoints().iter().for_each(|w| out.line(w.waypoint_id.as_str())),
                Format::Table => out.line(show::show(&site, occupants.as_ref()).trim_end()),
            }
            Ok(())
        }
        Verb::Lint { file, robots } => check(file.as_deref(), robots, out),
    }
}

fn document(site: &Site, occupants: Option<&Occupants>) -> serde_json::Value {
    let place = |p: &midshift_core::site::Place| json!({"placeId": p.place_id, "kind": p.kind_str(), "rule": p.rule_str(), "capacity": p.capacity});
    let waypoint = |w: &midshift_core::site::Waypoint| json!({"waypointId": w.waypoint_id, "xMm": w.x_mm, "yMm": w.y_mm, "kind": w.kind.as_str()});
    let mut whole = json!({
        "siteId": site.site_id(),
        "waypoints": site.waypoints().iter().map(waypoint).collect::<Vec<_>>(),
        "places": site.places().iter().map(place).collect::<Vec<_>>(),
    });
    if let Some(occupants) = occupants {
        let robot = |r: &PlacedRobot| json!({"robotId": r.robot_id, "xMm": r.x_mm, "yMm": r.y_mm, "does": r.does});
        whole["robots"] = occupants.robots.iter().map(robot).collect();
        whole["held"] = json!(occupants.held);
    }
    whole
}

/// Robots that said where they are, and who has which place, as the server knows them.
async fn find_occupants(call: &Call, site: &Site) -> Result<Occupants, Exit> {
    let robots = robot::robots(call).await?.iter().filter_map(|robot| place_robot(site, robot)).collect();
    let places = zone::list(call, true).await?.places;
    let words = |place: &fleet::Place| {
        let words = [zone::describe_holders(place), zone::describe_closure(place)];
        words.into_iter().filter(|words| !words.is_empty()).collect::<Vec<_>>().join(", ")
    };
    let held = places.iter().map(|place| (place.place_id.clone(), words(place)));
    let held = held.filter(|(_, words)| !words.is_empty()).collect();
    Ok(Occupants { robots, held })
}

/// Where a robot is by its pose, or by the waypoint that it passed last. None: it said neither, or the site has no such waypoint.
fn place_robot(site: &Site, robot: &v1::Robot) -> Option<PlacedRobot> {
    let reported = robot.reported.as_ref()?;
    let vitals = reported.vitals.as_ref()?;
    let at = || WaypointId::parse(&vitals.waypoint).ok().and_then(|name| site.find(&name)).map(|at| site.waypoint(at));
    let (x_mm, y_mm) = match &vitals.pose {
        Some(pose) => (pose.x_mm.into(), pose.y_mm.into()),
        None => at().map(|at| (at.x_mm, at.y_mm))?,
    };
    let presence = robot.presence().as_str_name().trim_start_matches("PRESENCE_").to_lowercase();
    let works_on = reported.attempts.iter().filter_map(|listed| listed.attempt.as_ref());
    let words = std::iter::once(presence).chain(works_on.map(|attempt| attempt.subject.clone()));
    Some(PlacedRobot { robot_id: robot.robot_id.clone(), x_mm, y_mm, does: words.collect::<Vec<_>>().join(", ") })
}

fn check(file: Option<&Path>, robots: Option<u64>, out: &Out) -> Result<(), Exit> {
    let (name, body) = match file {
        None => ("demo".to_owned(), midshift_core::site::DEMO.to_owned()),
        Some(path) => {
            let unread = |error: std::io::Error| {
                Exit::new(4, format!("{}: {error}", path.display())).or_try("a site file: .toml, .map or .json")
            };
            let body = std::fs::read_to_string(path).map_err(unread)?;
            (path.display().to_string(), body)
        }
    };
    let stem = file.and_then(Path::file_stem).and_then(|s| s.to_str()).unwrap_or("site");
    let parsed = match file.and_then(Path::extension).and_then(|e| e.to_str()) {
        Some("map") => grid::parse_map(stem, &body),
        Some("json") => lif::parse(stem, &body).map(|import| import.site),
        _ => text::parse(&body),
    };
    let site = parsed.map_err(|refusal| {
        let lines: Vec<String> =
            refusal.violations.iter().map(|v| format!("  {}: {}", v.field, v.description)).collect();
        Exit::usage(format!("{name} cannot be read:\n{}", lines.join("\n")))
    })?;
    let findings = lint::lint(&site, robots);
    match out.format {
        Format::Json | Format::Jsonl => out.line(&serde_json::to_string(&findings).map_err(anyhow::Error::from)?),
        Format::Name => findings.iter().for_each(|f| out.line(f.rule.as_str())),
        Format::Table => {
            for f in &findings {
                out.line(&format!("{:?} {}: {}\n  {}", f.severity, f.rule.as_str(), f.message, f.rule.help()));
            }
        }
    }
    out.inform(&format!(
        "{name}: {} waypoints, {} lanes, {} places, {} findings",
        site.waypoints().len(),
        site.lanes().len(),
        site.places().len(),
        findings.len()
    ));
    if lint::refuses(&findings) {
        Err(Exit::usage(format!("{name} breaks rules that authored sites must keep")))
    } else {
        Ok(())
    }
}
