//! Shorter ways in a folder that several processes share: what others made is found, and one of them makes at a time.
//!
//! Invariant: a way has its name only when it is whole, so whatever has a name may be handed out; a process that only reads asks for none and
//! gives the best that is there.

use super::{Encodings, Hand, Inner, Key, Shelf, Way, at};
use crate::blocking;
use crate::content::{Content, Error};
use crate::folder::{Gate, Turn};
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{ENCODED_BYTES_MAX, ENCODED_BYTES_MIN, Encoded};
use midshift_core::limits;
use std::collections::BTreeMap;
use std::fs;
use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// A look at a folder.
pub struct Seen {
    /// When the folder changed last, as its file system says: seconds and nanoseconds. None: it was not there.
    changed: Option<(i64, i64)>,
    /// When that was.
    at: Instant,
}

impl Encodings {
    /// Opens a folder, made if it is not there, in which other processes make ways too; `number` is of this process alone. Blocks. Who is first
    /// takes away what was not finished.
    ///
    /// # Errors
    /// If it cannot be read or mended.
    pub fn join(
        folder: &Path,
        content: Arc<dyn Content>,
        gate: Gate,
        number: u64,
        is_first: bool,
    ) -> Result<Self, Error> {
        fs::create_dir_all(folder).map_err(at("making", folder))?;
        if is_first {
            for entry in fs::read_dir(folder).map_err(at("reading", folder))? {
                let path = entry.map_err(at("reading", folder))?.path();
                if path.file_name().and_then(|name| name.to_str()).and_then(Key::of_name).is_none() {
                    fs::remove_file(&path).map_err(at("removing", &path))?;
                }
            }
        }
        let made = Self::new(folder, Hand::Shared(gate, number), content, Shelf::default());
        made.inner.look(Instant::now())?;
        Ok(made)
    }

    /// A folder in which other processes make ways, to be read only. It need not be there yet.
    pub fn reading(folder: &Path, content: Arc<dyn Content>) -> Self {
        Self::new(folder, Hand::Reading, content, Shelf::default())
    }

    /// Learns what other processes made and took away, if this was not done just now.
    ///
    /// # Errors
    /// The disk's.
    pub async fn follow(&self) -> Result<(), Error> {
        if matches!(self.inner.hand, Hand::Alone) {
            return Ok(());
        }
        let (inner, now) = (self.inner.clone(), Instant::now());
        blocking(move || inner.look(now)).await
    }

    /// Has these ways made without being asked by a robot, if they are not: the first of them first, as many as may wait.
    pub fn want(&self, keys: impl IntoIterator<Item = Key>) {
        let mut shelf = self.inner.shelf();
        for key in keys {
            if !shelf.is_decided(&key) && !shelf.queue(key) {
                break;
            }
        }
        drop(shelf);
        self.inner.wake.notify_one();
    }

    pub(super) fn is_asked(&self) -> bool {
        !self.inner.shelf().queue.is_empty()
    }

    /// Waits until no other process makes a way.
    pub(super) async fn turn(&self) -> Result<Option<Turn>, Error> {
        match &self.inner.hand {
            Hand::Shared(gate, _) => gate.take().await.map(Some),
            Hand::Alone | Hand::Reading => Ok(None),
        }
    }

    /// Learns what was made and how full it is.
    pub(super) async fn look_before_making(&self) -> Result<(), Error> {
        if matches!(self.inner.hand, Hand::Shared(..)) {
            self.inner.content.list().await?;
        }
        self.follow().await
    }
}

impl Inner {
    /// The best way that is there.
    pub(super) fn made(&self, full: Key, bases: &[Digest]) -> Way {
        let mut shelf = self.shelf();
        let patches = bases.iter().map(|base| Key { base: Some(*base), ..full });
        for key in patches.chain([full]) {
            if let Some(encoded) = shelf.touch(key) {
                return Way::Encoded(key, encoded);
            }
        }
        Way::Identity
    }

    fn look(&self, now: Instant) -> Result<(), Error> {
        let changed = match fs::metadata(&self.folder) {
            Ok(meta) => Some((meta.mtime(), meta.mtime_nsec())),
            Err(error) if error.kind() == ErrorKind::NotFound => None,
            Err(error) => return Err(at("reading", &self.folder)(error)),
        };
        // Two changes at one tick of the file system look like one: so the time counts too.
        let every = Duration::from_millis(limits::SOFTWARE_FOLLOW_EVERY_MS);
        let is_new = |seen: &Seen| seen.changed == changed && now.saturating_duration_since(seen.at) < every;
        if self.shelf().seen.as_ref().is_some_and(is_new) {
            return Ok(());
        }
        let mut there: BTreeMap<Key, Encoded> = BTreeMap::new();
        if changed.is_some() {
            for entry in fs::read_dir(&self.folder).map_err(at("reading", &self.folder))? {
                let entry = entry.map_err(at("reading", &self.folder))?;
                let Some((key, digest)) = entry.file_name().to_str().and_then(Key::of_name) else { continue };
                let length = match entry.metadata() {
                    Ok(meta) => meta.len(),
                    // It went in between.
                    Err(error) if error.kind() == ErrorKind::NotFound => continue,
                    Err(error) => return Err(at("reading", &entry.path())(error)),
                };
                // Two releases of this server may make the same way of other bytes: everybody takes the same one.
                let kept = there.entry(key).or_insert(Encoded { digest, length });
                if digest < kept.digest {
                    *kept = Encoded { digest, length };
                }
            }
        }
        let mut shelf = self.shelf();
        let gone: Vec<Key> = shelf
            .kept
            .iter()
            .filter(|(key, kept)| there.get(*key) != Some(&kept.encoded))
            .map(|(key, _)| *key)
            .collect();
        for key in gone {
            shelf.forget(key);
        }
        for (key, encoded) in there {
            if !shelf.kept.contains_key(&key) {
                shelf.keep(key, encoded);
            }
        }
        shelf.seen = Some(Seen { changed, at: now });
        Ok(())
    }
}

/// Whether a file of so many bytes has shorter ways at all.
pub const fn is_worth_asking(length: u64) -> bool {
    ENCODED_BYTES_MIN <= length && length <= ENCODED_BYTES_MAX
}
