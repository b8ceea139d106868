//! Why the repository stays as it was.

use crate::content;
use crate::folder;
use midshift_bundle::keys;
use midshift_bundle::repository::{self as people, FileTarget};
use midshift_core::reason::Refusal;
use midshift_core::time::Doubt;
use std::io;
use std::path::{Path, PathBuf};

/// Why the repository stays as it was.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk.
    #[error(transparent)]
    Disk(#[from] content::Error),
    /// A key file.
    #[error(transparent)]
    Key(#[from] keys::Error),
    /// A document of this server.
    #[error(transparent)]
    Document(#[from] people::Error),
    /// The folder has no key of a role.
    #[error("{folder} has no {role}-*.pem")]
    NoKeyFile {
        /// Where they should be.
        folder: PathBuf,
        /// The role whose keys are missing.
        role: &'static str,
    },
    /// None of the server's keys may sign.
    #[error(
        "the repository's root {root_version} names other {role} keys than this server has: it is another project's repository, or its new keys are not in the server's folder of keys"
    )]
    NotNamed {
        /// The root.
        root_version: u64,
        /// The role that has other keys there.
        role: &'static str,
    },
    /// The folder is not this store's, or not there.
    #[error(transparent)]
    Folder(#[from] folder::Error),
    /// What is offered breaks rules.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// Somebody else published.
    #[error("the newest targets document is {newest}, not {expected}")]
    Moved {
        /// Version that is the newest; 0: none.
        newest: u64,
        /// Version that was expected.
        expected: u64,
    },
    /// Files are listed that are not here.
    #[error("{} listed files are not here, the first is {}", .0.len(), .0.first().map_or("", |f| f.name.as_str()))]
    Missing(Vec<FileTarget>),
    /// The wall is in doubt, and everything that is signed has its time.
    #[error("nothing is signed by a clock that is {step_ms} ms off", step_ms = .0.step_ms)]
    Clock(Doubt),
    /// What lies on the disk does not hang together.
    #[error("{folder}: {text}")]
    Damaged {
        /// The documents.
        folder: PathBuf,
        /// What does not hold.
        text: String,
    },
}

/// The disk's error, with what was being done.
pub(super) fn io(doing: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Error {
    let path = path.to_owned();
    move |source| content::Error::Io { doing, path, source }.into()
}
