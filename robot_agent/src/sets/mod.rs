//! The software of a robot as files: content by digest, whole sets made of it, and the switch between them.
//!
//! Invariant: a set that the switch record names is whole and was read back from where it lies; nothing it needs is
//! deleted. Every verb may be cut off anywhere and be done again. Two of them: [`disk`] for robots, [`memory`] for
//! swarms and simulations; one contract suite runs over both.

mod content;
pub mod disk;
pub mod memory;
mod slots;

use crate::launcher::switch::{FACTORY, Switch};
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{Component, ComponentKind};
use midshift_bundle::set::SetManifest;
use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::ops::Range;
use std::path::PathBuf;

/// Bytes of one chunk: what a bitmap counts.
pub const CHUNK_BYTES: u64 = 256 * 1024;
/// Chunks after which a download is made durable: 1 MiB, so that a kill costs little beside a download (P9: 2 % of 256
/// MiB cut off four times), and a sync comes seldom beside the bytes of a line that robots have.
pub const CHUNKS_UNSYNCED_MAX: u64 = 4;

/// Why the sets could not be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk refused.
    #[error("{doing}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// Why not.
        source: io::Error,
    },
    /// The bytes are not those that were asked for.
    #[error("{digest} has other bytes than it should")]
    Corrupt {
        /// What it should be.
        digest: Digest,
    },
    /// There is no such set or content.
    #[error("{0} is not there")]
    Missing(Digest),
}

impl Error {
    /// Whether there is no room.
    pub fn is_full(&self) -> bool {
        matches!(self, Self::Io { source, .. } if source.kind() == io::ErrorKind::StorageFull)
    }
}

/// A file by what is in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileRef {
    /// Of its bytes.
    pub digest: Digest,
    /// How many bytes it has.
    pub length: u64,
}

/// What is there.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Holdings {
    /// What runs and what is kept.
    pub switch: Switch,
    /// Whole sets by id.
    pub sets: BTreeMap<Digest, SetManifest>,
    /// Bytes of room.
    pub free_bytes: u64,
}

impl Holdings {
    /// What is in a set that the switch record names: the factory's has no components.
    pub fn set(&self, name: &str) -> Option<SetManifest> {
        if name == FACTORY {
            return Some(SetManifest::default());
        }
        self.sets.get(&name.parse().ok()?).cloned()
    }
    /// Version of a set, of the bundle taken last; none: what the robot came with. A set calls itself by the name and
    /// the version of its bundle; robots report versions that can be compared.
    pub fn version(&self, name: &str) -> Option<String> {
        let set = self.set(name)?;
        set.version.rsplit(' ').next().filter(|v| !v.is_empty()).map(str::to_owned)
    }
    /// The content of a component of kind config in a set.
    pub fn settings(&self, name: &str, component: &str) -> Option<FileRef> {
        let set = self.set(name)?;
        let component = set.components.get(component).filter(|c| c.kind == ComponentKind::Config)?;
        Some(FileRef { digest: component.digest, length: component.length })
    }
    /// Other content of the same component, of the sets that run and are kept: what a patch may be from.
    pub fn bases(&self, component: &Component) -> Vec<Digest> {
        let mut bases: Vec<Digest> = Vec::new();
        for name in [Some(self.switch.running()), self.switch.kept(), self.switch.previous.as_deref()] {
            let there = name.and_then(|name| self.sets.get(&name.parse().ok()?));
            let other = there.and_then(|set| set.components.get(&component.name)).map(|c| c.digest);
            bases.extend(other.filter(|other| *other != component.digest && !bases.contains(other)));
        }
        bases
    }
}

/// The name of a set's base in the boot record.
fn base_name(set: &SetManifest) -> String {
    set.base().map_or(FACTORY.to_owned(), |base| base.digest.to_string())
}

