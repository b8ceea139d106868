//! Sets in a folder on a disk that may have no room left: what must add to it is refused, whatever else goes on.

use midshift_agent::sets::disk::DiskSets;
use midshift_agent::sets::{Error, FileRef, Holdings, Sets};
use midshift_agent::switch::Switch;
use midshift_bundle::digest::Digest;
use midshift_bundle::set::SetManifest;
use std::collections::BTreeSet;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};
use std::sync::{Arc, Mutex, MutexGuard};

/// The sets of one agent process; clones share them.
#[derive(Clone)]
pub struct CrowdedSets {
    disk: Arc<Mutex<DiskSets>>,
    is_full: Arc<AtomicBool>,
    refused: Arc<AtomicU64>,
}

impl CrowdedSets {
    /// As an agent opens them that its launcher started from the set `started`.
    pub fn open(folder: &Path, started: &str, is_full: bool) -> Self {
        let mut disk = DiskSets::open(folder).expect("opens");
        disk.started_from(started).expect("tells");
        let is_full = Arc::new(AtomicBool::new(is_full));
        Self { disk: Arc::new(Mutex::new(disk)), is_full, refused: Arc::default() }
    }
    /// The disk has room again.
    pub fn make_room(&self) {
        self.is_full.store(false, SeqCst);
    }
    /// Calls that found no room.
    pub fn refused(&self) -> u64 {
        self.refused.load(SeqCst)
    }
    fn disk(&self) -> MutexGuard<'_, DiskSets> {
        self.disk.lock().expect("nobody panics with it")
    }
    fn is_full(&self) -> bool {
        self.is_full.load(SeqCst)
    }
    fn find_room(&self, doing: &'static str) -> Result<(), Error> {
        if !self.is_full() {
            return Ok(());
        }
        self.refused.fetch_add(1, SeqCst);
        Err(Error::Io { doing, source: io::ErrorKind::StorageFull.into() })
    }
}

impl Sets for CrowdedSets {
    fn holdings(&mut self) -> Result<Holdings, Error> {
        let holdings = self.disk().holdings()?;
        let free_bytes = if self.is_full() { 0 } else { holdings.free_bytes };
        Ok(Holdings { free_bytes, ..holdings })
    }

    fn missing(&mut self, wanted: &FileRef) -> Result<Vec<Range<u64>>, Error> {
        let missing = self.disk().missing(wanted)?;
        if !missing.is_empty() {
            self.find_room("opening a download")?;
        }
        Ok(missing)
    }

    fn write(&mut self, wanted: &FileRef, offset: u64, bytes: &[u8]) -> Result<(), Error> {
        self.find_room("writing a download")?;
        self.disk().write(wanted, offset, bytes)
    }

    fn sync(&mut self, wanted: &FileRef) -> Result<(), Error> {
        self.disk().sync(wanted)
    }

    fn seal(&mut self, wanted: &FileRef) -> Result<(), Error> {
        self.disk().seal(wanted)
    }

    fn decode(&mut self, wanted: &FileRef, base: Option<&Digest>, encoded: &FileRef) -> Result<(), Error> {
        self.find_room("making content")?;
        self.disk().decode(wanted, base, encoded)
    }

    fn fetch_as_it_is(&mut self, wanted: &FileRef) -> Result<(), Error> {
        self.find_room("noting a way")?;
        self.disk().fetch_as_it_is(wanted)
    }

    fn is_fetched_as_it_is(&mut self, wanted: &FileRef) -> Result<bool, Error> {
        self.disk().is_fetched_as_it_is(wanted)
    }

    fn read(&mut self, digest: &Digest, most: u64) -> Result<Vec<u8>, Error> {
        self.disk().read(digest, most)
    }

    fn stage(&mut self, set: &SetManifest) -> Result<(), Error> {
        let is_there = self.disk().holdings()?.sets.contains_key(&set.id());
        if !is_there {
            self.find_room("making a set")?;
        }
        self.disk().stage(set)
    }

    fn verify(&mut self, id: &Digest) -> Result<(), Error> {
        self.disk().verify(id)
    }

    fn check(&mut self, set: &Digest, file: &str) -> Result<(), Error> {
        self.disk().check(set, file)
    }

    fn discard(&mut self, wanted: &FileRef) -> Result<(), Error> {
        self.disk().discard(wanted)
    }

    fn mend(&mut self, set: &SetManifest) -> Result<(), Error> {
        self.find_room("mending a set")?;
        self.disk().mend(set)
    }

    fn program(&mut self, set: &Digest) -> Option<PathBuf> {
        self.disk().program(set)
    }

    fn write_switch(&mut self, switch: &mut Switch) -> Result<(), Error> {
        self.find_room("writing the switch record")?;
        self.disk().write_switch(switch)
    }

    fn collect(&mut self, keep: &BTreeSet<Digest>) -> Result<(), Error> {
        self.disk().collect(keep)
    }
}
