//! Files of releases on the disk, each under its SHA-256. They come in pieces, over days and restarts if need be.
//!
//! Invariant: a file has its name only once all its bytes were checked and are durable; what is said to be durable survives a power cut;
//! no more than the quota lies here, and the disk keeps its spare bytes. Whether a file may be handed out, and when one is needed no
//! more, is not decided here.

mod shared;
mod storage;

pub use crate::disk::Error;
pub use storage::{Completeness, Content, FileRef, Fill, Reader, Room, StoredFile};

use crate::disk::{at, sync_folder};
use crate::folder::Gate;
use crate::threads::{blocking, is_of_one_thread};
use async_trait::async_trait;
use bytes::Bytes;
use midshift_bundle::digest::{Digest, Hashing};
use midshift_bundle::manifest::COMPONENT_BYTES_MAX;
use midshift_core::limits;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::io::AsyncReadExt;

/// Bytes of one read of what was there before a restart.
const READ_BYTES: usize = 256 * 1024;

/// What is known for sure of a file that is not whole, beside it as `<digest>.mark`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Mark {
    length: u64,
    durable: u64,
    /// Number of the process that wrote to the file last. None: there is one process only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    writer: Option<u64>,
}

/// A file that is being brought.
struct PartialFile {
    mark: Mark,
    written: u64,
    /// None: not opened since the start, or a write failed. Only `mark.durable` bytes count then.
    open: Option<(File, Hashing)>,
}

struct Entry {
    part: Arc<Mutex<PartialFile>>,
    touched: u64,
    changed: FileTime,
}

struct Whole {
    length: u64,
    touched: u64,
    changed: FileTime,
}

/// When a file was changed last, as its file system says: seconds and nanoseconds. Only compared with itself. Zeros if nobody asks.
type FileTime = (i64, i64);

/// How this process may use the folder.
enum FolderAccess {
    /// Of one process: what it remembers is what is there.
    Alone,
    /// Of one of several: what is there may be another's, and is looked at anew at each turn.
    Shared(Sharing),
    /// Of one that only reads what others keep.
    Reading,
}

/// What a process needs to share a folder of files.
pub struct Sharing {
    /// Its turns.
    pub gate: Gate,
    /// Its number, which no other living process has.
    pub number: u64,
    /// Nobody else works in the folder yet.
    pub is_first: bool,
}

#[derive(Default)]
struct Shelf {
    whole: BTreeMap<Digest, Whole>,
    parts: BTreeMap<Digest, Entry>,
    /// Bytes of all files, whole or not.
    used: u64,
    /// Rises with each touch of a file by whoever brings it.
    turn: u64,
}

impl Shelf {
    /// How long a whole file is, for somebody who brings it.
    fn touch(&mut self, digest: Digest) -> Option<u64> {
        let whole = self.whole.get_mut(&digest)?;
        self.turn += 1;
        whole.touched = self.turn;
        Some(whole.length)
    }
}

struct Inner {
    path: PathBuf,
    room: Room,
    hand: FolderAccess,
    shelf: Mutex<Shelf>,
}

/// Files in a folder. Cheap to clone.
#[derive(Clone)]
pub struct DiskContent {
    inner: Arc<Inner>,
}

impl DiskContent {
    /// Opens the folder, made if it is not there, and takes away what no cut should have left. Blocks.
    ///
    /// # Errors
    /// If it cannot be read or mended.
    pub fn open(path: &Path, room: Room) -> Result<Self, Error> {
        fs::create_dir_all(path).map_err(at("making", path))?;
        Self::mended(path, room, FolderAccess::Alone)
    }

