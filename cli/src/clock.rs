//! Leaves a person's word that the wall clock of this machine is right.

use anyhow::Context;
use midshift_core::wall_clock::ACCEPTED;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Leaves the word for the server of `data`.
///
/// # Errors
/// The disk.
pub fn leave_word(data: &Path) -> anyhow::Result<()> {
    let path = data.join(ACCEPTED);
    let by = format!("os:{}", rustix::process::getuid().as_raw());
    midshift_durable::replace(&path, by.as_bytes()).with_context(|| format!("writing {}", path.display()))?;
    // Whoever says it may be another user than the server; the data folder is closed to others.
    fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).with_context(|| format!("opening {}", path.display()))
}
