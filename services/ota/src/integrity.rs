//! Hashes signed files before their bytes are handed out: the first time since the start, and again after a day.
//!
//! Called by `downloads`. Invariant: a file whose bytes are not what its name says is handed out by nobody; where this process keeps the folder
//! it is taken away, so that it can be pushed again.

use crate::content::{Content, Error};
use midshift_bundle::digest::{Digest, Hashing};
use midshift_core::limits;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::io::AsyncReadExt;
use tokio::time::Instant;

/// A whole file is hashed again after this.
const EVERY: Duration = Duration::from_secs(24 * 3_600);
/// A damaged one that could not be taken away is hashed again after this: somebody may have mended it.
const AGAIN: Duration = Duration::from_secs(60);
/// Files of which it is remembered when they were hashed. With more of them all are hashed again.
const FILES_MAX: usize = 4_096;

/// When a file was hashed, and what came of it.
#[derive(Clone, Copy)]
struct HashResult {
    at: Instant,
    is_whole: bool,
}

impl HashResult {
    fn now(is_whole: bool) -> Self {
        Self { at: Instant::now(), is_whole }
    }
    fn counts(&self) -> bool {
        self.at.elapsed() < if self.is_whole { EVERY } else { AGAIN }
    }
}

/// Whether a file holds the bytes that its name says; none: it is not here.
async fn is_whole(content: &dyn Content, digest: Digest) -> Result<Option<bool>, Error> {
    let Some(length) = content.length(digest).await? else { return Ok(None) };
    let Some(mut reader) = content.read(digest, 0..length).await? else { return Ok(None) };
    let (mut hashing, mut piece) = (Hashing::default(), vec![0; limits::CHUNK_BYTES]);
    loop {
        let read = reader.read(&mut piece).await;
        let path = || digest.to_string().into();
        let bytes = read.map_err(|source| Error::Io { doing: "hashing", path: path(), source })?;
        if bytes == 0 {
            return Ok(Some(hashing.digest() == digest));
        }
        hashing.update(&piece[..bytes]);
    }
}

/// One file. Who asks for it meanwhile waits until it is hashed.
type Check = Arc<tokio::sync::Mutex<Option<HashResult>>>;

/// What is known of the files of a folder.
#[derive(Default)]
pub struct Integrity {
    checks: Mutex<BTreeMap<Digest, Check>>,
    damaged: Mutex<BTreeSet<Digest>>,
}

impl Integrity {
    fn check(&self, digest: Digest) -> Check {
        let mut checks = self.checks.lock().unwrap_or_else(PoisonError::into_inner);
        if checks.len() >= FILES_MAX && !checks.contains_key(&digest) {
            checks.clear();
        }
        checks.entry(digest).or_default().clone()
    }

    fn damaged(&self) -> MutexGuard<'_, BTreeSet<Digest>> {
        self.damaged.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether a file that is here holds the bytes that its name says.
    ///
    /// # Errors
    /// The disk's.
    pub async fn holds(&self, content: &dyn Content, digest: Digest) -> Result<bool, Error> {
        let check = self.check(digest);
        let mut last = check.lock().await;
        if let Some(hashed) = last.filter(HashResult::counts) {
            return Ok(hashed.is_whole);
        }
        let Some(is_whole) = is_whole(content, digest).await? else { return Ok(false) };
        if is_whole {
            *last = Some(HashResult::now(true));
            return Ok(true);
        }
        tracing::error!(%digest, "a signed file is damaged on the disk: push its release again");
        self.damaged().insert(digest);
        // Where others keep the folder it stays, and they find it too.
        *last = content.remove(digest).await.is_err().then(|| HashResult::now(false));
        Ok(false)
    }

    /// Files that were found damaged and that nobody was told of.
    pub fn unreported(&self) -> BTreeSet<Digest> {
        self.damaged().clone()
    }

    /// Marks damaged files as reported to people.
    pub fn mark_reported(&self, files: &BTreeSet<Digest>) {
        self.damaged().retain(|digest| !files.contains(digest));
    }
}

#[cfg(test)]
mod tests;
