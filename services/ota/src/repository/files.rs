//! Files of the folder of documents: their names, and how they are read.

use super::error::{Error, io};
use super::newest::Publishers;
use crate::disk::write_whole;
use midshift_bundle::digest::Digest;
use midshift_core::time::Utc;
use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::path::Path;

/// What names the newest of everything.
pub const TIMESTAMP: &str = "timestamp.json";
/// When each bundle was seen first, by its digest. Not shown.
pub const SEEN: &str = "seen.json";
/// Who published what, for the audit.
pub const BY: &str = "by.json";
/// Lowest version of what is signed here from now on, as a number. Only a restored repository has it. Not shown.
const FLOOR: &str = "floor.json";

/// Makes what is signed in `folder` from now on have at least this version: robots have seen versions that a restored repository does not
/// know of, and take nothing older. A version below that of an earlier call changes nothing. Nobody may serve from it.
///
/// # Errors
/// If what an earlier call said cannot be read, or it cannot be written.
pub fn raise_floor(folder: &Path, version: u64) -> Result<(), Error> {
    let version = version.max(read_floor(folder)?);
    Ok(write_whole(&folder.join(FLOOR), version.to_string().as_bytes())?)
}

/// Lowest version of what is signed in a folder.
pub fn read_floor(folder: &Path) -> Result<u64, Error> {
    let bytes = read(&folder.join(FLOOR))?.unwrap_or_else(|| b"1".to_vec());
    serde_json::from_slice(&bytes)
        .map_err(|e| Error::Damaged { folder: folder.to_owned(), text: format!("{FLOOR}: {e}") })
}

/// When each bundle was seen first.
pub fn read_seen(folder: &Path) -> Result<BTreeMap<Digest, Utc>, Error> {
    let bytes = read(&folder.join(SEEN))?.unwrap_or_else(|| b"{}".to_vec());
    serde_json::from_slice(&bytes)
        .map_err(|e| Error::Damaged { folder: folder.to_owned(), text: format!("{SEEN}: {e}") })
}

/// Who published what.
pub fn read_publishers(folder: &Path) -> Result<Publishers, Error> {
    let bytes = read(&folder.join(BY))?.unwrap_or_else(|| b"{}".to_vec());
    serde_json::from_slice(&bytes).map_err(|e| Error::Damaged { folder: folder.to_owned(), text: format!("{BY}: {e}") })
}

/// Name of a document.
pub fn file(version: u64, role: &str) -> String {
    format!("{version}.{role}.json")
}

/// A file of the folder; none: it is not there.
pub fn read(path: &Path) -> Result<Option<Vec<u8>>, Error> {
    match fs::read(path) {
        Ok(bytes) => Ok(Some(bytes)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        Err(error) => Err(io("reading", path)(error)),
    }
}