    fn mended(path: &Path, room: Room, hand: FolderAccess) -> Result<Self, Error> {
        let mut shelf = Shelf::default();
        let mut names = Vec::new();
        for entry in fs::read_dir(path).map_err(at("reading", path))? {
            let entry = entry.map_err(at("reading", path))?;
            let length = entry.metadata().map_err(at("reading", path))?.len();
            names.extend(entry.file_name().into_string().ok().map(|name| (name, length)));
        }
        let marks: Vec<String> = names.iter().map(|(name, _)| name).filter(|n| n.ends_with(".mark")).cloned().collect();
        let changed = FileTime::default();
        for (name, length) in names {
            if let Ok(digest) = name.parse::<Digest>() {
                shelf.whole.insert(digest, Whole { length, touched: 0, changed });
                shelf.used += length;
            } else if let Some(digest) = name.strip_suffix(".part").and_then(|n| n.parse::<Digest>().ok())
                && let Some(mark) = read_mark(path, digest, length)
            {
                let part = PartialFile { mark, written: mark.durable, open: None };
                shelf.parts.insert(digest, Entry { part: Arc::new(Mutex::new(part)), touched: 0, changed });
                shelf.used += mark.durable;
            } else if !name.ends_with(".mark") {
                remove(&path.join(name))?;
            }
        }
        for name in marks {
            let digest = name.strip_suffix(".mark").and_then(|n| n.parse::<Digest>().ok());
            if digest.is_none_or(|digest| !shelf.parts.contains_key(&digest)) {
                remove(&path.join(name))?;
            }
        }
        let inner = Inner { path: path.to_owned(), room, hand, shelf: Mutex::new(shelf) };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// Changes the folder, in a turn if others do so too. A turn lasts to the end of the work, whoever still waits for it.
    async fn in_turn<T: Send + 'static>(
        &self,
        work: impl FnOnce(&Inner) -> Result<T, Error> + Send + 'static,
    ) -> Result<T, Error> {
        let turn = match &self.inner.hand {
            FolderAccess::Alone => None,
            FolderAccess::Shared(sharing) => Some(sharing.gate.take_turn().await?),
            FolderAccess::Reading => return Err(Error::ReadOnly { path: self.inner.path.clone() }),
        };
        let inner = self.inner.clone();
        blocking(move || {
            let _turn = turn;
            inner.refresh_shelf()?;
            work(&inner)
        })
        .await
    }

    async fn opened(&self, digest: Digest, offset: u64) -> Result<Option<File>, Error> {
        let inner = self.inner.clone();
        blocking(move || inner.open_at(digest, offset)).await
    }
}

#[async_trait]
impl Content for DiskContent {
    async fn length(&self, digest: Digest) -> Result<Option<u64>, Error> {
        if matches!(self.inner.hand, FolderAccess::Alone) {
            return Ok(self.inner.shelf().whole.get(&digest).map(|whole| whole.length));
        }
        let inner = self.inner.clone();
        blocking(move || inner.length_there(digest)).await
    }
    async fn append(&self, file: FileRef, offset: u64, piece: Bytes) -> Result<(), Error> {
        self.in_turn(move |inner| inner.append(file, offset, &piece)).await
    }
    async fn settle(&self, file: FileRef) -> Result<Completeness, Error> {
        self.in_turn(move |inner| inner.settle(file)).await
    }
    async fn read(&self, digest: Digest, range: Range<u64>) -> Result<Option<Reader>, Error> {
        let opened = self.opened(digest, range.start).await?;
        let length = range.end.saturating_sub(range.start);
        let Some(mut file) = opened else { return Ok(None) };
        if is_of_one_thread() {
            let mut bytes = Vec::new();
            let path = self.inner.whole(digest);
            Read::take(&mut file, length).read_to_end(&mut bytes).map_err(at("reading", &path))?;
            return Ok(Some(Box::new(io::Cursor::new(bytes))));
        }
        Ok(Some(Box::new(AsyncReadExt::take(tokio::fs::File::from_std(file), length))))
    }
    async fn list(&self) -> Result<Vec<StoredFile>, Error> {
        if matches!(self.inner.hand, FolderAccess::Alone) {
            return Ok(self.inner.list());
        }
        self.in_turn(|inner| Ok(inner.list())).await
    }
    async fn remove(&self, digest: Digest) -> Result<u64, Error> {
        self.in_turn(move |inner| inner.take_away(digest)).await
    }
    fn fill(&self) -> Fill {
        Fill { used_bytes: self.inner.shelf().used, quota_bytes: self.inner.room.quota_bytes }
    }
}

