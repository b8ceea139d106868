//! Why identity cannot be used.

use midshift_core::reason::Refusal;
use std::path::PathBuf;
use std::time::Duration;

/// A process waits so long at its start for whoever has the authority.
pub(crate) const ANSWERED_WITHIN: Duration = Duration::from_secs(120);

/// Why identity cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file or folder.
    #[error("{path}: {source}", path = path.display())]
    Folder {
        /// Where the file or folder is.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A folder or file with keys or other secrets that others may look into.
    #[error("{path} has keys or other secrets and is open to others (mode {mode:03o}): type `chmod go= {path}`, after asking who may have read it", path = path.display())]
    Open {
        /// The folder or file that others may look into.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// A key or certificate on disk.
    #[error("{path} is no key and certificate of this build: {source}", path = path.display())]
    Unreadable {
        /// The file with the key or certificate.
        path: PathBuf,
        /// Why it could not be read.
        source: rcgen::Error,
    },
    /// A name that the server is to be called.
    #[error("a name of the server is none: {source}")]
    Names {
        /// Why no certificate can have it.
        source: rcgen::Error,
    },
    /// A key or signature could not be made.
    #[error("making a key or a certificate: {0}")]
    Signing(#[source] rcgen::Error),
    /// The store has a root and the folder has none, or another one.
    #[error("the store knows another root certificate of this site than {path} has: bring that folder back from a backup; robots and people trust the root in the store", path = path.display())]
    OtherCertificateAuthority {
        /// The folder.
        path: PathBuf,
    },
    /// Nobody answered.
    #[error("no process with role identity signed this server's certificate within {} s: start one on the same store", ANSWERED_WITHIN.as_secs())]
    NotAnswered,
    /// A line of a list of revocations.
    #[error("line {line} of {path} is no revocation that this release knows: {source}", path = path.display())]
    Line {
        /// Of which list.
        path: PathBuf,
        /// Which, from 1.
        line: usize,
        /// What the reader of JSON says.
        source: serde_json::Error,
    },
    /// The store.
    #[error("reading who is known: {0}")]
    Store(#[source] midshift_store::Error),
    /// A decision was refused.
    #[error(transparent)]
    Refused(#[from] Refusal),
}
