//! Shorter ways to files of releases: zstd, and patches from what robots have. Made once, kept in the room that files leave.
//!
//! Invariant: what is made here can be made again, so everything here may go whenever room is needed; one is made at a time; a way is
//! kept only if it is worth it; what comes of it is judged by the robot, by the digest that people signed.

mod shared;

pub use shared::is_worth_asking;

use crate::blocking;
use crate::content::{Content, Error, Reader, Wanted};
use crate::disk::at;
use crate::folder::Gate;
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{self, Base, Encoded};
use midshift_core::limits;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::fs::{self, File};
use std::io::{self, BufWriter, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::io::AsyncReadExt;
use tokio::sync::Notify;
use tokio_util::sync::CancellationToken;

/// In the name of a file that needs no other.
const FULL: &str = "full";
/// A way is worth it from this share of the file on, percent: below it asking and making cost more than they save.
const WORTH_PERCENT: u64 = 95;

/// Which file, and from which other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Key {
    /// What comes out.
    pub target: Digest,
    /// What the robot must have; none: nothing.
    pub base: Option<Digest>,
}

/// How a file is best fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// As it is.
    Identity,
    /// Like this.
    Encoded(Key, Encoded),
    /// A shorter way is being made.
    Later,
}

/// What a sweep came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Swept {
    /// Ways that were taken away.
    pub ways: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Ways that the disk holds on to.
    pub failed: u64,
}

struct Kept {
    encoded: Encoded,
    touched: u64,
    /// Serving time of the first sweep after it was last used. None: it was not looked at since it was made or found.
    used_ms: Option<u64>,
}

#[derive(Default)]
struct Shelf {
    kept: BTreeMap<Key, Kept>,
    by_digest: BTreeMap<Digest, Key>,
    /// Tried, and not worth it or without room.
    worthless: BTreeSet<Key>,
    /// To be made, in order. The first is being made.
    queue: VecDeque<Key>,
    /// Rises with each use.
    turn: u64,
    /// Where it stood at the last sweep.
    swept: u64,
    /// What a folder that others change was like at the newest look. None: nobody looked.
    seen: Option<shared::Seen>,
}

/// Whose hand is on the folder.
enum Hand {
    /// Of one process.
    Alone,
    /// Of one of several that make ways, one at a time; it writes to a file of its own number until it is whole.
    Shared(Gate, u64),
    /// Of one that hands out what others made.
    Reading,
}

struct Inner {
    folder: PathBuf,
    hand: Hand,
    content: Arc<dyn Content>,
    shelf: Mutex<Shelf>,
    wake: Notify,
}

/// The shelf and its one maker. Cheap to clone.
#[derive(Clone)]
pub struct Encodings {
    inner: Arc<Inner>,
}

impl Shelf {
    fn is_decided(&self, key: &Key) -> bool {
        self.kept.contains_key(key) || self.worthless.contains(key)
    }
    fn touch(&mut self, key: Key) -> Option<Encoded> {
        self.turn += 1;
        let kept = self.kept.get_mut(&key)?;
        kept.touched = self.turn;
        Some(kept.encoded)
    }
    fn keep(&mut self, key: Key, encoded: Encoded) {
        self.turn += 1;
        self.kept.insert(key, Kept { encoded, touched: self.turn, used_ms: None });
        self.by_digest.insert(encoded.digest, key);
    }
    /// Whether it will be made: not if too many are.
    fn queue(&mut self, key: Key) -> bool {
        let is_queued = self.queue.contains(&key);
        let may = is_queued || self.queue.len() < limits::ENCODINGS_QUEUED_MAX;
        if may && !is_queued {
            self.queue.push_back(key);
        }
        may
    }
    fn forget(&mut self, key: Key) -> Option<Encoded> {
        let kept = self.kept.remove(&key)?;
        self.by_digest.remove(&kept.encoded.digest);
        Some(kept.encoded)
    }
    fn give_up(&mut self, key: Key) {
        if self.worthless.len() >= limits::ENCODINGS_WORTHLESS_MAX {
            self.worthless.pop_first();
        }
        self.worthless.insert(key);
    }
}

impl Key {
    fn name(&self, encoded: &Digest) -> String {
        let base = self.base.map_or(FULL.to_owned(), |base| base.to_string());
        format!("{}.{base}.{encoded}", self.target)
    }
    fn of_name(name: &str) -> Option<(Self, Digest)> {
        let mut parts = name.split('.');
        let (target, base, encoded) = (parts.next()?, parts.next()?, parts.next()?);
        let base = if base == FULL { None } else { Some(base.parse().ok()?) };
        let key = Self { target: target.parse().ok()?, base };
        parts.next().is_none().then_some((key, encoded.parse().ok()?))
    }
}

