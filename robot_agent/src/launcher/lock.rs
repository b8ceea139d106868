//! One launcher a robot: a lock of the operating system, held for the launcher's life.
//!
//! Invariant: a lock that another process has is an error; one that cannot be had for any other reason keeps no robot
//! from being started.

use super::orders::Orders;
use super::record::report;
use std::fs::{File, OpenOptions, TryLockError};
use std::io;

/// The lock; without a file it could not be had.
#[derive(Debug)]
pub(super) struct LauncherLock(Option<File>);

impl LauncherLock {
    /// Takes the lock of a robot: of the folder of its sets, or of a file beside the record where it has none.
    ///
    /// # Errors
    /// Another launcher of this robot runs.
    pub(super) fn acquire(orders: &Orders) -> io::Result<Self> {
        let file = match open(orders) {
            Ok(file) => file,
            Err(error) => return Ok(Self::without(&error)),
        };
        match file.try_lock() {
            Ok(()) => Ok(Self(Some(file))),
            Err(TryLockError::WouldBlock) => {
                Err(io::Error::new(io::ErrorKind::WouldBlock, "another launcher of this robot runs"))
            }
            Err(TryLockError::Error(error)) => Ok(Self::without(&error)),
        }
    }

    fn without(error: &io::Error) -> Self {
        report(&format!("no lock against a second launcher: {error}"));
        Self(None)
    }
}

impl Drop for LauncherLock {
    fn drop(&mut self) {
        // A child that is just being started may have the file open for a moment longer.
        if let Some(file) = &self.0 {
            let _ = file.unlock();
        }
    }
}

fn open(orders: &Orders) -> io::Result<File> {
    let Some(sets) = &orders.sets else {
        let path = orders.record.with_extension("lock");
        return OpenOptions::new().create(true).truncate(false).write(true).open(path);
    };
    midshift_durable::make_folder(sets)?;
    File::open(sets)
}
