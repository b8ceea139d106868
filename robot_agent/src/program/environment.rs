//! Failures that no software of a robot is to blame for: a lock that is taken, a disk that is full or refuses, a device
//! that is missing.
//!
//! Called by binaries that run one agent: they end with [`crate::launcher::ENVIRONMENT`] then, which is no try of the
//! set that they are of.

use crate::launcher::start_policy;
use rustix::io::Errno;
use std::error::Error;
use std::io;

/// Primary result codes of SQLite: BUSY, LOCKED, NOMEM, READONLY, IOERR, FULL, CANTOPEN.
const SQLITE: [i32; 7] = [5, 6, 7, 8, 10, 13, 14];

/// Whether an error, or one that it comes from, is the environment's.
pub fn is_to_blame(error: &(dyn Error + 'static)) -> bool {
    let is_own = error.downcast_ref().is_some_and(is_of_system) || error.downcast_ref().is_some_and(is_of_database);
    is_own || error.source().is_some_and(is_to_blame)
}

fn is_of_system(error: &io::Error) -> bool {
    let errno = Errno::from_io_error(error);
    let devices = [Errno::IO, Errno::NXIO, Errno::NODEV, Errno::MFILE, Errno::NFILE];
    start_policy::is_of_environment(error) || errno.is_some_and(|errno| devices.contains(&errno))
}

fn is_of_database(error: &sqlx::Error) -> bool {
    let code = error.as_database_error().and_then(|error| error.code()).and_then(|code| code.parse::<i32>().ok());
    // Extended codes have the primary one in their lowest byte.
    code.is_some_and(|code| SQLITE.contains(&(code & 0xff)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::sqlite::SqliteStore;
    use crate::{session, store};

    #[tokio::test]
    async fn a_data_folder_that_another_agent_uses_is_the_environments_and_a_damaged_file_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("agent.db");
        let _first = SqliteStore::open(&path).await.expect("opens");
        let second = SqliteStore::open(&path).await.expect_err("is taken");
        assert!(is_to_blame(&second), "{second}");
        assert!(is_to_blame(&session::Error::from(second)), "also as the agent's own");
        let damaged = folder.path().join("damaged.db");
        std::fs::write(&damaged, "no database at all, and long enough to be looked at ".repeat(100)).expect("writes");
        let damaged = SqliteStore::open(&damaged).await.expect_err("is refused");
        assert!(!is_to_blame(&damaged), "{damaged}");
    }

    #[test]
    fn full_disks_and_missing_devices_are_the_environments() {
        for errno in [Errno::NOSPC, Errno::DQUOT, Errno::ROFS, Errno::IO, Errno::NXIO, Errno::NODEV] {
            let source = io::Error::from_raw_os_error(errno.raw_os_error());
            let error = store::Error::Io { doing: "opening".to_owned(), source };
            assert!(is_to_blame(&error), "{error}");
        }
        for kind in [io::ErrorKind::NotFound, io::ErrorKind::PermissionDenied, io::ErrorKind::InvalidData] {
            assert!(!is_to_blame(&io::Error::from(kind)), "{kind}");
        }
    }
}