impl Encodings {
    /// Opens the folder, made if it is not there. What was made stays if there is room for it. Blocks.
    ///
    /// # Errors
    /// If it cannot be read or mended.
    pub fn open(folder: &Path, content: Arc<dyn Content>) -> Result<Self, Error> {
        fs::create_dir_all(folder).map_err(at("making", folder))?;
        let mut shelf = Shelf::default();
        for entry in fs::read_dir(folder).map_err(at("reading", folder))? {
            let entry = entry.map_err(at("reading", folder))?;
            let length = entry.metadata().map_err(at("reading", folder))?.len();
            let found = entry.file_name().to_str().and_then(Key::of_name);
            match found.filter(|_| content.claim(length).is_ok()) {
                Some((key, digest)) => shelf.keep(key, Encoded { digest, length }),
                None => fs::remove_file(entry.path()).map_err(at("removing", &entry.path()))?,
            }
        }
        Ok(Self::new(folder, Hand::Alone, content, shelf))
    }

    fn new(folder: &Path, hand: Hand, content: Arc<dyn Content>, shelf: Shelf) -> Self {
        let inner = Inner { folder: folder.to_owned(), hand, content, shelf: Mutex::new(shelf), wake: Notify::new() };
        Self { inner: Arc::new(inner) }
    }

    /// How `target` is best fetched by a robot that has `bases`. Without an answer one is made, if not too many are asked for.
    ///
    /// # Errors
    /// The disk's.
    pub async fn way(&self, target: Wanted, bases: &[Digest]) -> Result<Way, Error> {
        if !is_worth_asking(target.length) {
            return Ok(Way::Identity);
        }
        self.follow().await?;
        let full = Key { target: target.digest, base: None };
        if matches!(self.inner.hand, Hand::Reading) {
            return Ok(self.inner.made(full, bases));
        }
        let mut best = full;
        for base in bases.iter().filter(|base| **base != target.digest) {
            if self.inner.content.length(*base).await?.is_some() {
                best = Key { base: Some(*base), ..full };
                break;
            }
        }
        let mut shelf = self.inner.shelf();
        if shelf.is_decided(&full) && shelf.is_decided(&best) {
            // The full one is of use beside a patch: without it the answer would have to be found anew.
            let full_way = shelf.touch(full).map(|encoded| (full, encoded));
            let found = shelf.touch(best).map(|encoded| (best, encoded)).or(full_way);
            return Ok(found.map_or(Way::Identity, |(key, encoded)| Way::Encoded(key, encoded)));
        }
        let is_queued = shelf.queue(best);
        drop(shelf);
        self.inner.wake.notify_one();
        Ok(if is_queued { Way::Later } else { Way::Identity })
    }

    /// What these bytes are a way to, and how many they are; none: they are not here.
    pub fn found(&self, digest: Digest) -> Option<(Key, u64)> {
        let shelf = self.inner.shelf();
        let key = *shelf.by_digest.get(&digest)?;
        shelf.kept.get(&key).map(|kept| (key, kept.encoded.length))
    }

    /// Bytes of a way, cut at its end; none: it is not here.
    ///
    /// # Errors
    /// The disk's.
    pub async fn read(&self, digest: Digest, range: Range<u64>) -> Result<Option<Reader>, Error> {
        let inner = self.inner.clone();
        let length = range.end.saturating_sub(range.start);
        let opened = blocking(move || inner.open_at(digest, range.start)).await?;
        Ok(opened.map(|file| -> Reader { Box::new(tokio::fs::File::from_std(file).take(length)) }))
    }

    /// A whole way, to be read from any place; none: it is not here.
    ///
    /// # Errors
    /// The disk's.
    pub async fn whole(&self, digest: Digest) -> Result<Option<Box<dyn Base>>, Error> {
        let inner = self.inner.clone();
        let opened = blocking(move || inner.open_at(digest, 0)).await?;
        Ok(opened.map(|file| -> Box<dyn Base> { Box::new(file) }))
    }

    /// Takes a damaged way away, so that it is made anew when it is asked for. Whether it is gone: where others make ways it stays.
    pub async fn discard(&self, digest: Digest) -> bool {
        let inner = self.inner.clone();
        blocking(move || {
            let key = inner.shelf().by_digest.get(&digest).copied();
            !matches!(inner.hand, Hand::Reading) && key.is_none_or(|key| inner.take_away(key).is_some())
        })
        .await
    }

