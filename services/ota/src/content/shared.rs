//! Files in a folder that several processes share: each of them changes it in turns, and looks at it anew at the beginning of its turn.
//!
//! Invariant: nothing that was remembered from an earlier turn counts unless the disk says the same. Of a file that is not whole the
//! mark says who wrote to it last; who finds another there begins from what lies on the disk.

use super::{
    DiskContent, Entry, FileTime, FolderAccess, Inner, Mark, PartialFile, Room, Sharing, Shelf, Whole, read_mark,
    remove,
};
use crate::disk::{Error, at, sync_folder, write_whole};
use midshift_bundle::digest::Digest;
use rustix::fs::{AtFlags, CWD, Timespec, Timestamps, UTIME_NOW, utimensat};
use std::collections::BTreeMap;
use std::fs::{self, OpenOptions};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// A file of a folder.
struct There {
    length: u64,
    changed: FileTime,
}

/// Files of a folder by name; none if it is not there. One that goes meanwhile is left out.
fn there(folder: &Path) -> Result<BTreeMap<String, There>, Error> {
    let gone = |error: &io::Error| error.kind() == io::ErrorKind::NotFound;
    let entries = match fs::read_dir(folder) {
        Err(error) if gone(&error) => return Ok(BTreeMap::new()),
        entries => entries.map_err(at("reading", folder))?,
    };
    let mut found = BTreeMap::new();
    for entry in entries {
        let entry = entry.map_err(at("reading", folder))?;
        let Ok(name) = entry.file_name().into_string() else { continue };
        match entry.metadata() {
            Ok(meta) => found.insert(name, There { length: meta.len(), changed: (meta.mtime(), meta.mtime_nsec()) }),
            Err(error) if gone(&error) => None,
            Err(error) => return Err(at("reading", &entry.path())(error)),
        };
    }
    Ok(found)
}

impl DiskContent {
    /// Opens a folder, made if it is not there, that other processes change too. Blocks. Who is first takes away what no cut should have
    /// left, and what of a file is not durable.
    ///
    /// # Errors
    /// If it cannot be read or mended.
    pub fn join(path: &Path, room: Room, sharing: Sharing) -> Result<Self, Error> {
        fs::create_dir_all(path).map_err(at("making", path))?;
        if sharing.is_first {
            let mended = Self::mended(path, room, FolderAccess::Shared(sharing))?;
            mended.inner.cut()?;
            return Ok(mended);
        }
        let inner = Inner { path: path.to_owned(), room, hand: FolderAccess::Shared(sharing), shelf: Mutex::default() };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// A folder that other processes keep, to be read only. It need not be there yet.
    pub fn reading(path: &Path) -> Self {
        let inner = Inner {
            path: path.to_owned(),
            room: Room::with_quota(0),
            hand: FolderAccess::Reading,
            shelf: Mutex::default(),
        };
        Self { inner: Arc::new(inner) }
    }
}

impl Inner {
    /// Leaves of every part what is known to be durable.
    fn cut(&self) -> Result<(), Error> {
        for (digest, entry) in &self.shelf().parts {
            let path = self.part(*digest);
            let durable = entry.part.lock().unwrap_or_else(PoisonError::into_inner).mark.durable;
            let file = OpenOptions::new().write(true).open(&path).map_err(at("opening", &path))?;
            file.set_len(durable).map_err(at("cutting", &path))?;
        }
        Ok(())
    }

    /// Bytes of a whole file on the disk.
    pub(super) fn length_there(&self, digest: Digest) -> Result<Option<u64>, Error> {
        let path = self.whole(digest);
        match fs::metadata(&path) {
            Ok(meta) => Ok(Some(meta.len())),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(at("reading", &path)(error)),
        }
    }

