//! Loads a site from wherever the user says: the built-in demo, a site file, a grid map, an LIF file.

use anyhow::{Context, bail};
use midshift_core::limits;
use midshift_core::site::{self, Site, Source, grid, lif, lint, text};
use std::path::Path;
use std::sync::Arc;

/// A site with the text it came from.
pub struct Loaded {
    /// The site.
    pub site: Arc<Site>,
    /// Its text, kept in the store.
    pub text: String,
    /// What the lint or the import has to say.
    pub warnings: Vec<String>,
}

/// The site named on the command line; none: the demo.
pub fn load(site: Option<&Path>, map: Option<&Path>, robots: Option<u64>) -> anyhow::Result<Loaded> {
    match (site, map) {
        (Some(_), Some(_)) => bail!("give --site or --map, not both"),
        (None, None) => finish(text::parse(site::DEMO)?, site::DEMO.to_owned(), Vec::new(), robots),
        (Some(path), None) | (None, Some(path)) => read(path, robots),
    }
}

/// Reads a file by its ending: `.map` is a grid, `.json` is LIF, anything else a site file.
pub fn read(path: &Path, robots: Option<u64>) -> anyhow::Result<Loaded> {
    let size = std::fs::metadata(path).with_context(|| format!("reading {}", path.display()))?.len();
    if size > limits::SITE_FILE_BYTES as u64 {
        bail!("{} is larger than {} bytes", path.display(), limits::SITE_FILE_BYTES);
    }
    let body = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    let name = path.file_stem().and_then(|s| s.to_str()).unwrap_or("site");
    let parsed = match path.extension().and_then(|e| e.to_str()) {
        Some("map") => grid::parse_map(name, &body).map(|site| (site, Vec::new())),
        Some("json") => lif::parse(name, &body).map(|import| (import.site, import.warnings)),
        _ => text::parse(&body).map(|site| (site, Vec::new())),
    };
    let (site, warnings) = parsed.map_err(|refusal| {
        let lines: Vec<String> =
            refusal.violations.iter().map(|v| format!("  {}: {}", v.field, v.description)).collect();
        anyhow::anyhow!("{} is not a site that can be used:\n{}", path.display(), lines.join("\n"))
    })?;
    finish(site, body, warnings, robots)
}

fn finish(site: Site, text: String, mut warnings: Vec<String>, robots: Option<u64>) -> anyhow::Result<Loaded> {
    let findings = lint::lint(&site, robots);
    let words = |f: &lint::Finding| format!("{}: {}", f.rule.as_str(), f.message);
    if site.source() == Source::Authored && lint::refuses(&findings) {
        let lines: Vec<String> = findings.iter().map(|f| format!("  {}", words(f))).collect();
        bail!("site {} breaks rules of maps (see `midshift map lint`):\n{}", site.site_id(), lines.join("\n"));
    }
    warnings.extend(findings.iter().map(words));
    Ok(Loaded { site: Arc::new(site), text, warnings })
}
