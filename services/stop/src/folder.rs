//! What stands in the folder of a stop service, for whoever looks at it from outside, also while the service runs.

use crate::audit::{self, Broken, Verified};
use crate::engaged::SavedState;
use midshift_core::stop::Latch;
use std::path::Path;

/// Name of the latch in the folder.
pub const LATCH: &str = "latch";

/// Reads the whole audit in the folder of a stop service, also while it runs.
///
/// # Errors
/// The first thing that is wrong with it.
pub fn verify(folder: &Path) -> Result<Verified, Broken> {
    let (_, saved) = midshift_latch::read::<SavedState>(&folder.join(LATCH))?;
    audit::verify(folder, &saved.audit)
}

/// What the stop service in this folder keeps, and a number that rises with each change of it; also while it runs. None: none was ever started here.
///
/// # Errors
/// The latch cannot be read.
pub fn latch(folder: &Path) -> Result<Option<(u64, Latch)>, midshift_latch::Error> {
    let path = folder.join(LATCH);
    let there = path.try_exists();
    if !there.map_err(|source| midshift_latch::Error::Io { doing: "looking for", path: path.clone(), source })? {
        return Ok(None);
    }
    midshift_latch::read::<SavedState>(&path).map(|(generation, saved)| Some((generation, saved.latch)))
}
