//! The raw limit of everything durable: appending a page to a file and waiting until the disk has it.

use anyhow::Context;
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use tokio::time::Instant;

/// What one commit writes at least.
const PAGE: [u8; 4096] = [0x5a; 4096];

/// A file of its own beside the databases.
pub struct Disk(File);

impl Disk {
    /// In `dir`, which is taken away by its maker.
    pub fn beside(dir: &Path) -> anyhow::Result<Self> {
        Ok(Self(OpenOptions::new().create(true).append(true).open(dir.join("fsync"))?))
    }
    /// Milliseconds of one append with fdatasync.
    pub fn append_ms(&mut self) -> anyhow::Result<f64> {
        let begun = Instant::now();
        self.0.write_all(&PAGE)?;
        self.0.sync_data()?;
        Ok(begun.elapsed().as_secs_f64() * 1e3)
    }
    /// The same of several in a row.
    pub fn appends_ms(&mut self, times: usize) -> anyhow::Result<Vec<f64>> {
        (0..times).map(|_| self.append_ms()).collect()
    }
}

/// A directory for one round, below `dir` or the temporary one.
pub fn place(dir: Option<&PathBuf>) -> anyhow::Result<tempfile::TempDir> {
    let made = dir.map_or_else(tempfile::tempdir, tempfile::tempdir_in);
    made.context("making a directory for the databases")
}
