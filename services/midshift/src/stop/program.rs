//! The program of a stop service as others start it: which one that is, and how long it may take until it answers.

use anyhow::Context;
use std::path::PathBuf;
use std::time::Duration;

/// A stop service that was started answers within this, or `serve` says that it did not.
pub(super) const UP_WITHIN: Duration = Duration::from_secs(10);
/// How often it is looked whether it does.
pub(super) const LOOK_EVERY: Duration = Duration::from_millis(100);

/// This program as it was named when it was started, so that a link to another release leads there; else where it lies. Of one that was replaced on the disk the
/// new one is started.
pub(super) fn program() -> anyhow::Result<PathBuf> {
    let named = std::env::args_os().next().map(PathBuf::from);
    if let Some(named) = named.filter(|named| named.is_absolute() && named.is_file()) {
        return Ok(named);
    }
    let program = std::env::current_exe().context("finding this program")?;
    let named = program.to_str().and_then(|name| name.strip_suffix(" (deleted)")).map(PathBuf::from);
    Ok(named.filter(|named| named.is_file()).unwrap_or(program))
}
