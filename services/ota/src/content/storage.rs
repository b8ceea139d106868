//! The storage interface for files of releases: the trait [`Content`] and its values.

use crate::disk::Error;
use async_trait::async_trait;
use bytes::Bytes;
use midshift_bundle::digest::Digest;
use midshift_core::limits;
use std::ops::Range;
use tokio::io::AsyncRead;

/// How much room files have, and how long they have it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Room {
    /// Bytes of all files, and of what is made of them, at most.
    pub quota_bytes: u64,
    /// Bytes that stay free on the disk.
    pub spare_bytes: u64,
    /// Milliseconds of serving time that a file is kept which nothing names.
    pub unnamed_ms: u64,
}

impl Room {
    /// So many bytes, all of the disk, and files that nothing names for as long as servers keep them that were told nothing else.
    pub const fn with_quota(quota_bytes: u64) -> Self {
        let unnamed_ms = limits::SOFTWARE_UNNAMED_DAYS_DEFAULT * 24 * 3_600_000;
        Self { quota_bytes, spare_bytes: 0, unnamed_ms }
    }
}

/// Bytes that are used of those there may be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fill {
    /// Of all files, and of what was made of them.
    pub used_bytes: u64,
    /// There may be.
    pub quota_bytes: u64,
}

/// A file that is stored, whole or in part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StoredFile {
    /// Of the whole.
    pub digest: Digest,
    /// That are here.
    pub bytes: u64,
    /// Rises with each touch of any file by somebody who brings it. 0: not touched since the start.
    pub touched: u64,
}

/// A file by its digest and length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileRef {
    /// Of the whole.
    pub digest: Digest,
    /// Bytes of the whole.
    pub length: u64,
}

/// How much of a file is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Completeness {
    /// All of it, and it is what its digest says.
    Whole,
    /// So many bytes from the beginning, durable.
    Part(u64),
}

/// Bytes of a range, in order.
pub type Reader = Box<dyn AsyncRead + Send + Unpin>;

/// Where files of releases are kept.
#[async_trait]
pub trait Content: Send + Sync + 'static {
    /// Bytes of a whole file; none: it is not here.
    async fn length(&self, digest: Digest) -> Result<Option<u64>, Error>;
    /// Adds a piece at `offset`, where what is here ends. It is durable once [`Content::settle`] says so. Another length than before
    /// begins the file anew.
    async fn append(&self, file: FileRef, offset: u64, piece: Bytes) -> Result<(), Error>;
    /// Makes durable what is here of a file, checks it if it is all, and says how much it is.
    async fn settle(&self, file: FileRef) -> Result<Completeness, Error>;
    /// Bytes of a whole file, cut at its end; none: it is not here.
    async fn read(&self, digest: Digest, range: Range<u64>) -> Result<Option<Reader>, Error>;
    /// Every file that is here, whole or not, by digest.
    async fn list(&self) -> Result<Vec<StoredFile>, Error>;
    /// Takes a file away, whole or not, and says how many bytes that were. 0: it is not here, or a piece is being added to it. Whoever has
    /// begun to read it reads on.
    async fn remove(&self, digest: Digest) -> Result<u64, Error>;
    /// How full it is.
    fn fill(&self) -> Fill;
}
