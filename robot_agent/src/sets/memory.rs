//! Sets of a swarm: in memory, shared by handle, so that a simulated crash keeps what a disk would and a power cut
//! loses the rest.
//!
//! Invariant: it holds what was synced, sealed, staged or switched as long as one handle lives. Called by swarms and
//! simulations.

use super::content::Bitmap;
use super::{Error, FileRef, Holdings, Sets, base_name};
use crate::launcher::PROGRAM;
use crate::launcher::boot::{Boot, Image};
use crate::launcher::switch::{FACTORY, Switch};
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{self, Base};
use midshift_bundle::manifest::ComponentKind;
use midshift_bundle::set::SetManifest;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, Cursor};
use std::ops::Range;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A download.
#[derive(Clone, Debug)]
struct Part {
    bytes: Vec<u8>,
    written: Bitmap,
    synced: Bitmap,
}

#[derive(Debug, Default)]
struct State {
    switch: Switch,
    sets: BTreeMap<Digest, SetManifest>,
    content: BTreeMap<Digest, Vec<u8>>,
    parts: BTreeMap<Digest, Part>,
    as_they_are: BTreeSet<Digest>,
    boot: Boot,
    slots: [Vec<u8>; 2],
    room: Option<u64>,
}

/// A handle; clones share what is kept.
#[derive(Clone, Debug, Default)]
pub struct MemorySets(Arc<Mutex<State>>);

