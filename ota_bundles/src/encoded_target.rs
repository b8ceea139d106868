//! Shorter ways to files as targets of their own, whose names say where they lead and from what: `<to>.zst`, and `<to>.<from>.patch` for a robot that has
//! `from`, both as SHA-256.
//!
//! Invariant: a way is made once, by whoever signs the release, and signed like each other file; what comes of it is believed by the digest of the
//! file that it leads to. Called by `folder`, and by the server, which tells robots of those that are listed.

use crate::digest::Digest;
use crate::repository::FileTarget;
use std::collections::BTreeSet;

/// How a name ends that is the whole file, shorter.
const WHOLE: &str = ".zst";
/// How a name ends that is what another file lacks.
const PATCH: &str = ".patch";

/// Where a shorter file leads.
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
    /// The way of this name; none: it is no name of a way.
    pub fn of_target(name: &str) -> Option<Self> {
        let way = match name.strip_suffix(PATCH) {
            Some(pair) => {
                let (to, from) = pair.split_once('.')?;
                Self { to: to.parse().ok()?, from: Some(from.parse().ok()?) }
            }
            None => Self { to: name.strip_suffix(WHOLE)?.parse().ok()?, from: None },
        };
        Some(way)
    }
}

/// Names of listed ways that lead to nothing once `gone` is listed no more.
pub(crate) fn targets_of_gone<'a>(gone: &BTreeSet<Digest>, known: &'a [FileTarget]) -> impl Iterator<Item = &'a str> {
    let names = known.iter().map(|file| file.name.as_str());
    names.filter(move |name| EncodedTarget::of_target(name).is_some_and(|way| gone.contains(&way.to)))
}
