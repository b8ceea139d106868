//! Keeps what must not be forgotten of stops, in a file of its own beside the ledger, or in memory.
//!
//! Invariant: what cannot be read is not taken for nothing: the robot stands until a person resumes it by a name made
//! for that, and the broken file stays beside the new one. One writer, newest value wins. Called by the shell of the
//! agent.

use async_trait::async_trait;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::stop::robot::Kept;
use midshift_core::time::Utc;
use midshift_latch::LatchFile;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Name of the file beside the ledger.
pub const STOP_FILE: &str = "stops.latch";
/// Bytes of one of the two slots of a file that is made: some 200 stops of parts of a site, or resets of months.
const ROOM: usize = 512 * 1024;

/// A write that did not succeed.
#[derive(Debug, thiserror::Error)]
#[error("keeping stops: {0}")]
pub struct Error(pub String);

/// What was there at a start.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Loaded {
    /// What is known.
    pub kept: Kept,
    /// It survives the end of the process as it is. False: it is written as soon as that can be done.
    pub is_durable: bool,
}

/// Keeps the stops of one robot.
#[async_trait]
pub trait KeepStops: Send {
    /// What was kept. If something was and cannot be read: `unreadable`.
    async fn load(&mut self, unreadable: Kept) -> Loaded;
    /// Keeps this instead of all before. Durable when it returns.
    async fn save(&mut self, kept: Kept) -> Result<(), Error>;
}

/// What a robot begins with that cannot read what it kept: it stands, and a person resumes it by this name.
pub fn unreadable(robot_id: &RobotId, wall: Utc) -> Kept {
    let named = StopId::parse(&format!("LATCH-{robot_id}-{}", wall.0));
    Kept { awaiting: named.into_iter().collect(), ..Kept::default() }
}

/// In memory, for swarms: a handle; clones share what is kept.
#[derive(Clone, Debug, Default)]
pub struct MemoryStops(Arc<Mutex<Kept>>);

impl MemoryStops {
    fn lock(&self) -> MutexGuard<'_, Kept> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// What is kept.
    pub fn kept(&self) -> Kept {
        self.lock().clone()
    }
}

#[async_trait]
impl KeepStops for MemoryStops {
    async fn load(&mut self, _unreadable: Kept) -> Loaded {
        Loaded { kept: self.kept(), is_durable: true }
    }
    async fn save(&mut self, kept: Kept) -> Result<(), Error> {
        *self.lock() = kept;
        Ok(())
    }
}

/// In a file.
#[derive(Debug)]
pub struct FileStops(Arc<Mutex<OnDisk>>);

#[derive(Debug)]
struct OnDisk {
    path: PathBuf,
    file: Option<LatchFile>,
}

impl FileStops {
    /// In the file at `path`, which is made at the first load.
    pub fn new(path: &Path) -> Self {
        Self(Arc::new(Mutex::new(OnDisk { path: path.to_owned(), file: None })))
    }

    /// Uses the disk where waiting for it holds nobody up.
    async fn on_disk<T: Send + 'static>(&self, verb: impl FnOnce(&mut OnDisk) -> T + Send + 'static) -> T {
        let disk = self.0.clone();
        let used = tokio::task::spawn_blocking(move || verb(&mut disk.lock().unwrap_or_else(PoisonError::into_inner)));
        used.await.unwrap_or_else(|error| std::panic::resume_unwind(error.into_panic()))
    }
}

#[async_trait]
impl KeepStops for FileStops {
    async fn load(&mut self, unreadable: Kept) -> Loaded {
        self.on_disk(move |disk| disk.load(unreadable)).await
    }
    async fn save(&mut self, kept: Kept) -> Result<(), Error> {
        self.on_disk(move |disk| disk.save(&kept)).await
    }
}

impl OnDisk {
    fn load(&mut self, unreadable: Kept) -> Loaded {
        match self.open(&Kept::default()) {
            Ok(kept) => Loaded { kept, is_durable: true },
            Err(error) => {
                tracing::error!(path = %self.path.display(), %error, "stops cannot be read: the robot stands until a person resumes it");
                let is_broken =
                    matches!(error, midshift_latch::Error::Unreadable { .. } | midshift_latch::Error::Foreign { .. });
                let is_durable = is_broken && self.replace(&unreadable).is_ok_and(|()| self.open(&unreadable).is_ok());
                Loaded { kept: unreadable, is_durable }
            }
        }
    }

    fn open(&mut self, first: &Kept) -> Result<Kept, midshift_latch::Error> {
        let (file, kept) = LatchFile::open(&self.path, ROOM, first.clone())?;
        self.file = Some(file);
        Ok(kept)
    }

    /// Puts a new file with `first` in place of a broken one, which is copied beside. A power cut leaves the broken one
    /// or the new one.
    fn replace(&self, first: &Kept) -> Result<(), Error> {
        let failed = |error: &dyn std::fmt::Display| Error(error.to_string());
        let beside = |ending: &str| self.path.with_extension(format!("latch.{ending}"));
        let (broken, new) = (beside("broken"), beside("new"));
        let copied = std::fs::copy(&self.path, &broken).and_then(|_| midshift_durable::sync_file(&broken));
        copied.map_err(|e| failed(&e))?;
        if let Err(error) = std::fs::remove_file(&new)
            && error.kind() != std::io::ErrorKind::NotFound
        {
            return Err(failed(&error));
        }
        LatchFile::open(&new, ROOM, first.clone()).map_err(|e| failed(&e))?;
        midshift_durable::rename(&new, &self.path).map_err(|e| failed(&e))
    }

    fn save(&mut self, kept: &Kept) -> Result<(), Error> {
        if self.file.is_none() {
            // It could not be opened at the start; what lies there counts for nothing beside what is known since.
            self.open(kept).map_err(|e| Error(e.to_string()))?;
        }
        let Some(file) = &mut self.file else { return Err(Error("the file is not open".to_owned())) };
        match file.write(kept) {
            // What was reset needs no room: told once more, it is effective until its reset is told once more.
            Err(midshift_latch::Error::TooLarge { .. }) => file.write(&effective(kept)),
            done => done,
        }
        .map_err(|e| Error(e.to_string()))
    }
}

/// Without what was reset.
fn effective(kept: &Kept) -> Kept {
    let mut latch = midshift_core::stop::Latch::default();
    kept.latch.effective().cloned().for_each(|stop| {
        latch.engage(stop);
    });
    Kept { latch, ..kept.clone() }
}
