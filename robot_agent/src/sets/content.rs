//! One file on its way: its bytes beside a bitmap of those that are durable.
//!
//! Invariant: a chunk is marked only after its bytes were synced, so a mark that survived a power cut tells the truth.

use super::{CHUNK_BYTES, CHUNKS_UNSYNCED_MAX, Error, FileRef};
use midshift_bundle::digest::Digest;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Chunks of a file of `length` bytes.
fn chunks(length: u64) -> u64 {
    length.div_ceil(CHUNK_BYTES)
}

/// Which chunks are there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Bitmap {
    length: u64,
    bits: Vec<u8>,
}

impl Bitmap {
    pub(super) fn new(length: u64) -> Self {
        let bytes = usize::try_from(chunks(length).div_ceil(8)).unwrap_or(usize::MAX);
        Self { length, bits: vec![0; bytes] }
    }
    fn read(path: &Path, length: u64) -> io::Result<Option<Self>> {
        match fs::read(path) {
            Ok(bits) if bits.len() == Self::new(length).bits.len() => Ok(Some(Self { length, bits })),
            // Of another length: it says nothing of this file.
            Ok(_) => Ok(None),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    }
    fn has(&self, chunk: u64) -> bool {
        let byte = usize::try_from(chunk / 8).ok().and_then(|at| self.bits.get(at));
        byte.is_some_and(|byte| byte >> (chunk % 8) & 1 == 1)
    }
    /// The chunks of a range; none if it does not begin and end with chunks.
    pub(super) fn range(&self, offset: u64, length: u64) -> Option<Range<u64>> {
        let end = offset.checked_add(length)?;
        let whole = offset.is_multiple_of(CHUNK_BYTES) && (end.is_multiple_of(CHUNK_BYTES) || end == self.length);
        (length > 0 && end <= self.length && whole).then(|| offset / CHUNK_BYTES..chunks(end))
    }
    pub(super) fn mark(&mut self, marked: Range<u64>) {
        for chunk in marked {
            if let Some(byte) = usize::try_from(chunk / 8).ok().and_then(|at| self.bits.get_mut(at)) {
                *byte |= 1 << (chunk % 8);
            }
        }
    }
    /// Ranges of bytes that are missing.
    pub(super) fn missing(&self) -> Vec<Range<u64>> {
        let mut ranges: Vec<Range<u64>> = Vec::new();
        for chunk in (0..chunks(self.length)).filter(|chunk| !self.has(*chunk)) {
            let range = chunk * CHUNK_BYTES..((chunk + 1) * CHUNK_BYTES).min(self.length);
            match ranges.last_mut() {
                Some(last) if last.end == range.start => last.end = range.end,
                _ => ranges.push(range),
            }
        }
        ranges
    }
}

/// A file on its way.
#[derive(Debug)]
pub(super) struct Part {
    wanted: FileRef,
    file: File,
    path: PathBuf,
    map: PathBuf,
    /// With what was written since the last sync.
    marks: Bitmap,
    unsynced: u64,
}

fn io_error(doing: &'static str) -> impl FnOnce(io::Error) -> Error {
    move |source| Error::Io { doing, source }
}

impl Part {
    /// Opens what is there of it, or begins.
    pub(super) fn open(folder: &Path, wanted: &FileRef) -> Result<Self, Error> {
        let path = folder.join(format!("{}.part", wanted.digest));
        let map = folder.join(format!("{}.map", wanted.digest));
        let opening = || {
            let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path)?;
            let marks = match Bitmap::read(&map, wanted.length)? {
                Some(marks) if file.metadata()?.len() == wanted.length => marks,
                _ => {
                    // What is there was begun for another length, or its marks are lost.
                    file.set_len(0)?;
                    file.set_len(wanted.length)?;
                    Bitmap::new(wanted.length)
                }
            };
            Ok((file, marks))
        };
        let (file, marks) = opening().map_err(io_error("opening a download"))?;
        Ok(Self { wanted: *wanted, file, path, map, marks, unsynced: 0 })
    }

    pub(super) fn wanted(&self) -> &FileRef {
        &self.wanted
    }

    pub(super) fn missing(&self) -> Vec<Range<u64>> {
        self.marks.missing()
    }

