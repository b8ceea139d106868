//! Finds the process that runs the stop service of a folder, and kills it when it hangs.
//!
//! Invariants:
//! 1. The process is identified only by the file whose lock it holds.
//! 2. It is killed only if it runs on this machine, in this process's own PID namespace, and still holds the lock after
//!    a pidfd was opened. So a reused process number never kills another process.

use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use serde::{Deserialize, Serialize};
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Its name in the folder. In no backup: it speaks of a process of this machine.
pub const HOLDER: &str = "holder";

/// The process that has a folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Process {
    pid: i32,
    /// Numbers of processes mean something within one of these alone.
    namespace: String,
    /// The start of the machine.
    boot_id: String,
}

impl Process {
    /// This process. What it may not know of its machine is empty: a service manager may hide it.
    fn own() -> Self {
        let namespace = fs::read_link("/proc/self/ns/pid").map(|link| link.display().to_string()).unwrap_or_default();
        let boot_id = fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default().trim().to_owned();
        Self { pid: rustix::process::getpid().as_raw_nonzero().get(), namespace, boot_id }
    }
}

/// Held for as long as the folder is.
#[derive(Debug)]
pub struct Holder {
    _file: File,
}

impl Holder {
    /// Writes down that this process has the folder. Asked with the folder's latch held.
    ///
    /// # Errors
    /// The disk, or another process holds it.
    pub fn of_folder(folder: &Path) -> io::Result<Self> {
        let mut options = OpenOptions::new();
        let path = folder.join(HOLDER);
        let mut file = options.read(true).write(true).create(true).truncate(false).mode(0o600).open(path)?;
        midshift_latch::lock(&file).map_err(io::Error::from)?;
        file.set_len(0)?;
        file.write_all(&serde_json::to_vec(&Process::own())?)?;
        Ok(Self { _file: file })
    }
}

/// Why a stop service was not ended.
#[derive(Debug, thiserror::Error)]
pub enum NotEnded {
    /// No process has the folder.
    #[error("no process holds {HOLDER} in its folder")]
    Nobody,
    /// It runs where its number means nothing here.
    #[error("it runs on another machine, or in another container")]
    Elsewhere,
    /// The system says no.
    #[error("ending process {pid}: {source}")]
    Refused {
        /// Which process.
        pid: i32,
        /// Why not.
        source: io::Error,
    },
    /// The disk says no.
    #[error("reading {HOLDER}: {0}")]
    Io(#[from] io::Error),
}

/// Who holds the lock now.
fn holder(folder: &Path) -> Result<Process, NotEnded> {
    let path = folder.join(HOLDER);
    let file = match File::open(&path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(NotEnded::Nobody),
        file => file?,
    };
    match file.try_lock_shared() {
        Ok(()) => Err(NotEnded::Nobody),
        Err(TryLockError::Error(error)) => Err(error.into()),
        Err(TryLockError::WouldBlock) => {
            serde_json::from_slice(&fs::read(&path)?).map_err(|error| NotEnded::Io(error.into()))
        }
    }
}

/// Ends the process that has this folder with SIGKILL. Which one it was.
///
/// # Errors
/// Nobody has it, or it may not be ended from here.
pub fn end_holder(folder: &Path) -> Result<i32, NotEnded> {
    let found = holder(folder)?;
    let own = Process::own();
    if own.namespace.is_empty() || (&found.namespace, &found.boot_id) != (&own.namespace, &own.boot_id) {
        return Err(NotEnded::Elsewhere);
    }
    let pid = Pid::from_raw(found.pid).ok_or(NotEnded::Nobody)?;
    let refused = |error: rustix::io::Errno| NotEnded::Refused { pid: found.pid, source: error.into() };
    let handle = pidfd_open(pid, PidfdFlags::empty()).map_err(refused)?;
    if holder(folder)? != found {
        return Err(NotEnded::Nobody);
    }
    pidfd_send_signal(&handle, Signal::KILL).map_err(refused)?;
    Ok(found.pid)
}

/// Whether any process has this folder.
pub fn is_held(folder: &Path) -> bool {
    !matches!(holder(folder), Err(NotEnded::Nobody))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn told(process: &Process, folder: &Path) {
        fs::write(folder.join(HOLDER), serde_json::to_vec(process).unwrap()).unwrap();
    }

    #[test]
    fn whoever_holds_the_lock_is_known_by_what_it_wrote_and_by_nothing_that_was_left() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(holder(folder.path()), Err(NotEnded::Nobody)) && !is_held(folder.path()));
        let held = Holder::of_folder(folder.path()).unwrap();
        assert_eq!(holder(folder.path()).unwrap(), Process::own());
        drop(held);
        assert!(folder.path().join(HOLDER).exists(), "the file stays");
        assert!(matches!(end_holder(folder.path()), Err(NotEnded::Nobody)), "its lock is gone, and it ends nobody");
    }

    #[test]
    fn a_process_of_another_machine_or_container_is_not_ended() {
        let folder = tempfile::tempdir().unwrap();
        let _held = Holder::of_folder(folder.path()).unwrap();
        let own = Process::own();
        for elsewhere in [
            Process { namespace: "pid:[1]".to_owned(), ..own.clone() },
            Process { boot_id: "another".to_owned(), ..own.clone() },
        ] {
            told(&elsewhere, folder.path());
            assert!(matches!(end_holder(folder.path()), Err(NotEnded::Elsewhere)), "{elsewhere:?}");
        }
        told(&Process { pid: 0, ..own }, folder.path());
        assert!(matches!(end_holder(folder.path()), Err(NotEnded::Nobody)));
    }
}
