//! Opens the folder of a stop service: with what was kept there, with nothing at a first start that was announced, else with the whole fleet stopped.
//!
//! Invariant: the stop of a lost memory is in the latch before a key is written and before the service listens: an end anywhere in between leaves the fleet
//! stopped too. What cannot be read is moved aside and kept. Nobody changes a folder that another process has.

use crate::audit::{self, Action, Audit, Note};
use crate::engaged::{SavedState, draw_unused};
use crate::error::Error;
use crate::first_start::{FIRST, withdraw_first_start};
use crate::folder::LATCH;
use crate::holder::Holder;
use crate::proof::{Found, Key};
use crate::writer::Writer;
use midshift_core::limits;
use midshift_core::robot::StopLevel;
use midshift_core::stop::latch::{MEMORY_LOST, is_memory_lost};
use midshift_core::stop::{Scope, Stop};
use midshift_core::time::Utc;
use midshift_latch::LatchFile;
use std::path::Path;

/// A folder that is open.
pub struct Opened {
    /// The state that was saved there.
    pub saved: SavedState,
    /// Its one writer.
    pub writer: Writer,
    /// The service's own mark.
    pub key: Key,
    /// What was found, for the audit.
    pub notes: Vec<Note>,
}

/// What of the memory is lost.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Lost {
    Folder,
    LatchGone,
    LatchTorn,
    KeyGone,
    KeyTorn,
}

impl Lost {
    const fn action(self) -> Action {
        match self {
            Self::Folder | Self::LatchGone | Self::LatchTorn => Action::LatchLost,
            Self::KeyGone | Self::KeyTorn => Action::KeyLost,
        }
    }
    const fn why(self) -> &'static str {
        match self {
            Self::Folder => "its folder was empty and no first start was announced",
            Self::LatchGone => "its latch was gone",
            Self::LatchTorn => "its latch could not be read",
            Self::KeyGone => "its key was gone",
            Self::KeyTorn => "its key could not be read",
        }
    }
}

/// Opens the folder for its one process.
///
/// # Errors
/// The disk, or another process has it.
pub fn open(folder: &Path, now: Utc) -> Result<Opened, Error> {
    let failed = |source| Error::Folder { path: folder.to_owned(), source };
    let (path, room) = (folder.join(LATCH), limits::STOP_LATCH_BYTES);
    let is_announced = folder.join(FIRST).exists();
    let found = Key::read(folder).map_err(failed)?;
    let (key, key_lost) = match found {
        Found::There(key) => (*key, None),
        Found::Gone => (Key::draw(), Some(Lost::KeyGone)),
        Found::Torn => (Key::draw(), Some(Lost::KeyTorn)),
    };
    let is_drawn = key_lost.is_some();
    let mut lost = match (path.try_exists().map_err(failed)?, key_lost) {
        (true, _) => None,
        (false, Some(Lost::KeyGone)) if is_announced => None,
        (false, Some(Lost::KeyGone)) => Some(Lost::Folder),
        (false, _) => Some(Lost::LatchGone),
    };
    let mut first = SavedState::default();
    if let Some(lost) = lost {
        stop_fleet(&mut first, &key, lost, now);
    }
    let mut aside = None;
    let (mut file, mut saved) = match LatchFile::open(&path, room, first) {
        Err(midshift_latch::Error::Unreadable { .. } | midshift_latch::Error::Foreign { .. }) => {
            aside = Some(audit::set_aside(&path, now).map_err(failed)?);
            lost = Some(Lost::LatchTorn);
            let mut first = SavedState::default();
            stop_fleet(&mut first, &key, Lost::LatchTorn, now);
            LatchFile::open(&path, room, first)?
        }
        opened => opened?,
    };
    // A first start that was cut short left a latch that nobody has ever written to.
    let is_cut = is_announced && file.generation() == 0 && saved == SavedState::default();
    let lost = lost.or(key_lost.filter(|_| !is_cut));
    let mut notes = Vec::new();
    if let Some(lost) = lost {
        let stop = stop_fleet(&mut saved, &key, lost, now);
        file.write(&saved)?;
        tracing::error!(why = lost.why(), stop_id = %stop.stop_id, "THE MEMORY OF STOPS WAS LOST: the whole fleet is stopped until this stop is reset by name");
        let note = Note::own(now, lost.action()).with("stop_id", &stop.stop_id).with("why", lost.why());
        notes.push(aside.iter().fold(note, |note, aside| note.with("moved_to", aside.display())));
    }
    if is_drawn {
        key.write_into(folder, now).map_err(failed)?;
    }
    withdraw_first_start(folder).map_err(failed)?;
    let (audit, found) = Audit::open(folder, saved.audit.clone(), now);
    if !found.is_empty() {
        tracing::error!("the end of the audit of stops was gone or not whole");
    }
    notes.extend(found);
    let known = saved.audit.clone();
    let _holder = Holder::of_folder(folder).map_err(failed)?;
    Ok(Opened { saved, writer: Writer { _holder, file, audit, known }, key, notes })
}

/// Nobody knows what was engaged: everything is. One such stop that nobody has reset is enough.
fn stop_fleet(saved: &mut SavedState, key: &Key, lost: Lost, now: Utc) -> Stop {
    let is_known = |stop: &&Stop| is_memory_lost(&stop.stop_id) && stop.scope == Scope::Fleet;
    if let Some(known) = saved.latch.effective().find(is_known) {
        return known.clone();
    }
    let stop_id = draw_unused(&saved.latch, MEMORY_LOST, now);
    let mut stop = Stop {
        actor: audit::MIDSHIFT.to_owned(),
        reason: format!("the stop service began without its memory: {}; nobody knows what was engaged", lost.why()),
        ..Stop::new(stop_id, Scope::Fleet, StopLevel::Halt, now)
    };
    key.mark(&mut stop);
    saved.latch.engage(stop.clone());
    stop
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_latch_that_cannot_be_looked_at_is_an_error_and_no_lost_memory() {
        let folder = tempfile::tempdir().unwrap();
        let latch = folder.path().join(LATCH);
        std::os::unix::fs::symlink(&latch, &latch).unwrap();
        assert!(matches!(open(folder.path(), Utc(1)), Err(Error::Folder { .. })));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing was written");
    }
}
