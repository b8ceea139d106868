//! One small file that holds one value, and is whole after every end of its writer, also on a full disk.
//!
//! Two slots of fixed size, made and filled when the file is made. A write goes to the slot that does not hold the newest value and is durable when it
//! returns; whoever reads takes the whole slot with the higher generation. So no write needs a new block, a name or a second file, and a write that is cut
//! anywhere leaves the value before it. Invariant: one writer at a time, held by a lock on the file; readers beside it need none.
//! [`lock`] is for other files with one writer too. Used by the stop service and by robots for what must not be forgotten: which stops are engaged. Absent on purpose: everything else.

mod error;
mod slot;

pub use error::Error;
use serde::Serialize;
use serde::de::DeserializeOwned;
use slot::Slot;
use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Tries of a lock that somebody has, and the pause between two: a program that is being started runs within milliseconds.
const LOCK_TRIES: u32 = 100;
const LOCK_PAUSE: Duration = Duration::from_millis(10);

/// The file, open for writing.
#[derive(Debug)]
pub struct LatchFile {
    path: PathBuf,
    file: File,
    room: usize,
    generation: u64,
}

impl LatchFile {
    /// Opens the file for its one writer, with its newest value. A file that is not there is made with `first`, in slots of `room` bytes; one that is there
    /// keeps the slots it has.
    pub fn open<T: Serialize + DeserializeOwned>(path: &Path, room: usize, first: T) -> Result<(Self, T), Error> {
        let doing = "opening";
        if !path.try_exists().map_err(|e| io_error(doing, path, e))? {
            make(path, room, &first)?;
        }
        let file = OpenOptions::new().read(true).write(true).open(path).map_err(|e| io_error(doing, path, e))?;
        match lock(&file) {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(Error::Held { path: path.to_owned() }),
            Err(TryLockError::Error(source)) => return Err(io_error("locking", path, source)),
        }
        let (room, newest) = newest(&file, path)?;
        let value = understand(&newest, path)?;
        Ok((Self { path: path.to_owned(), file, room, generation: newest.generation }, value))
    }

    /// Keeps a value. Durable when this returns. After an error the file holds this value or the one before it.
    pub fn write<T: Serialize>(&mut self, value: &T) -> Result<(), Error> {
        let slot = Slot { generation: self.generation + 1, payload: json(value, &self.path)? };
        let bytes = slot.encode(self.room)?;
        let at = slot.generation % 2 * self.room as u64;
        self.file.write_all_at(&bytes, at).map_err(|e| io_error("writing", &self.path, e))?;
        self.file.sync_data().map_err(|e| io_error("syncing", &self.path, e))?;
        self.generation = slot.generation;
        Ok(())
    }

    /// Rises with every value that is kept.
    pub fn generation(&self) -> u64 {
        self.generation
    }
}

/// Locks a file for its one writer, within a second. A program that the last writer was just starting has the lock too until it runs, so one
/// that is let go may be held for a moment longer.
///
/// # Errors
/// Somebody has it, or the system says no.
#[expect(
    clippy::disallowed_methods,
    reason = "a pause of milliseconds while a file is opened, and only if somebody has it"
)]
pub fn lock(file: &File) -> Result<(), TryLockError> {
    lock_by(|| file.try_lock(), || std::thread::sleep(LOCK_PAUSE))
}

fn lock_by(mut attempt: impl FnMut() -> Result<(), TryLockError>, mut pause: impl FnMut()) -> Result<(), TryLockError> {
    for _ in 1..LOCK_TRIES {
        match attempt() {
            Err(TryLockError::WouldBlock) => pause(),
            done => return done,
        }
    }
    attempt()
}

/// The newest value and its generation, for whoever only reads. A file in which the writer is at work is read again.
pub fn read<T: DeserializeOwned>(path: &Path) -> Result<(u64, T), Error> {
    let file = File::open(path).map_err(|e| io_error("opening", path, e))?;
    // A writer touches one slot at a time, and the other one is whole.
    let (_, newest) = newest(&file, path).or_else(|_| newest(&file, path))?;
    Ok((newest.generation, understand(&newest, path)?))
}

