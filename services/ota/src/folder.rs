//! The folder of releases as a whole: which store it belongs to, and how processes that share it keep out of each other's way.
//!
//! Invariant: in a folder of another store nothing is read or changed; a lock is the kernel's, on a file that stays, so that it ends with the
//! process that holds it, however that ends; nobody waits for one without end. Called by the service when it opens, and by whoever restores
//! a folder.

use crate::disk::{Error as Disk, at, sync_folder, write_whole};
use crate::threads::blocking;
use midshift_core::limits;
use midshift_store::StoreId;
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Mutex, OwnedMutexGuard};
use tokio::time::Instant;

/// Says which store the folder belongs to: its id as text.
const MARKER: &str = "store_id";
/// Locked as long as a process works in the folder. Holds the number of the newest such process.
const IN_USE: &str = "in-use.lock";
/// Locked by whoever changes files of releases.
pub const CONTENT: &str = "content.lock";
/// Locked by whoever changes documents, or must not have them changed.
pub const METADATA: &str = "metadata.lock";
/// Shorter ways that a server before 0.2.0 made.
const ENCODED: &str = "encoded";
/// What a new file system has by itself.
const LOST_AND_FOUND: &str = "lost+found";
/// Between two looks at a lock that another process holds.
const LOOK_AGAIN: Duration = Duration::from_millis(2);

/// Whose a folder is, and who else works in it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Owner {
    /// It goes with the process that made it: nothing says whose it is.
    Nobody,
    /// Of this store, which has one process. A folder that says nothing becomes this store's.
    Alone(StoreId),
    /// Of this store, which has several processes. A folder that says nothing becomes this store's only if it is empty, and only if the
    /// store knows no bundle: else the volume is not there.
    Shared {
        /// Which store.
        store_id: StoreId,
        /// Bundles that its rows know, see [`crate::rollouts::known_bundles`].
        known_bundles: usize,
    },
}

/// Why a folder is not opened.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The disk.
    #[error(transparent)]
    Disk(#[from] Disk),
    /// It is another store's.
    #[error(
        "{folder} belongs to store {found}, and this is store {expected}: if the database was restored, restore this folder from the same backup; if a wrong volume is mounted, mount the one of this site"
    )]
    OtherStore {
        /// The folder.
        folder: PathBuf,
        /// Whose it is.
        found: String,
        /// Whose it should be.
        expected: StoreId,
    },
    /// It does not say whose it is.
    #[error(
        "{folder} has no file {MARKER} and nobody knows whether it is the folder of store {expected}: mount the volume of this site; a new one is begun by a process with role ota, in an empty folder; one from before this file was kept is taken over by one start of `midshift serve` with all roles"
    )]
    NoMarker {
        /// The folder.
        folder: PathBuf,
        /// Whose it should be.
        expected: StoreId,
    },
    /// It is empty, and should not be.
    #[error(
        "{folder} is empty and store {expected} knows {known_bundles} bundles: its volume is not mounted; mount it, or restore it from a backup"
    )]
    Emptied {
        /// The folder.
        folder: PathBuf,
        /// Whose it should be.
        expected: StoreId,
        /// Bundles that the store knows.
        known_bundles: usize,
    },
    /// Another process works in it.
    #[error("another process works in {folder}: end it, or start both with --roles on one PostgreSQL store")]
    InUse {
        /// The folder.
        folder: PathBuf,
    },
}

/// Makes a folder say that it belongs to this store, durable. The folder is made if it is not there. Blocks.
///
/// # Errors
/// If it cannot be written.
pub fn mark(folder: &Path, store_id: &StoreId) -> Result<(), Disk> {
    fs::create_dir_all(folder).map_err(at("making", folder))?;
    write_whole(&folder.join(MARKER), format!("{store_id}\n").as_bytes())?;
    folder.parent().map_or(Ok(()), sync_folder)
}