    /// Takes ways away, the one unused longest first, until `bytes` more are free. Whether so many became free. One that the disk holds
    /// on to is passed over.
    pub async fn make_room(&self, bytes: u64) -> bool {
        let inner = self.inner.clone();
        blocking(move || inner.evict(bytes)).await
    }

    /// Bytes of all of them.
    pub fn bytes(&self) -> u64 {
        self.inner.shelf().kept.values().map(|kept| kept.encoded.length).sum()
    }

    /// Takes away ways that lead to a file that is not among `listed`, lead from a file that is not among `kept`, or that nobody
    /// has used for `unused_ms` of serving time, which in a folder that is shared nobody knows. One that the disk holds on to is counted, stays, and is tried again by the next sweep.
    pub async fn sweep(
        &self,
        listed: BTreeSet<Digest>,
        kept: BTreeSet<Digest>,
        served_ms: u64,
        unused_ms: u64,
    ) -> Swept {
        let inner = self.inner.clone();
        let unused_ms = if matches!(inner.hand, Hand::Alone) { unused_ms } else { u64::MAX };
        let is_of_use =
            move |key: &Key| listed.contains(&key.target) && key.base.is_none_or(|base| kept.contains(&base));
        blocking(move || inner.sweep(is_of_use, served_ms, unused_ms)).await
    }

    /// Makes what is asked for until shutdown.
    pub async fn run(&self, shutdown: &CancellationToken) {
        loop {
            while self.is_asked() {
                let turn = tokio::select! {
                    biased;
                    turn = self.turn() => turn,
                    () = shutdown.cancelled() => return,
                };
                match turn {
                    Ok(_turn) => drop(self.make_next().await),
                    Err(error) => tracing::debug!(%error, "another process makes shorter ways"),
                }
                if shutdown.is_cancelled() {
                    return;
                }
            }
            tokio::select! {
                () = shutdown.cancelled() => return,
                () = self.inner.wake.notified() => {}
            }
        }
    }

    /// Makes the next one. False: nothing is asked for.
    pub async fn make_next(&self) -> bool {
        let Some(key) = self.inner.shelf().queue.front().copied() else { return false };
        if let Err(error) = self.look_before_making().await {
            tracing::error!(%error, "what other processes made cannot be read");
        }
        for key in [Key { base: None, ..key }, key] {
            if let Err(error) = self.inner.clone().make(key).await {
                tracing::error!(%error, target = %key.target, "no shorter way could be made of a file");
                self.inner.shelf().give_up(key);
            }
        }
        self.inner.shelf().queue.pop_front();
        true
    }
}

impl Inner {
    fn shelf(&self) -> MutexGuard<'_, Shelf> {
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn open_at(&self, digest: Digest, offset: u64) -> Result<Option<File>, Error> {
        let key = {
            let mut shelf = self.shelf();
            let Some(key) = shelf.by_digest.get(&digest).copied() else { return Ok(None) };
            shelf.touch(key);
            key
        };
        let path = self.folder.join(key.name(&digest));
        match File::open(&path) {
            Ok(mut file) => {
                file.seek(SeekFrom::Start(offset)).map_err(at("reading", &path))?;
                Ok(Some(file))
            }
            // It went in between.
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(at("opening", &path)(error)),
        }
    }

    /// Whether so many bytes became free.
    fn evict(&self, bytes: u64) -> bool {
        let mut by_use: Vec<(u64, Key)> = self.shelf().kept.iter().map(|(key, kept)| (kept.touched, *key)).collect();
        by_use.sort_unstable();
        let mut freed = 0;
        for (_, key) in by_use {
            if freed >= bytes {
                break;
            }
            freed += self.take_away(key).unwrap_or(0);
        }
        freed >= bytes
    }

