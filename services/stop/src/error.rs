//! What keeps the service from beginning, or ends it.

use std::io;
use std::path::PathBuf;

/// What keeps the service from beginning, or ends it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The folder says no.
    #[error("opening the folder of stops {path}: {source}", path = path.display())]
    Folder {
        /// The folder of stops.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The latch cannot be held.
    #[error(transparent)]
    Latch(#[from] midshift_latch::Error),
    /// The descriptors of its own services cannot be read.
    #[error("building reflection: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
    /// A part of it ended.
    #[error("a part of the stop service ended by itself")]
    Ended,
}

impl Error {
    /// Another process has the folder.
    pub fn is_held(&self) -> bool {
        matches!(self, Self::Latch(midshift_latch::Error::Held { .. }))
    }
}
