//! What the updater asks to be done, and what comes of it.
//!
//! Invariant: each side effect of an update is a [`Job`]; at most one is under way.

use crate::launcher::switch::Switch;
use crate::sets::{FileRef, Holdings};
use crate::storage::DueMigration;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::Manifest;
use midshift_bundle::set::SetManifest;
use midshift_bundle::trust::{Reading, Refreshed, Trusted};
use midshift_core::ids::SetId;
use midshift_core::reason::Reason;
use std::collections::{BTreeMap, BTreeSet};

/// Something that takes time, done outside the core.
#[derive(Clone, Debug, PartialEq)]
pub enum Job {
    /// What is on the disk?
    Look,
    /// Ask the repository what there is.
    Refresh {
        /// What is believed so far.
        trusted: Box<Trusted>,
        /// The robot's clock.
        clock: Reading,
        /// Number of the set of directive keys that it has: newer ones are fetched.
        keys_after: u64,
    },
    /// Have this content, whole and checked.
    Fetch {
        /// Digest and length of the content.
        wanted: FileRef,
        /// Content that a patch may be from: the same component in other sets, the running one first.
        bases: Vec<Digest>,
        /// Bytes a second; 0: as fast as it goes.
        rate_bytes_s: u32,
    },
    /// Fetch and read a manifest.
    Manifest {
        /// Digest and length of the manifest.
        wanted: FileRef,
    },
    /// Make a set of what is there and read it back.
    Stage(Box<SetManifest>),
    /// Read a set again.
    Verify(SetId),
    /// Read one file of a set again.
    Check {
        /// The set.
        set: Digest,
        /// Name of a component, or of the program as the launcher calls it.
        file: String,
    },
    /// Have every file of a set as it was signed: what lies there otherwise comes anew.
    Mend(Box<SetManifest>),
    /// Write the switch record.
    Write(Switch),
    /// Have a committed set do something to the robot's data.
    Migrate {
        /// The set.
        set: Digest,
        /// What it is to do.
        due: DueMigration,
    },
    /// Delete what nobody needs.
    Collect(BTreeSet<Digest>),
}

impl Job {
    /// Its name in the log.
    pub const fn as_str(&self) -> &'static str {
        match self {
            Self::Look => "look",
            Self::Refresh { .. } => "refresh",
            Self::Fetch { .. } => "fetch",
            Self::Manifest { .. } => "manifest",
            Self::Stage(_) => "stage",
            Self::Verify(_) => "verify",
            Self::Check { .. } => "check",
            Self::Mend(_) => "mend",
            Self::Write(_) => "write",
            Self::Migrate { .. } => "migrate",
            Self::Collect(_) => "collect",
        }
    }
}

/// What came of a job.
#[derive(Clone, Debug)]
pub enum Done {
    /// What is there.
    Holdings(Box<Holdings>),
    /// What the repository lists.
    Refreshed {
        /// To be believed.
        refreshed: Box<Refreshed>,
        /// Envelopes of newer sets of directive keys, by the number under which they are listed.
        key_sets: BTreeMap<u64, Vec<u8>>,
    },
    /// The repository gave something to be believed, and not what was asked for.
    Believed {
        /// What is believed now.
        trusted: Box<Trusted>,
        /// Why not the rest.
        failure: Failure,
    },
    /// A manifest.
    Manifest {
        /// As it was read.
        manifest: Box<Manifest>,
        /// As it was signed.
        bytes: Vec<u8>,
    },
    /// Done as asked.
    Ok,
    /// Written, with its number.
    Written(Switch),
    /// Not done.
    Failed(Failure),
}

/// Why a job was not done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Failure {
    /// The server or the disk does not answer: tried again.
    Later(String),
    /// It will not be otherwise next time.
    Refused(Reason),
}