    pub(super) fn write(&mut self, offset: u64, bytes: &[u8]) -> Result<(), Error> {
        let range = self.marks.range(offset, bytes.len() as u64);
        let range = range
            .ok_or_else(|| io::Error::from(io::ErrorKind::InvalidInput))
            .map_err(io_error("writing a download"))?;
        let write = |file: &mut File| {
            file.seek(SeekFrom::Start(offset))?;
            file.write_all(bytes)
        };
        write(&mut self.file).map_err(io_error("writing a download"))?;
        self.unsynced += range.end - range.start;
        self.marks.mark(range);
        if self.unsynced >= CHUNKS_UNSYNCED_MAX { self.sync() } else { Ok(()) }
    }

    pub(super) fn sync(&mut self) -> Result<(), Error> {
        if self.unsynced == 0 {
            return Ok(());
        }
        self.file.sync_data().map_err(io_error("syncing a download"))?;
        midshift_durable::replace(&self.map, &self.marks.bits).map_err(io_error("marking a download"))?;
        self.unsynced = 0;
        Ok(())
    }

    /// Checks all of it by the handle it was written with, and gives it its name.
    pub(super) fn seal(mut self, to: &Path) -> Result<(), Error> {
        let whole = self.missing().is_empty() && self.is_what_it_should_be()?;
        if !whole {
            self.discard()?;
            return Err(Error::Corrupt { digest: self.wanted.digest });
        }
        let name = || {
            if self.unsynced > 0 {
                self.file.sync_data()?;
            }
            midshift_durable::rename(&self.path, to)?;
            remove(&self.map)
        };
        name().map_err(io_error("naming content"))
    }

    fn is_what_it_should_be(&mut self) -> Result<bool, Error> {
        let mut read = || {
            self.file.seek(SeekFrom::Start(0))?;
            Digest::of_reader(&mut self.file, self.wanted.length)
        };
        match read() {
            Ok((digest, length)) => Ok((digest, length) == (self.wanted.digest, self.wanted.length)),
            Err(error) if error.kind() == io::ErrorKind::InvalidData => Ok(false),
            Err(error) => Err(io_error("reading a download")(error)),
        }
    }

    /// The marks go first: bytes without marks are begun again.
    fn discard(&self) -> Result<(), Error> {
        let discard = || {
            remove(&self.map)?;
            remove(&self.path)?;
            midshift_durable::sync_folder_of(&self.path)
        };
        discard().map_err(io_error("throwing a download away"))
    }
}

/// Removes a file that may be gone already.
pub(super) fn remove(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn only(range: Range<u64>) -> Vec<Range<u64>> {
        std::iter::once(range).collect()
    }

    #[test]
    fn a_bitmap_counts_up_to_its_end_whatever_the_length() {
        for length in [1, CHUNK_BYTES - 1, CHUNK_BYTES, CHUNK_BYTES + 1, (1 << 31) - 1, 1 << 31, (1 << 32) + 7] {
            let mut marks = Bitmap::new(length);
            assert_eq!(marks.missing(), only(0..length), "{length}");
            let last = (length - 1) / CHUNK_BYTES * CHUNK_BYTES;
            let range = marks.range(last, length - last).expect("the last chunk");
            marks.mark(range);
            assert_eq!(marks.missing(), if last == 0 { vec![] } else { only(0..last) }, "{length}");
            assert_eq!(marks.range(last, length - last + 1), None, "beyond the end");
            assert_eq!(marks.range(u64::MAX - 1, 8), None);
        }
    }

    #[test]
    fn a_range_that_does_not_lie_on_chunks_is_refused() {
        let marks = Bitmap::new(3 * CHUNK_BYTES + 5);
        assert_eq!(marks.range(0, CHUNK_BYTES), Some(0..1));
        assert_eq!(marks.range(2 * CHUNK_BYTES, CHUNK_BYTES + 5), Some(2..4));
        for (offset, length) in [(1, CHUNK_BYTES), (0, 5), (0, 0), (3 * CHUNK_BYTES, 4)] {
            assert_eq!(marks.range(offset, length), None, "{offset}+{length}");
        }
    }
}