impl MemorySets {
    /// What a robot comes with.
    pub fn new() -> Self {
        Self::default()
    }
    /// Leaves so many bytes for content; without it there is no end.
    pub fn limit(&self, room: u64) {
        self.state().room = Some(room);
    }
    /// What was not synced is gone.
    pub fn lose_power(&self) {
        for part in self.state().parts.values_mut() {
            part.written = part.synced.clone();
        }
    }
    /// Changes one byte of content where it lies.
    pub fn rot(&self, digest: &Digest) {
        if let Some(byte) = self.state().content.get_mut(digest).and_then(|bytes| bytes.first_mut()) {
            *byte ^= 1;
        }
    }
    /// The page of a set is not what its name says any more.
    pub fn lose_page(&self, set: &Digest) {
        self.state().sets.remove(set);
    }
    /// What a launcher does with a set that does not live.
    pub fn fall_back(&self, tries: u32) {
        self.state().switch.fall_back(tries);
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn refuse(doing: &'static str, kind: io::ErrorKind) -> Error {
    Error::Io { doing, source: kind.into() }
}

impl State {
    fn used(&self) -> u64 {
        let parts = self.parts.values().map(|part| part.bytes.len());
        self.content.values().map(Vec::len).chain(parts).map(|n| n as u64).sum()
    }
    fn free(&self) -> u64 {
        self.room.map_or(u64::MAX, |room| room.saturating_sub(self.used()))
    }
    fn has(&self, wanted: &FileRef) -> bool {
        self.content.get(&wanted.digest).is_some_and(|bytes| bytes.len() as u64 == wanted.length)
    }
    fn part(&mut self, wanted: &FileRef) -> Result<&mut Part, Error> {
        if self.parts.get(&wanted.digest).is_none_or(|part| part.bytes.len() as u64 != wanted.length) {
            self.parts.remove(&wanted.digest);
            if wanted.length > self.free() {
                return Err(refuse("opening a download", io::ErrorKind::StorageFull));
            }
            let marks = Bitmap::new(wanted.length);
            let length = usize::try_from(wanted.length).unwrap_or(usize::MAX);
            let part = Part { bytes: vec![0; length], written: marks.clone(), synced: marks };
            self.parts.insert(wanted.digest, part);
        }
        match self.parts.get_mut(&wanted.digest) {
            Some(part) => Ok(part),
            None => unreachable!("was put above"),
        }
    }
    fn verify(&self, set: &SetManifest) -> Result<(), Error> {
        self.verify_content(set)?;
        self.verify_base(set)
    }
    fn verify_content(&self, set: &SetManifest) -> Result<(), Error> {
        for component in set.components.values() {
            let bytes = self.content.get(&component.digest).ok_or(Error::Missing(component.digest))?;
            if Digest::of_content(bytes) != component.digest {
                return Err(Error::Corrupt { digest: component.digest });
            }
        }
        Ok(())
    }
    fn verify_base(&self, set: &SetManifest) -> Result<(), Error> {
        let Some(base) = set.base() else { return Ok(()) };
        let slot = self.boot.slot_of(&base_name(set)).ok_or(Error::Missing(base.digest))?;
        let is_whole = Digest::of_content(&self.slots[slot as usize]) == base.digest;
        if is_whole { Ok(()) } else { Err(Error::Corrupt { digest: base.digest }) }
    }
    /// The base of a set that is in the switch record, or of the factory's.
    fn base_of(&self, set: &str) -> Option<String> {
        let set = if set == FACTORY { None } else { Some(self.sets.get(&set.parse().ok()?)?) };
        Some(set.map_or(FACTORY.to_owned(), base_name))
    }
    fn settle(&mut self) {
        if self.switch.trial.is_none()
            && let Some(base) = self.base_of(&self.switch.current)
        {
            self.boot.settle(&base);
        }
    }
    fn install_base(&mut self, set: &SetManifest) -> Result<(), Error> {
        let Some(base) = set.base() else { return Ok(()) };
        self.settle();
        if self.boot.slot_of(&base_name(set)).is_some() {
            return Ok(());
        }
        let spare = self.boot.spare();
        let previous = self.switch.previous.as_ref().and_then(|set| self.base_of(set));
        if previous.is_some_and(|base| self.boot.slot_of(&base) == Some(spare)) {
            self.switch.forget_previous();
            self.switch.number += 1;
        }
        self.slots[spare as usize] = self.content.get(&base.digest).ok_or(Error::Missing(base.digest))?.clone();
        self.boot.put_spare(Some(Image { name: base_name(set), length: base.length }));
        Ok(())
    }
}

impl Sets for MemorySets {
    fn holdings(&mut self) -> Result<Holdings, Error> {
        let state = self.state();
        Ok(Holdings { switch: state.switch.clone(), sets: state.sets.clone(), free_bytes: state.free() })
    }

    fn missing(&mut self, wanted: &FileRef) -> Result<Vec<Range<u64>>, Error> {
        let mut state = self.state();
        if state.has(wanted) { Ok(Vec::new()) } else { Ok(state.part(wanted)?.written.missing()) }
    }

    fn write(&mut self, wanted: &FileRef, offset: u64, bytes: &[u8]) -> Result<(), Error> {
        let mut state = self.state();
        let part = state.part(wanted)?;
        let chunks = part.written.range(offset, bytes.len() as u64);
        let chunks = chunks.ok_or_else(|| refuse("writing a download", io::ErrorKind::InvalidInput))?;
        let at = usize::try_from(offset).unwrap_or(usize::MAX);
        part.bytes[at..at + bytes.len()].copy_from_slice(bytes);
        part.written.mark(chunks);
        Ok(())
    }

    fn sync(&mut self, wanted: &FileRef) -> Result<(), Error> {
        let mut state = self.state();
        if !state.has(wanted) {
            let part = state.part(wanted)?;
            part.synced = part.written.clone();
        }
        Ok(())
    }

    fn seal(&mut self, wanted: &FileRef) -> Result<(), Error> {
        let mut state = self.state();
        if state.has(wanted) {
            return Ok(());
        }
        let part = state.part(wanted)?;
        let whole = part.written.missing().is_empty() && Digest::of_content(&part.bytes) == wanted.digest;
        let part = state.parts.remove(&wanted.digest).filter(|_| whole);
        let part = part.ok_or(Error::Corrupt { digest: wanted.digest })?;
        state.content.insert(wanted.digest, part.bytes);
        Ok(())
    }

    fn decode(&mut self, wanted: &FileRef, base: Option<&Digest>, encoded: &FileRef) -> Result<(), Error> {
        let mut state = self.state();
        let way = state.content.remove(&encoded.digest);
        if state.has(wanted) {
            return Ok(());
        }
        let way = way.ok_or(Error::Missing(encoded.digest))?;
        let base = base.map(|base| state.content.get(base).ok_or(Error::Missing(*base))).transpose()?;
        let (mut base, mut bytes) = (base.map(Cursor::new), Vec::new());
        let base = base.as_mut().map(|base| base as &mut dyn Base);
        let decoded = encoding::decode(base, &mut &*way, wanted.length, &mut bytes);
        if decoded.is_err() || Digest::of_content(&bytes) != wanted.digest {
            return Err(Error::Corrupt { digest: wanted.digest });
        }
        state.parts.remove(&wanted.digest);
        state.content.insert(wanted.digest, bytes);
        Ok(())
    }

    fn fetch_as_it_is(&mut self, wanted: &FileRef) -> Result<(), Error> {
        self.state().as_they_are.insert(wanted.digest);
        Ok(())
    }

    fn is_fetched_as_it_is(&mut self, wanted: &FileRef) -> Result<bool, Error> {
        Ok(self.state().as_they_are.contains(&wanted.digest))
    }

    fn read(&mut self, digest: &Digest, most: u64) -> Result<Vec<u8>, Error> {
        let state = self.state();
        let bytes = state.content.get(digest).ok_or(Error::Missing(*digest))?;
        if bytes.len() as u64 > most {
            return Err(refuse("reading content", io::ErrorKind::FileTooLarge));
        }
        if Digest::of_content(bytes) == *digest { Ok(bytes.clone()) } else { Err(Error::Corrupt { digest: *digest }) }
    }

    fn stage(&mut self, set: &SetManifest) -> Result<(), Error> {
        let mut state = self.state();
        let read_back =
            state.verify_content(set).and_then(|()| state.install_base(set)).and_then(|()| state.verify_base(set));
        match &read_back {
            Ok(()) => {
                state.sets.insert(set.id(), set.clone());
            }
            Err(Error::Corrupt { digest }) => {
                state.sets.remove(&set.id());
                state.content.remove(digest);
            }
            Err(_) => {}
        }
        read_back
    }

    fn verify(&mut self, id: &Digest) -> Result<(), Error> {
        let state = self.state();
        state.verify(state.sets.get(id).ok_or(Error::Missing(*id))?)
    }

    fn check(&mut self, id: &Digest, file: &str) -> Result<(), Error> {
        let state = self.state();
        let set = state.sets.get(id).ok_or(Error::Missing(*id))?;
        let component = if file == PROGRAM { set.program() } else { set.components.get(file) };
        let component = component.ok_or(Error::Missing(*id))?;
        let bytes = state.content.get(&component.digest).ok_or(Error::Missing(component.digest))?;
        if Digest::of_content(bytes) != component.digest {
            return Err(Error::Corrupt { digest: component.digest });
        }
        if component.kind == ComponentKind::Base { state.verify_base(set) } else { Ok(()) }
    }

    fn discard(&mut self, wanted: &FileRef) -> Result<(), Error> {
        self.state().content.retain(|digest, bytes| *digest != wanted.digest || Digest::of_content(bytes) == *digest);
        Ok(())
    }

    fn mend(&mut self, set: &SetManifest) -> Result<(), Error> {
        let mut state = self.state();
        state.verify(set)?;
        state.sets.insert(set.id(), set.clone());
        Ok(())
    }

    fn program(&mut self, _: &Digest) -> Option<PathBuf> {
        None
    }

    fn write_switch(&mut self, switch: &mut Switch) -> Result<(), Error> {
        switch.number += 1;
        let mut state = self.state();
        state.switch = switch.clone();
        state.settle();
        Ok(())
    }

    fn collect(&mut self, keep: &BTreeSet<Digest>) -> Result<(), Error> {
        let mut state = self.state();
        let switch = state.switch.clone();
        state.sets.retain(|id, _| switch.names(&id.to_string()) || keep.contains(id));
        let mut named = keep.clone();
        named.extend(state.sets.values().flat_map(|set| set.components.values().map(|c| c.digest)));
        state.content.retain(|digest, _| named.contains(digest));
        state.parts.retain(|digest, _| named.contains(digest));
        let there: BTreeSet<Digest> = state.content.keys().copied().collect();
        state.as_they_are.retain(|digest| named.contains(digest) && !there.contains(digest));
        Ok(())
    }
}
