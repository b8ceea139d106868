//! Why a file stays as it was, and small files that are there whole or not at all.

use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::COMPONENT_BYTES_MAX;
use std::io;
use std::path::{Path, PathBuf};

/// Why a file stays as it was.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk.
    #[error("{doing} {path}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// With what.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The piece does not begin where the file ends.
    #[error("the file goes on at byte {at}, the piece begins at {offset}")]
    Moved {
        /// Where the next piece must begin.
        at: u64,
        /// Where this one begins.
        offset: u64,
    },
    /// More bytes than the whole has.
    #[error("the file has {length} bytes, the piece ends at {end}")]
    TooLong {
        /// Of the whole.
        length: u64,
        /// Of the piece.
        end: u64,
    },
    /// No file has so many bytes.
    #[error("a file has 1..{COMPONENT_BYTES_MAX} bytes")]
    Size,
    /// There is no room for the rest of it.
    #[error("{missing} bytes are to come, {used} of {quota} are used and {free} are free")]
    Full {
        /// Bytes that are to come.
        missing: u64,
        /// Bytes that are used.
        used: u64,
        /// Bytes that are free.
        free: u64,
        /// Bytes there may be.
        quota: u64,
    },
    /// The disk would not keep its spare bytes.
    #[error("{missing} bytes are to come, the disk has {free} left and {spare} of them stay free")]
    DiskFull {
        /// Bytes that are to come.
        missing: u64,
        /// Bytes that the disk has left.
        free: u64,
        /// Bytes that stay free on it.
        spare: u64,
    },
    /// Another process that shares the folder does not come to an end with it.
    #[error("another process holds {path} for too long")]
    Busy {
        /// The lock.
        path: PathBuf,
    },
    /// This process only reads the folder.
    #[error("{path} is only read here")]
    ReadOnly {
        /// The folder.
        path: PathBuf,
    },
    /// All bytes came, and they are others. They were thrown away.
    #[error("its bytes have the digest {found}")]
    WrongBytes {
        /// What they are.
        found: Digest,
    },
}

/// The disk's error, with what was being done.
pub(crate) fn at(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { doing, path, source }
}

/// Makes durable what a folder says of its files.
pub(crate) fn sync_folder(path: &Path) -> Result<(), Error> {
    midshift_durable::sync_folder(path).map_err(at("syncing", path))
}

/// Writes a small file whole or not at all, and durable.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), Error> {
    midshift_durable::replace(path, bytes).map_err(at("writing", path))
}