    /// Tells other processes that somebody brings this file.
    pub(super) fn touch_there(&self, digest: Digest) -> Result<(), Error> {
        if !matches!(self.hand, FolderAccess::Shared(_)) {
            return Ok(());
        }
        let now = || Timespec { tv_sec: 0, tv_nsec: UTIME_NOW };
        let times = Timestamps { last_access: now(), last_modification: now() };
        let path = self.whole(digest);
        utimensat(CWD, &path, &times, AtFlags::empty()).map_err(|e| at("touching", &path)(e.into()))
    }

    /// Says in the mark that this process writes to a part from now on.
    pub(super) fn make_ours(&self, part: &mut PartialFile, digest: Digest) -> Result<(), Error> {
        let FolderAccess::Shared(sharing) = &self.hand else { return Ok(()) };
        if part.mark.writer != Some(sharing.number) {
            let mark = Mark { writer: Some(sharing.number), ..part.mark };
            self.write_mark(digest, &mark)?;
            part.mark = mark;
        }
        Ok(())
    }

    pub(super) fn write_mark(&self, digest: Digest, mark: &Mark) -> Result<(), Error> {
        let text = serde_json::to_vec(mark).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        write_whole(&self.mark(digest), &text)
    }

    /// Makes what is remembered be what is there. It is our turn.
    pub(super) fn refresh_shelf(&self) -> Result<(), Error> {
        let FolderAccess::Shared(sharing) = &self.hand else { return Ok(()) };
        let found = there(&self.path)?;
        let mut shelf = self.shelf();
        let wholes = found.iter().filter_map(|(name, file)| Some((name.parse::<Digest>().ok()?, file)));
        let is_new = take_wholes(&mut shelf, wholes.collect());
        self.take_parts(&mut shelf, sharing.number, &found)?;
        let parts = shelf.parts.values().map(|entry| entry.part.lock().unwrap_or_else(PoisonError::into_inner).written);
        let whole = shelf.whole.values().map(|whole| whole.length);
        shelf.used = whole.chain(parts).sum();
        drop(shelf);
        // Whoever named it may have died before the name was durable.
        if is_new { sync_folder(&self.path) } else { Ok(()) }
    }

    fn take_parts(&self, shelf: &mut Shelf, number: u64, found: &BTreeMap<String, There>) -> Result<(), Error> {
        let mut parts = BTreeMap::new();
        for (name, file) in found {
            let Some(digest) = name.strip_suffix(".part").and_then(|n| n.parse::<Digest>().ok()) else { continue };
            let Some(mark) = read_mark(&self.path, digest, file.length) else {
                // Whoever began it died at once, or is about to forget it and died.
                self.forget(digest)?;
                continue;
            };
            let known = shelf.parts.remove(&digest);
            let touched = match &known {
                Some(known) if known.changed == file.changed => known.touched,
                _ => {
                    shelf.turn += 1;
                    shelf.turn
                }
            };
            let part = match known {
                Some(known) if mark.writer == Some(number) => known.part,
                _ => {
                    let written = file.length.min(mark.length);
                    Arc::new(Mutex::new(PartialFile { mark, written, open: None }))
                }
            };
            parts.insert(digest, Entry { part, touched, changed: file.changed });
        }
        for name in found.keys() {
            let digest = name.strip_suffix(".mark").and_then(|n| n.parse::<Digest>().ok());
            if digest.is_some_and(|digest| !parts.contains_key(&digest)) {
                remove(&self.path.join(name))?;
            }
        }
        shelf.parts = parts;
        Ok(())
    }
}

/// Whether there are some that were not known.
fn take_wholes(shelf: &mut Shelf, found: BTreeMap<Digest, &There>) -> bool {
    shelf.whole.retain(|digest, _| found.contains_key(digest));
    let mut is_new = false;
    for (digest, There { length, changed }) in found {
        match shelf.whole.get(&digest) {
            Some(known) if known.changed == *changed => continue,
            Some(_) => {}
            None => is_new = true,
        }
        shelf.turn += 1;
        let touched = shelf.turn;
        shelf.whole.insert(digest, Whole { length: *length, touched, changed: *changed });
    }
    is_new
}