    /// Bytes that were taken away. None: the disk holds on to the file, which is known and counted as before.
    fn take_away(&self, key: Key) -> Option<u64> {
        let Some(digest) = self.shelf().kept.get(&key).map(|kept| kept.encoded.digest) else { return Some(0) };
        let path = self.folder.join(key.name(&digest));
        match fs::remove_file(&path) {
            Ok(()) => {}
            // It went in between, and its room is given back by whoever forgets it.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => {
                tracing::error!(%error, path = %path.display(), "a shorter way that nobody needs could not be taken away");
                return None;
            }
        }
        let mut shelf = self.shelf();
        let Some(encoded) = shelf.forget(key) else { return Some(0) };
        drop(shelf);
        // In a folder that is shared what lies there is counted, and not what was claimed.
        if matches!(self.hand, Hand::Alone) {
            self.content.give_back(encoded.length);
        }
        Some(encoded.length)
    }

    fn sweep(&self, is_of_use: impl Fn(&Key) -> bool, served_ms: u64, unused_ms: u64) -> Swept {
        let due: Vec<Key> = {
            let mut shelf = self.shelf();
            let (turn, now) = (shelf.swept, shelf.turn);
            shelf.swept = now;
            shelf.worthless.retain(&is_of_use);
            let overdue = |(key, kept): (&Key, &mut Kept)| {
                if kept.touched > turn || kept.used_ms.is_none_or(|used_ms| used_ms > served_ms) {
                    kept.used_ms = Some(served_ms);
                }
                let idle_ms = served_ms - kept.used_ms.unwrap_or(served_ms);
                (!is_of_use(key) || idle_ms >= unused_ms).then_some(*key)
            };
            shelf.kept.iter_mut().filter_map(overdue).collect()
        };
        let mut swept = Swept::default();
        for key in due {
            match self.take_away(key) {
                Some(bytes) => {
                    swept.ways += 1;
                    swept.bytes += bytes;
                }
                None => swept.failed += 1,
            }
        }
        swept
    }

    /// Takes room, from older ways if there is no other.
    fn claim(&self, bytes: u64) -> Result<bool, Error> {
        loop {
            let Err(error) = self.content.claim(bytes) else { return Ok(true) };
            let Some(lacking) = error.lacking() else { return Err(error) };
            if !self.evict(lacking) {
                return Ok(false);
            }
        }
    }

    /// Makes one way, if that was not done before.
    async fn make(self: Arc<Self>, key: Key) -> Result<(), Error> {
        if self.shelf().is_decided(&key) {
            return Ok(());
        }
        let Some(length) = self.content.length(key.target).await? else { return Ok(()) };
        let Some(target) = self.content.open(key.target).await? else { return Ok(()) };
        let base = match key.base {
            Some(digest) => match self.content.open(digest).await? {
                Some(base) => Some(base),
                None => return Ok(()),
            },
            None => None,
        };
        // A patch is worth it if it is shorter than zstd alone.
        let full = self.shelf().kept.get(&Key { base: None, ..key }).map(|full| full.encoded.length - 1);
        let most = full.unwrap_or(u64::MAX).min(length / 100 * WORTH_PERCENT);
        blocking(move || self.write(key, target, base, length, most)).await
    }

    fn write(
        &self,
        key: Key,
        mut target: Box<dyn Base>,
        mut base: Option<Box<dyn Base>>,
        length: u64,
        most: u64,
    ) -> Result<(), Error> {
        if !self.claim(most)? {
            self.shelf().give_up(key);
            return Ok(());
        }
        let beside = match self.hand {
            Hand::Shared(_, number) => self.folder.join(format!("{number}.new")),
            Hand::Alone | Hand::Reading => self.folder.join("next.new"),
        };
        let written = self.encode(&beside, &mut target, base.as_mut().map(|b| b as &mut dyn Base), length, most);
        let kept = written.as_ref().ok().copied().flatten().map_or(0, |encoded| encoded.length);
        let is_counted_there = !matches!(self.hand, Hand::Alone);
        self.content.give_back(if is_counted_there { most } else { most - kept });
        let Some(encoded) = written.map_err(at("writing", &beside))? else {
            self.shelf().give_up(key);
            return fs::remove_file(&beside).map_err(at("removing", &beside));
        };
        let path = self.folder.join(key.name(&encoded.digest));
        midshift_durable::rename(&beside, &path).map_err(at("naming", &path))?;
        self.shelf().keep(key, encoded);
        tracing::info!(target = %key.target, base = ?key.base, length, encoded = encoded.length, "a shorter way was made");
        Ok(())
    }

    fn encode(
        &self,
        path: &Path,
        target: &mut dyn Base,
        base: Option<&mut dyn Base>,
        length: u64,
        most: u64,
    ) -> io::Result<Option<Encoded>> {
        let mut out = BufWriter::with_capacity(limits::CHUNK_BYTES, File::create(path)?);
        let encoded = encoding::encode(base, target, length, &mut out, most)?;
        out.into_inner()?.sync_all()?;
        Ok(encoded)
    }
}

#[cfg(test)]
pub(crate) mod tests;