/// Makes the file whole or not at all: under another name first, which one that was left behind gives way to.
fn make<T: Serialize>(path: &Path, room: usize, first: &T) -> Result<(), Error> {
    let mut all = Slot { generation: 0, payload: json(first, path)? }.encode(room)?;
    all.resize(2 * room, 0);
    midshift_durable::replace_with(path, &all, midshift_durable::PRIVATE).map_err(|e| io_error("making", path, e))
}

/// Size of a slot, and the newer whole one.
fn newest(file: &File, path: &Path) -> Result<(usize, Slot), Error> {
    let length = file.metadata().map_err(|e| io_error("reading", path, e))?.len();
    let unreadable = || Error::Unreadable { path: path.to_owned() };
    let room = usize::try_from(length / 2).map_err(|_| unreadable())?;
    if length % 2 != 0 || !slot::ROOMS.contains(&room) {
        return Err(unreadable());
    }
    let mut whole = Vec::new();
    for at in [0, room as u64] {
        let slot = read_slot(file, at, room).map_err(|e| io_error("reading", path, e))?;
        whole.extend(slot.filter(|slot| slot.generation % 2 * room as u64 == at));
    }
    whole.into_iter().max_by_key(|slot| slot.generation).map(|slot| (room, slot)).ok_or_else(unreadable)
}

/// The slot that begins there, if it is whole: of a slot of megabytes what is in use alone is read.
fn read_slot(file: &File, at: u64, room: usize) -> io::Result<Option<Slot>> {
    let mut head = [0; slot::HEAD];
    file.read_exact_at(&mut head, at)?;
    let Some(bytes) = slot::payload_bytes(&head, room) else { return Ok(None) };
    let mut payload = vec![0; bytes];
    file.read_exact_at(&mut payload, at + slot::HEAD as u64)?;
    Ok(Slot::decode(&head, payload))
}

fn json<T: Serialize>(value: &T, path: &Path) -> Result<Vec<u8>, Error> {
    serde_json::to_vec(value).map_err(|e| io_error("writing", path, io::Error::other(e)))
}

fn understand<T: DeserializeOwned>(slot: &Slot, path: &Path) -> Result<T, Error> {
    serde_json::from_slice(&slot.payload).map_err(|source| Error::Foreign { path: path.to_owned(), source })
}

