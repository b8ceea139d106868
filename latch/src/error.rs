//! What keeps a value from being kept or read.

use std::io;
use std::path::PathBuf;

/// What keeps a value from being kept or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk says no.
    #[error("{doing} {path}: {source}", path = path.display())]
    Io {
        /// What was being done.
        doing: &'static str,
        /// The file.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Neither slot is whole: something else wrote to it, or the disk lost it.
    #[error("{path} holds no whole value: move it away and look at it; a copy of it from before can be put in its place", path = path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
    },
    /// Its newest value is of a form that this build does not know.
    #[error("{path} holds what this build does not understand: {source}", path = path.display())]
    Foreign {
        /// The file.
        path: PathBuf,
        /// What of it.
        source: serde_json::Error,
    },
    /// Another process writes it.
    #[error("{path} is held by another process", path = path.display())]
    Held {
        /// The file.
        path: PathBuf,
    },
    /// The value does not fit a slot.
    #[error("{bytes} bytes do not fit a slot of {room} bytes")]
    TooLarge {
        /// What it takes.
        bytes: usize,
        /// What there is.
        room: usize,
    },
}