/// Keeps the software of one robot. Calls block; the shell makes them where that does no harm.
pub trait Sets: Send {
    /// What is there.
    ///
    /// # Errors
    /// A disk that cannot be read, or a damaged switch record.
    fn holdings(&mut self) -> Result<Holdings, Error>;
    /// Ranges of a file that are not durable here, whole chunks, ascending. Empty: all of it is.
    ///
    /// # Errors
    /// The disk's.
    fn missing(&mut self, wanted: &FileRef) -> Result<Vec<Range<u64>>, Error>;
    /// Takes bytes that begin and end at chunks, or at the end of the file. Durable after [`Sets::sync`].
    ///
    /// # Errors
    /// The disk's; `InvalidInput` for bytes that do not lie so.
    fn write(&mut self, wanted: &FileRef, offset: u64, bytes: &[u8]) -> Result<(), Error>;
    /// What was written is durable, and stays if the power goes.
    ///
    /// # Errors
    /// The disk's.
    fn sync(&mut self, wanted: &FileRef) -> Result<(), Error>;
    /// Checks the whole file from the same handle that was written and makes it content. Nothing to do if it is that
    /// already.
    ///
    /// # Errors
    /// [`Error::Corrupt`]: all of it is thrown away.
    fn seal(&mut self, wanted: &FileRef) -> Result<(), Error>;
    /// Makes content of an encoded target of it that is there whole, from `base` if it is a patch, and checks it as
    /// [`Sets::seal`] does. The encoded target goes, whatever comes of it. Nothing to do if the content is there already.
    ///
    /// # Errors
    /// [`Error::Corrupt`] if it does not lead to what is wanted; a base that is not there; the disk's.
    fn decode(&mut self, wanted: &FileRef, base: Option<&Digest>, encoded: &FileRef) -> Result<(), Error>;
    /// No encoded target of this file is tried any more; durable, until the file is there.
    ///
    /// # Errors
    /// The disk's.
    fn fetch_as_it_is(&mut self, wanted: &FileRef) -> Result<(), Error>;
    /// Whether [`Sets::fetch_as_it_is`] was said of it.
    ///
    /// # Errors
    /// The disk's.
    fn is_fetched_as_it_is(&mut self, wanted: &FileRef) -> Result<bool, Error>;
    /// Content in memory, for small files.
    ///
    /// # Errors
    /// If it is not there, or has more than `most` bytes.
    fn read(&mut self, digest: &Digest, most: u64) -> Result<Vec<u8>, Error>;
    /// Makes a set of content that is there and reads it back. Nothing to do if it is there already. A base that lies
    /// in neither slot is written over the spare one; if the set before needs what was there, the switch record forgets
    /// it first.
    ///
    /// # Errors
    /// Content that is missing or not what it should be; the disk's.
    fn stage(&mut self, set: &SetManifest) -> Result<(), Error>;
    /// Reads every file of a set again, and its base where the machine starts it from.
    ///
    /// # Errors
    /// What is missing or wrong.
    fn verify(&mut self, id: &Digest) -> Result<(), Error>;
    /// Reads one file of a set again: a component by its name, with the base where the machine starts it from, or
    /// [`crate::launcher::PROGRAM`].
    ///
    /// # Errors
    /// If it is missing or wrong.
    fn check(&mut self, set: &Digest, file: &str) -> Result<(), Error>;
    /// Throws content away that has other bytes than it should. Nothing to do if it is right, or not there.
    ///
    /// # Errors
    /// The disk's.
    fn discard(&mut self, wanted: &FileRef) -> Result<(), Error>;
    /// Puts the page of a set and its files in place of what lies there, one by one, of content that is there, and
    /// reads it back.
    ///
    /// # Errors
    /// Content that is missing; what cannot be mended so, as a base; the disk's.
    fn mend(&mut self, set: &SetManifest) -> Result<(), Error>;
    /// The program of a set as it can be called; none: these sets are of robots in memory, which run no programs and
    /// have no data.
    fn program(&mut self, set: &Digest) -> Option<PathBuf>;
    /// Replaces the switch record. The base of a set that it makes current becomes good.
    ///
    /// # Errors
    /// The disk's: the old one or this is there.
    fn write_switch(&mut self, switch: &mut Switch) -> Result<(), Error>;
    /// Deletes sets and content that neither the switch record nor `keep` names, once both copies of the records agree.
    ///
    /// # Errors
    /// The disk's.
    fn collect(&mut self, keep: &BTreeSet<Digest>) -> Result<(), Error>;
}
