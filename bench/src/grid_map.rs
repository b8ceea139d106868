//! A free floor for robots that stand: no places, no errands, a cell for each.

use std::path::{Path, PathBuf};

/// Writes a grid of `side` times `side` free cells.
pub fn write(dir: &Path, side: usize) -> anyhow::Result<PathBuf> {
    let path = dir.join("bench.map");
    let rows = format!("{}\n", ".".repeat(side)).repeat(side);
    std::fs::write(&path, format!("type octile\nheight {side}\nwidth {side}\nmap\n{rows}"))?;
    Ok(path)
}
