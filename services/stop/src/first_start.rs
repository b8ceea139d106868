//! The file by which whoever makes a store announces the first start of a stop service: without it one that finds nothing begins with the fleet stopped.
//!
//! Invariant: it counts only where neither latch nor key is there, and it is gone before the service listens: it opens one start and no other.
//! Called by whoever has the store, before the stop service beside it is started; taken by the stop service as it opens its folder.

use crate::folder::LATCH;
use crate::proof;
use std::fs::DirBuilder;
use std::io;
use std::os::unix::fs::DirBuilderExt;
use std::path::Path;

/// Its name in the folder.
pub const FIRST: &str = "first";
/// What a person reads who finds it.
const TEXT: &[u8] = b"The store of this site is new: the stop service may begin with nothing engaged, once.\n";

/// Announces the first start of the stop service with this folder; durable when it returns. False: there is a latch or a key, so that it was no first start.
///
/// # Errors
/// The disk: what cannot be looked at may be a latch.
pub fn announce_first_start(folder: &Path) -> io::Result<bool> {
    DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
    if folder.join(LATCH).try_exists()? || folder.join(proof::NAME).try_exists()? {
        return Ok(false);
    }
    midshift_durable::replace_with(&folder.join(FIRST), TEXT, midshift_durable::PRIVATE)?;
    Ok(true)
}

/// Takes the announcement back, if there is one: the store knows of robots, so that a folder with nothing in it was lost. Whether there was one.
///
/// # Errors
/// The disk.
pub fn withdraw_first_start(folder: &Path) -> io::Result<bool> {
    midshift_durable::remove(&folder.join(FIRST))
}