impl Inner {
    fn shelf(&self) -> MutexGuard<'_, Shelf> {
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }
    fn whole(&self, digest: Digest) -> PathBuf {
        self.path.join(digest.to_string())
    }
    fn part(&self, digest: Digest) -> PathBuf {
        self.path.join(format!("{digest}.part"))
    }
    fn mark(&self, digest: Digest) -> PathBuf {
        self.path.join(format!("{digest}.mark"))
    }

    /// Whether a file that this process did not know is there and is what its name says: a person put it back.
    fn take_back(&self, digest: Digest) -> Result<bool, Error> {
        let path = self.whole(digest);
        let mut file = match File::open(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
            opened => opened.map_err(at("opening", &path))?,
        };
        let Ok((found, length)) = Digest::of_reader(&mut file, COMPONENT_BYTES_MAX) else { return Ok(false) };
        if found != digest {
            return Ok(false);
        }
        file.sync_all().map_err(at("syncing", &path))?;
        sync_folder(&self.path)?;
        let mut shelf = self.shelf();
        if !shelf.parts.contains_key(&digest) && !shelf.whole.contains_key(&digest) {
            shelf.whole.insert(digest, Whole { length, touched: 0, changed: FileTime::default() });
            shelf.used += length;
        }
        Ok(shelf.whole.contains_key(&digest))
    }

    fn open_at(&self, digest: Digest, offset: u64) -> Result<Option<File>, Error> {
        // Who shares the folder asks the disk.
        let is_gone = |shelf: &Shelf| matches!(self.hand, FolderAccess::Alone) && !shelf.whole.contains_key(&digest);
        let is_unknown = is_gone(&self.shelf());
        if is_unknown && !self.take_back(digest)? {
            return Ok(None);
        }
        let path = self.whole(digest);
        let mut file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound && !matches!(self.hand, FolderAccess::Alone) => {
                return Ok(None);
            }
            // It was taken away in between.
            Err(_) if is_gone(&self.shelf()) => return Ok(None),
            Err(error) => return Err(at("opening", &path)(error)),
        };
        file.seek(SeekFrom::Start(offset)).map_err(at("reading", &path))?;
        Ok(Some(file))
    }

    fn append(&self, file: FileRef, offset: u64, piece: &[u8]) -> Result<(), Error> {
        if file.length == 0 || file.length > COMPONENT_BYTES_MAX {
            return Err(Error::Size);
        }
        loop {
            let entry = {
                let mut shelf = self.shelf();
                if let Some(length) = shelf.touch(file.digest) {
                    self.touch_there(file.digest)?;
                    return Err(Error::Moved { at: length, offset });
                }
                self.entry(&mut shelf, file)?
            };
            let mut part = entry.lock().unwrap_or_else(PoisonError::into_inner);
            if self.is_current(file.digest, &entry) {
                let added = self.add(&mut part, file, offset, piece);
                if added.is_err() && part.written == 0 {
                    // Nothing of it came: nothing is to be seen of it.
                    let mut shelf = self.shelf();
                    shelf.parts.remove(&file.digest);
                    self.forget(file.digest)?;
                }
                return added;
            }
        }
    }

    fn list(&self) -> Vec<StoredFile> {
        let shelf = self.shelf();
        let whole =
            shelf.whole.iter().map(|(digest, w)| StoredFile { digest: *digest, bytes: w.length, touched: w.touched });
        let part = |(digest, entry): (&Digest, &Entry)| {
            // One that is being written now was touched just now.
            let (bytes, touched) = entry.part.try_lock().map_or((0, shelf.turn), |p| (p.written, entry.touched));
            StoredFile { digest: *digest, bytes, touched }
        };
        let mut all: Vec<StoredFile> = whole.chain(shelf.parts.iter().map(part)).collect();
        all.sort_by_key(|stored| stored.digest);
        all
    }

    /// The shelf is held until the file is gone: so nobody brings it anew meanwhile.
    fn take_away(&self, digest: Digest) -> Result<u64, Error> {
        let mut shelf = self.shelf();
        if let Some(length) = shelf.whole.get(&digest).map(|whole| whole.length) {
            remove(&self.whole(digest))?;
            shelf.whole.remove(&digest);
            shelf.used = shelf.used.saturating_sub(length);
            return Ok(length);
        }
        let Some(entry) = shelf.parts.get(&digest) else { return Ok(0) };
        let Ok(written) = entry.part.try_lock().map(|part| part.written) else { return Ok(0) };
        self.forget(digest)?;
        shelf.parts.remove(&digest);
        shelf.used = shelf.used.saturating_sub(written);
        Ok(written)
    }

    /// The entry of a file, made if there is none. When there are too many, the one left alone longest goes.
    fn entry(&self, shelf: &mut Shelf, file: FileRef) -> Result<Arc<Mutex<PartialFile>>, Error> {
        shelf.turn += 1;
        let turn = shelf.turn;
        if let Some(entry) = shelf.parts.get_mut(&file.digest) {
            entry.touched = turn;
            return Ok(entry.part.clone());
        }
        if shelf.parts.len() >= limits::UPLOADS_MAX {
            // One that is being written now is not left alone.
            let idle = |(digest, entry): (&Digest, &Entry)| {
                entry.part.try_lock().ok().map(|part| (entry.touched, *digest, part.written))
            };
            if let Some((_, oldest, written)) = shelf.parts.iter().filter_map(idle).min() {
                shelf.parts.remove(&oldest);
                shelf.used = shelf.used.saturating_sub(written);
                self.forget(oldest)?;
            }
        }
        let mark = Mark { length: file.length, durable: 0, writer: None };
        let part = Arc::new(Mutex::new(PartialFile { mark, written: 0, open: None }));
        let entry = Entry { part: part.clone(), touched: turn, changed: FileTime::default() };
        shelf.parts.insert(file.digest, entry);
        Ok(part)
    }

    fn is_current(&self, digest: Digest, entry: &Arc<Mutex<PartialFile>>) -> bool {
        self.shelf().parts.get(&digest).is_some_and(|current| Arc::ptr_eq(&current.part, entry))
    }

    fn add(&self, part: &mut PartialFile, file: FileRef, offset: u64, piece: &[u8]) -> Result<(), Error> {
        if part.mark.length != file.length {
            self.reset(part, file)?;
        }
        if offset != part.written {
            return Err(Error::Moved { at: part.written, offset });
        }
        self.reopen(part, file.digest)?;
        let end = offset + piece.len() as u64;
        if end > file.length {
            return Err(Error::TooLong { length: file.length, end });
        }
        self.reserve(file.length - part.written, piece.len() as u64)?;
        let path = self.part(file.digest);
        let Some((open, hash)) = part.open.as_mut() else { return Err(Error::Moved { at: part.written, offset }) };
        let written = open.write_all(piece);
        hash.update(piece);
        part.written = end;
        if let Err(source) = written {
            self.fall_back(part);
            return Err(at("writing", &path)(source));
        }
        if part.written - part.mark.durable >= limits::UPLOAD_SYNC_BYTES {
            self.sync(part, file.digest)?;
        }
        Ok(())
    }

    /// Takes room for a piece if there is room for all that is missing.
    fn reserve(&self, missing: u64, piece: u64) -> Result<(), Error> {
        if self.room.spare_bytes > 0 {
            let (disk, spare) = (self.disk_free()?, self.room.spare_bytes);
            if disk.saturating_sub(spare) < missing {
                return Err(Error::DiskFull { missing, free: disk, spare });
            }
        }
        let mut shelf = self.shelf();
        let (used, quota) = (shelf.used, self.room.quota_bytes);
        let free = quota.saturating_sub(used);
        if missing > free {
            return Err(Error::Full { missing, used, free, quota });
        }
        shelf.used += piece;
        Ok(())
    }

    /// Bytes that the disk has left for us.
    fn disk_free(&self) -> Result<u64, Error> {
        let found = rustix::fs::statvfs(&self.path).map_err(|e| at("looking at the disk of", &self.path)(e.into()))?;
        Ok(found.f_bavail.saturating_mul(found.f_frsize))
    }

    /// Only what is durable counts from now on.
    fn fall_back(&self, part: &mut PartialFile) {
        part.open = None;
        let lost = part.written - part.mark.durable;
        part.written = part.mark.durable;
        let mut shelf = self.shelf();
        shelf.used = shelf.used.saturating_sub(lost);
    }

    fn reset(&self, part: &mut PartialFile, file: FileRef) -> Result<(), Error> {
        part.mark.durable = 0;
        self.fall_back(part);
        part.mark = Mark { length: file.length, durable: 0, writer: None };
        self.forget(file.digest)
    }

    /// Opens a part at its end and reads what is before it, once after a start and after another process wrote to it.
    fn reopen(&self, part: &mut PartialFile, digest: Digest) -> Result<(), Error> {
        if part.open.is_some() {
            return Ok(());
        }
        self.make_ours(part, digest)?;
        let path = self.part(digest);
        let open = || {
            let mut file = OpenOptions::new().create(true).truncate(false).read(true).write(true).open(&path)?;
            file.set_len(part.written)?;
            let mut hash = Hashing::default();
            let mut buffer = vec![0; READ_BYTES];
            loop {
                let count = file.read(&mut buffer)?;
                if count == 0 {
                    return Ok((file, hash));
                }
                hash.update(&buffer[..count]);
            }
        };
        part.open = Some(open().map_err(at("opening", &path))?);
        Ok(())
    }

    /// The bytes first, then the word that they are there.
    fn sync(&self, part: &mut PartialFile, digest: Digest) -> Result<(), Error> {
        let path = self.part(digest);
        let synced = match &part.open {
            Some((file, _)) => file.sync_data(),
            // Another process wrote to it last.
            None => File::open(&path).and_then(|file| file.sync_data()),
        };
        if let Err(source) = synced {
            // After a failed sync nobody knows what is on the disk.
            self.fall_back(part);
            return Err(at("syncing", &path)(source));
        }
        let mark = Mark { durable: part.written, ..part.mark };
        self.write_mark(digest, &mark)?;
        part.mark = mark;
        Ok(())
    }

    fn settle(&self, file: FileRef) -> Result<Completeness, Error> {
        loop {
            let entry = {
                let mut shelf = self.shelf();
                if let Some(length) = shelf.touch(file.digest) {
                    self.touch_there(file.digest)?;
                    return if length == file.length { Ok(Completeness::Whole) } else { Err(Error::Size) };
                }
                shelf.turn += 1;
                let turn = shelf.turn;
                shelf.parts.get_mut(&file.digest).map(|entry| {
                    entry.touched = turn;
                    entry.part.clone()
                })
            };
            let Some(entry) = entry else { return Ok(Completeness::Part(0)) };
            let mut part = entry.lock().unwrap_or_else(PoisonError::into_inner);
            if !self.is_current(file.digest, &entry) {
                continue;
            }
            if part.mark.length != file.length {
                return Ok(Completeness::Part(0));
            }
            if part.written > part.mark.durable {
                self.sync(&mut part, file.digest)?;
            }
            if part.written < file.length {
                return Ok(Completeness::Part(part.written));
            }
            return self.finish(&mut part, file.digest);
        }
    }

    /// All bytes are here and durable: gives the file its name if they are the right ones.
    fn finish(&self, part: &mut PartialFile, digest: Digest) -> Result<Completeness, Error> {
        self.reopen(part, digest)?;
        let found = part.open.as_ref().map_or_else(|| Hashing::default().digest(), |(_, hash)| hash.digest());
        if found != digest {
            let mut shelf = self.shelf();
            shelf.parts.remove(&digest);
            shelf.used = shelf.used.saturating_sub(part.written);
            self.forget(digest)?;
            return Err(Error::WrongBytes { found });
        }
        let (path, whole) = (self.part(digest), self.whole(digest));
        midshift_durable::rename(&path, &whole).map_err(at("naming", &whole))?;
        let mut shelf = self.shelf();
        shelf.turn += 1;
        let touched = shelf.turn;
        shelf.parts.remove(&digest);
        let changed = FileTime::default();
        shelf.whole.insert(digest, Whole { length: part.written, touched, changed });
        drop(shelf);
        remove(&self.mark(digest))?;
        Ok(Completeness::Whole)
    }

    /// Takes away what is here of a file that is not whole: first the word, then the bytes.
    fn forget(&self, digest: Digest) -> Result<(), Error> {
        remove(&self.mark(digest))?;
        remove(&self.part(digest))
    }
}

/// What is known of a part that has `length` bytes; none: nothing that counts.
fn read_mark(folder: &Path, digest: Digest, length: u64) -> Option<Mark> {
    let bytes = fs::read(folder.join(format!("{digest}.mark"))).ok()?;
    let mark: Mark = serde_json::from_slice(&bytes).ok()?;
    (mark.durable <= length && mark.durable <= mark.length).then_some(mark)
}

fn remove(path: &Path) -> Result<(), Error> {
    match fs::remove_file(path) {
        Err(source) if source.kind() != io::ErrorKind::NotFound => Err(at("removing", path)(source)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
