//! Loads a site from wherever the user says: the built-in demo, a site file, a grid map, an LIF file.

use anyhow::{Context, bail};
use midshift_core::limits;
use midshift_core::site::file;
use std::path::Path;

pub use midshift_core::site::file::Loaded;

/// The site named on the command line; none: the demo.
pub fn load(site: Option<&Path>, map: Option<&Path>, robots: Option<u64>) -> anyhow::Result<Loaded> {
    match (site, map) {
        (Some(_), Some(_)) => bail!("give --site or --map, not both"),
        (None, None) => Ok(file::demo(robots)?),
        (Some(path), None) | (None, Some(path)) => read(path, robots),
    }
}

/// Reads a file by its ending: `.map` is a grid, `.json` is LIF, anything else a site file.
pub fn read(path: &Path, robots: Option<u64>) -> anyhow::Result<Loaded> {
    let body = midshift_durable::read_text(path, limits::SITE_FILE_BYTES as u64);
    Ok(file::parse(path, body.with_context(|| format!("reading {}", path.display()))?, robots)?)
}
