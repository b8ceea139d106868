//! `midshift map …`: site files. Needs no server.

use super::client::Exit;
use super::out::{Format, Out};
use crate::site_file;
use clap::Subcommand;
use midshift_core::site::{grid, lif, lint, show, text};
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
    },
}

/// Runs one verb.
pub fn run(verb: Verb, out: &Out) -> Result<(), Exit> {
    match verb {
        Verb::Show { file } => {
            let site = site_file::load(file.as_deref(), None, None)?.site;
            match out.format {
                Format::Json | Format::Jsonl => {
                    let places: Vec<_> = site.places().iter().map(|p| serde_json::json!({"placeId": p.place_id, "kind": p.kind_str(), "rule": p.rule_str(), "capacity": p.capacity})).collect();
                    let waypoints: Vec<_> = site
                        .waypoints()
                        .iter()
                        .map(|w| serde_json::json!({"waypointId": w.waypoint_id, "xMm": w.x_mm, "yMm": w.y_mm, "kind": w.kind.as_str()}))
                        .collect();
                    out.line(
                        &serde_json::json!({"siteId": site.site_id(), "waypoints": waypoints, "places": places})
                            .to_string(),
                    );
                }
                Format::Name => site.waypoints().iter().for_each(|w| out.line(w.waypoint_id.as_str())),
                Format::Table => out.line(show::show(&site).trim_end()),
            }
            Ok(())
        }
        Verb::Lint { file, robots } => check(file.as_deref(), robots, out),
    }
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