fn io_error(doing: &'static str, path: &Path, source: io::Error) -> Error {
    Error::Io { doing, path: path.to_owned(), source }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::fs;

    const ROOM: usize = 4096;

    fn made(folder: &Path) -> (PathBuf, LatchFile) {
        let path = folder.join("latch");
        let (file, first) = LatchFile::open(&path, ROOM, "first".to_owned()).unwrap();
        assert_eq!(first, "first");
        (path, file)
    }

    fn newest(path: &Path) -> Result<String, Error> {
        read(path).map(|(_, value)| value)
    }

    #[test]
    fn what_was_kept_last_is_there_again() {
        let folder = tempfile::tempdir().unwrap();
        let (path, mut file) = made(folder.path());
        for n in 0..5 {
            file.write(&format!("value {n}")).unwrap();
            assert_eq!(read::<String>(&path).unwrap(), (n + 1, format!("value {n}")));
        }
        drop(file);
        let (file, value) = LatchFile::open(&path, 2 * ROOM, String::new()).unwrap();
        assert_eq!((value.as_str(), file.generation()), ("value 4", 5));
        assert_eq!(fs::metadata(&path).unwrap().len(), 2 * ROOM as u64, "it keeps the slots it has");
    }

    #[test]
    fn one_process_writes_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        let (path, _file) = made(folder.path());
        assert!(matches!(LatchFile::open(&path, ROOM, String::new()), Err(Error::Held { .. })));
        assert_eq!(newest(&path).unwrap(), "first");
    }

    #[test]
    fn a_value_that_does_not_fit_is_refused_and_the_one_before_it_stays() {
        let folder = tempfile::tempdir().unwrap();
        let (path, mut file) = made(folder.path());
        assert!(matches!(file.write(&"x".repeat(ROOM)), Err(Error::TooLarge { room: ROOM, .. })));
        assert_eq!(newest(&path).unwrap(), "first");
    }

    #[test]
    fn a_file_without_a_whole_slot_is_said_to_be_unreadable() {
        let folder = tempfile::tempdir().unwrap();
        let (path, file) = made(folder.path());
        drop(file);
        for bytes in [vec![], vec![0; 2 * ROOM], vec![7; 2 * ROOM], vec![0; 3], vec![0; 64]] {
            fs::write(&path, &bytes).unwrap();
            assert!(matches!(newest(&path), Err(Error::Unreadable { .. })), "{} bytes", bytes.len());
            assert!(LatchFile::open(&path, ROOM, String::new()).is_err(), "nor is it made anew");
        }
    }

    #[test]
    fn a_slot_that_says_it_is_longer_than_a_slot_leaves_the_value_before_it() {
        let folder = tempfile::tempdir().unwrap();
        let (path, mut file) = made(folder.path());
        file.write(&"second").unwrap();
        drop(file);
        for length in [(ROOM - slot::HEAD + 1) as u64, u64::MAX] {
            let file = OpenOptions::new().write(true).open(&path).unwrap();
            file.write_all_at(&length.to_le_bytes(), ROOM as u64 + 16).unwrap();
            assert_eq!(newest(&path).unwrap(), "first", "{length}");
        }
    }

    #[test]
    fn what_was_left_behind_while_it_was_made_gives_way() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("latch.new"), "half").unwrap();
        let (path, _file) = made(folder.path());
        assert_eq!(newest(&path).unwrap(), "first");
        assert!(!folder.path().join("latch.new").exists());
    }

    #[test]
    fn a_lock_that_a_program_being_started_still_has_is_waited_for_and_one_that_stays_is_not_for_long() {
        let locked = |free_after: u32| {
            let (mut attempts, mut pauses) = (0, 0);
            let attempt = || {
                attempts += 1;
                if attempts > free_after { Ok(()) } else { Err(TryLockError::WouldBlock) }
            };
            (lock_by(attempt, || pauses += 1).is_ok(), pauses)
        };
        assert_eq!((locked(0), locked(3)), ((true, 0), (true, 3)));
        assert_eq!(locked(u32::MAX), (false, LOCK_TRIES - 1));
    }

    proptest! {
        /// A write is cut after any number of its bytes, over whatever the slot held.
        #[test]
        fn a_write_that_is_cut_anywhere_leaves_the_value_before_it(cut in 0..70_usize, writes in 0..4_u64) {
            let folder = tempfile::tempdir().unwrap();
            let (path, mut file) = made(folder.path());
            for n in 0..writes {
                file.write(&format!("value {n} {}", "y".repeat(n as usize * 100))).unwrap();
            }
            drop(file);
            let (generation, before) = read::<String>(&path).unwrap();
            let next = Slot { generation: generation + 1, payload: b"\"the next, somewhat longer value\"".to_vec() };
            let bytes = next.encode(ROOM).unwrap();
            let at = next.generation % 2 * ROOM as u64;
            OpenOptions::new().write(true).open(&path).unwrap().write_all_at(&bytes[..cut.min(bytes.len())], at).unwrap();
            let found = newest(&path).unwrap();
            prop_assert!(found == before || found == "the next, somewhat longer value", "{found}");
            // And the file goes on being written.
            let (mut file, _) = LatchFile::open(&path, ROOM, String::new()).unwrap();
            file.write(&"after").unwrap();
            prop_assert_eq!(newest(&path).unwrap(), "after");
        }
    }
}
