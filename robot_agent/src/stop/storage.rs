//! Saves the stops of a robot, in a file of its own beside the ledger, or in memory.
//!
//! Invariant: what cannot be read is not taken for nothing: the robot stands until a person resumes it by a name made
//! for that, and the broken file stays beside the new one. One writer, newest value wins. Called by the shell of the
//! agent.

use async_trait::async_trait;
use midshift_core::ids::{RobotId, StopId};
use midshift_core::stop::robot::SavedStops;
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

/// The saved stops that an agent finds at its start.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Loaded {
    /// The stops.
    pub saved: SavedStops,
    /// It survives the end of the process as it is. False: it is written as soon as that can be done.
    pub is_durable: bool,
}

/// Saves and loads the stops of one robot.
#[async_trait]
pub trait StopStorage: Send {
    /// Loads what was saved last. If that cannot be read: `unreadable`.
    async fn load(&mut self, unreadable: SavedStops) -> Loaded;
    /// Saves these stops instead of all before. They are durable when it returns.
    async fn save(&mut self, saved: SavedStops) -> Result<(), Error>;
}

/// The stops of a robot that cannot read its saved ones: it stands, and a person resumes it by this name.
pub fn unreadable(robot_id: &RobotId, wall: Utc) -> SavedStops {
    let named = StopId::parse(&format!("LATCH-{robot_id}-{}", wall.0));
    SavedStops { awaiting: named.into_iter().collect(), ..SavedStops::default() }
}

/// Saves stops in memory, for swarms: a handle whose clones share them.
#[derive(Clone, Debug, Default)]
pub struct MemoryStops(Arc<Mutex<SavedStops>>);

impl MemoryStops {
    fn lock(&self) -> MutexGuard<'_, SavedStops> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// The stops that were saved last.
    pub fn saved(&self) -> SavedStops {
        self.lock().clone()
    }
}

#[async_trait]
impl StopStorage for MemoryStops {
    async fn load(&mut self, _unreadable: SavedStops) -> Loaded {
        Loaded { saved: self.saved(), is_durable: true }
    }
    async fn save(&mut self, saved: SavedStops) -> Result<(), Error> {
        *self.lock() = saved;
        Ok(())
    }
}

/// Saves stops in a file.
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
impl StopStorage for FileStops {
    async fn load(&mut self, unreadable: SavedStops) -> Loaded {
        self.on_disk(move |disk| disk.load(unreadable)).await
    }
    async fn save(&mut self, saved: SavedStops) -> Result<(), Error> {
        self.on_disk(move |disk| disk.save(&saved)).await
    }
}

impl OnDisk {
    fn load(&mut self, unreadable: SavedStops) -> Loaded {
        match self.open(&SavedStops::default()) {
            Ok(saved) => Loaded { saved, is_durable: true },
            Err(error) => {
                tracing::error!(path = %self.path.display(), %error, "stops cannot be read: the robot stands until a person resumes it");
                let is_broken =
                    matches!(error, midshift_latch::Error::Unreadable { .. } | midshift_latch::Error::Foreign { .. });
                let is_durable = is_broken && self.replace(&unreadable).is_ok_and(|()| self.open(&unreadable).is_ok());
                Loaded { saved: unreadable, is_durable }
            }
        }
    }

    fn open(&mut self, first: &SavedStops) -> Result<SavedStops, midshift_latch::Error> {
        let (file, saved) = LatchFile::open(&self.path, ROOM, first.clone())?;
        self.file = Some(file);
        Ok(saved)
    }

    /// Puts a new file with `first` in place of a broken one, which is copied beside. A power cut leaves the broken one
    /// or the new one.
    fn replace(&self, first: &SavedStops) -> Result<(), Error> {
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

    fn save(&mut self, saved: &SavedStops) -> Result<(), Error> {
        if self.file.is_none() {
            // It could not be opened at the start; what lies there counts for nothing beside what is known since.
            self.open(saved).map_err(|e| Error(e.to_string()))?;
        }
        let Some(file) = &mut self.file else { return Err(Error("the file is not open".to_owned())) };
        match file.write(saved) {
            // What was reset needs no room: told once more, it is effective until its reset is told once more.
            Err(midshift_latch::Error::TooLarge { .. }) => file.write(&effective(saved)),
            done => done,
        }
        .map_err(|e| Error(e.to_string()))
    }
}

/// Without what was reset.
fn effective(saved: &SavedStops) -> SavedStops {
    let mut latch = midshift_core::stop::Latch::default();
    saved.latch.effective().cloned().for_each(|stop| {
        latch.engage(stop);
    });
    SavedStops { latch, ..saved.clone() }
}
