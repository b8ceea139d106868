//! Encoded targets: compressed files and patches of a release as targets of their own, named by digests (SHA-256).
//!
//! `<to>.zst` is the whole file, compressed; `<to>.<from>.patch` is for a robot that has `from`.
//! Invariant: an encoded target is made once, by whoever signs the release, and signed like each other file; what is
//! decoded from it is believed by the digest of the file. Called by `folder`, and by the server, which tells robots of those that are listed.

use crate::digest::Digest;
use crate::repository::FileTarget;
use std::collections::BTreeSet;

/// How a name ends that is the whole file, shorter.
const WHOLE: &str = ".zst";
/// How a name ends that is what another file lacks.
const PATCH: &str = ".patch";

/// A compressed file or a patch, by what is decoded from it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EncodedTarget {
    /// What comes out.
    pub to: Digest,
    /// What a robot must have; none: nothing.
    pub from: Option<Digest>,
}

impl EncodedTarget {
    /// The name of its target.
    pub fn target(&self) -> String {
        match self.from {
            Some(from) => format!("{}.{from}{PATCH}", self.to),
            None => format!("{}{WHOLE}", self.to),
        }
    }
    /// The encoded target of this name; none: it is no name of one.
    pub fn of_target(name: &str) -> Option<Self> {
        let encoded = match name.strip_suffix(PATCH) {
            Some(pair) => {
                let (to, from) = pair.split_once('.')?;
                Self { to: to.parse().ok()?, from: Some(from.parse().ok()?) }
            }
            None => Self { to: name.strip_suffix(WHOLE)?.parse().ok()?, from: None },
        };
        Some(encoded)
    }
}

/// Names of listed encoded targets of files that are `gone`: nobody needs them once those are listed no more.
pub(crate) fn targets_of_gone<'a>(gone: &BTreeSet<Digest>, known: &'a [FileTarget]) -> impl Iterator<Item = &'a str> {
    let names = known.iter().map(|file| file.name.as_str());
    names.filter(move |name| EncodedTarget::of_target(name).is_some_and(|encoded| gone.contains(&encoded.to)))
}