/// Whose a folder says that it is; none: it says nothing, or is not there.
fn marked(folder: &Path) -> Result<Option<String>, Disk> {
    let path = folder.join(MARKER);
    match fs::read_to_string(&path) {
        Ok(text) => Ok(Some(text.trim().to_owned())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(at("reading", &path)(error)),
    }
}

/// Refuses a folder of another store. Whether it says whose it is. Blocks.
fn is_marked(folder: &Path, expected: &StoreId) -> Result<bool, Error> {
    match marked(folder)? {
        Some(found) if found == *expected.0 => Ok(true),
        Some(found) => Err(Error::OtherStore { folder: folder.to_owned(), found, expected: expected.clone() }),
        None => Ok(false),
    }
}

/// Refuses a folder that does not say that it is this store's. Blocks.
///
/// # Errors
/// If it is another's, says nothing or cannot be read.
pub fn must_be_of(folder: &Path, expected: &StoreId) -> Result<(), Error> {
    if is_marked(folder, expected)? {
        return Ok(());
    }
    Err(Error::NoMarker { folder: folder.to_owned(), expected: expected.clone() })
}

/// Takes away what servers once made of files and nobody reads any more: who signs a release makes its encoded targets. Blocks.
pub fn remove_encoded(folder: &Path) {
    let encoded = folder.join(ENCODED);
    match fs::remove_dir_all(&encoded) {
        Ok(()) => {
            tracing::info!(path = %encoded.display(), "shorter ways that an older server had made were taken away")
        }
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        // It takes room, and is in nobody's way.
        Err(error) => tracing::warn!(path = %encoded.display(), %error, "a folder that nobody reads any more stays"),
    }
}

fn is_empty(folder: &Path) -> Result<bool, Disk> {
    for entry in fs::read_dir(folder).map_err(at("reading", folder))? {
        let name = entry.map_err(at("reading", folder))?.file_name();
        let ours = name.to_string_lossy();
        if ours != IN_USE && ours != LOST_AND_FOUND && ours != format!("{MARKER}.new") {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Refuses a folder of another store, and makes one that says nothing this store's if it may be. Nobody else is at it. Blocks.
fn settle_owner(folder: &Path, owner: &Owner) -> Result<(), Error> {
    match owner {
        Owner::Nobody => Ok(()),
        Owner::Alone(store_id) => {
            if !is_marked(folder, store_id)? {
                mark(folder, store_id)?;
            }
            Ok(())
        }
        Owner::Shared { store_id, known_bundles } => {
            if is_marked(folder, store_id)? {
                return Ok(());
            }
            let (folder_of, expected) = (|| folder.to_owned(), store_id.clone());
            if !is_empty(folder)? {
                return Err(Error::NoMarker { folder: folder_of(), expected });
            }
            if *known_bundles > 0 {
                return Err(Error::Emptied { folder: folder_of(), expected, known_bundles: *known_bundles });
            }
            Ok(mark(folder, store_id)?)
        }
    }
}

fn lock_file(path: &Path) -> Result<File, Disk> {
    let opened = OpenOptions::new().create(true).truncate(false).read(true).write(true).open(path);
    opened.map_err(at("opening", path))
}

/// Whether the lock is ours now. Blocks no longer than the file system takes to say so.
fn try_lock(file: &File, path: &Path, how: FlockOperation) -> Result<bool, Disk> {
    match flock(file, how) {
        Ok(()) => Ok(true),
        Err(Errno::WOULDBLOCK | Errno::INTR) => Ok(false),
        Err(error) => Err(at("locking", path)(error.into())),
    }
}

/// The lock by which a process works in the folder of releases, alone or with others, until it is dropped.
pub struct FolderLock {
    file: File,
    path: PathBuf,
    is_shared: bool,
    /// Of this process among all that ever worked in the folder. No two that work in it at a time have the same.
    pub number: u64,
    /// Nobody else works in it now, so what a cut left may be mended.
    pub is_first: bool,
}

impl FolderLock {
    /// Takes the lock of the folder for this process, after making the folder if it is missing, and settles its owner.
    /// None: the owner is [`Owner::Nobody`], and there is no lock. The first process keeps others waiting until
    /// [`FolderLock::let_in`].
    ///
    /// # Errors
    /// If the folder is another store's, has no marker and may not be taken, or is in use by a process that it cannot
    /// be shared with.
    pub async fn acquire(folder: &Path, owner: &Owner) -> Result<Option<Self>, Error> {
        if *owner == Owner::Nobody {
            return Ok(None);
        }
        let (path, of) = (folder.to_owned(), owner.clone());
        let file = blocking(move || {
            fs::create_dir_all(&path).map_err(at("making", &path))?;
            lock_file(&path.join(IN_USE))
        })
        .await?;
        let is_shared = matches!(owner, Owner::Shared { .. });
        let path = folder.join(IN_USE);
        let first_or_joined = || {
            if try_lock(&file, &path, FlockOperation::NonBlockingLockExclusive)? {
                return Ok(Some(true));
            }
            let joined = is_shared && try_lock(&file, &path, FlockOperation::NonBlockingLockShared)?;
            Ok::<_, Disk>(joined.then_some(false))
        };
        let Some(is_first) = until_some(first_or_joined).await? else {
            return Err(Error::InUse { folder: folder.to_owned() });
        };
        let inside = folder.to_owned();
        blocking(move || settle_owner(&inside, &of)).await?;
        let turn = Gate::new(Some(folder.join(CONTENT))).take_turn().await?;
        let inside = path.clone();
        let number = blocking(move || {
            let _turn = turn;
            next_number(&inside)
        })
        .await?;
        Ok(Some(Self { file, path, number, is_first, is_shared }))
    }

    /// Whether there may be others.
    pub const fn is_shared(&self) -> bool {
        self.is_shared
    }

    /// Lets others in, if there may be any: what a cut left is mended.
    ///
    /// # Errors
    /// If the lock cannot be changed.
    pub async fn let_in(&self) -> Result<(), Error> {
        if !self.is_shared {
            return Ok(());
        }
        // One who came first at the moment between two locks looks for things to mend too, finds none, and lets us in.
        let shared = || Ok(try_lock(&self.file, &self.path, FlockOperation::NonBlockingLockShared)?.then_some(()));
        let folder = || self.path.parent().unwrap_or(&self.path).to_owned();
        until_some(shared).await?.ok_or_else(|| Error::InUse { folder: folder() })
    }
}

/// Draws the next number, durable before anybody has it: where several machines share the volume, one that loses its power forgets none that another
/// has drawn. Nobody else does so meanwhile. The file is the one that is locked, so it is written over in place, and is never shorter than its number.
fn next_number(path: &Path) -> Result<u64, Disk> {
    let text = fs::read_to_string(path).map_err(at("reading", path))?;
    let number = text.trim().parse::<u64>().unwrap_or(0) + 1;
    let text = format!("{number:020}\n");
    let write = || {
        let mut file = OpenOptions::new().write(true).open(path)?;
        file.write_all(text.as_bytes())?;
        file.set_len(text.len() as u64)?;
        file.sync_all()
    };
    write().map_err(at("writing", path))?;
    Ok(number)
}

/// Looks again and again, for [`limits::SOFTWARE_TURN_WAIT`] at most. None: it was all in vain.
async fn until_some<T>(mut look: impl FnMut() -> Result<Option<T>, Disk>) -> Result<Option<T>, Disk> {
    let begun = Instant::now();
    loop {
        if let Some(found) = look()? {
            return Ok(Some(found));
        }
        if begun.elapsed() >= Duration::from_millis(limits::SOFTWARE_TURN_WAIT.as_ms()) {
            return Ok(None);
        }
        tokio::time::sleep(LOOK_AGAIN).await;
    }
}

/// Lets one at a time do something: of this process, and of all that share a folder if it is of a file.
#[derive(Clone)]
pub struct Gate {
    here: Arc<Mutex<()>>,
    path: Option<PathBuf>,
}

/// That it is somebody's turn, until it is dropped.
pub struct Turn {
    _file: Option<File>,
    _here: OwnedMutexGuard<()>,
}

impl Gate {
    /// A gate; with a file, for every process that has one of the same file.
    pub fn new(path: Option<PathBuf>) -> Self {
        Self { here: Arc::default(), path }
    }

    /// Waits for a turn.
    ///
    /// # Errors
    /// If another process does not end its turn, or the lock cannot be had.
    pub async fn take_turn(&self) -> Result<Turn, Disk> {
        let here = self.here.clone().lock_owned().await;
        let Some(path) = self.path.clone() else { return Ok(Turn { _file: None, _here: here }) };
        let opened = path.clone();
        let file = blocking(move || lock_file(&opened)).await?;
        let lock = || Ok(try_lock(&file, &path, FlockOperation::NonBlockingLockExclusive)?.then_some(()));
        if until_some(lock).await?.is_none() {
            return Err(Disk::Busy { path });
        }
        Ok(Turn { _file: Some(file), _here: here })
    }
}

#[cfg(test)]
mod tests;
