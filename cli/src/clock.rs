//! Reads the wall clock of this machine, and leaves a person's word that it is right.

use anyhow::Context;
use midshift_core::time::Utc;
use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// The file of the data folder that is the word.
pub const ACCEPTED: &str = "clock-accepted";

/// UTC of the machine, unix ms.
#[expect(clippy::disallowed_methods, reason = "the one place where the machine's wall clock is read")]
pub fn wall() -> Utc {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Utc(i64::try_from(since.as_millis()).unwrap_or(i64::MAX))
}

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
