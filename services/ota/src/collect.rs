//! Takes away files that nothing needs any more: what was brought and never published, what was withdrawn and nobody names.
//!
//! Called by the service whenever its planner says what is named. Invariant: a file stays that the newest release lists, that a named bundle
//! consists of, or that was not unnamed all through [`Room::unnamed_ms`] of serving time; nothing is published while files are taken
//! away. There is no record of files beside the files: a cut leaves some of them, and the next pass goes on.

use crate::content::{self, Content, Room};
use crate::disk::write_whole;
use crate::repository::{Error, Repository};
use crate::threads::blocking;
use midshift_bundle::digest::Digest;
use midshift_core::ids::BundleId;
use midshift_core::time::Utc;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Since when nothing names a file, milliseconds of serving time by its digest: beside the folder of files.
const UNNAMED: &str = "unnamed.json";

/// The bundles that rows name, and when that was so.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NamedBundles {
    /// Bundles that rows name.
    pub bundles: BTreeSet<BundleId>,
    /// Serving time, milliseconds of the site clock.
    pub served_ms: u64,
}

/// The outcome of one pass of the collector.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CollectionOutcome {
    /// Files that were taken away, whole or not.
    pub files: u64,
    /// Their bytes.
    pub file_bytes: u64,
    /// Files that could not be taken away. They are tried again.
    pub failed: u64,
    /// Bytes of files that nothing names and whose time is not over.
    pub unnamed_bytes: u64,
}

/// The newest pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pass {
    /// UTC of the wall.
    pub at: Utc,
    /// What it came to.
    pub collected: CollectionOutcome,
}

/// What is remembered of unnamed files.
struct Marks {
    /// Serving time since which a file is unnamed, milliseconds.
    since: BTreeMap<Digest, u64>,
    /// Highest touch of a file that a pass has seen.
    touched: u64,
}

fn read(path: &Path) -> Result<BTreeMap<Digest, u64>, content::Error> {
    match fs::read(path) {
        Ok(bytes) => Ok(serde_json::from_slice(&bytes).unwrap_or_else(|error| {
            tracing::warn!(%error, "what is known of unnamed files cannot be read: they are all kept for their whole time");
            BTreeMap::new()
        })),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(BTreeMap::new()),
        Err(source) => Err(content::Error::Io { doing: "reading", path: path.to_owned(), source }),
    }
}

/// The one that takes away.
pub struct Collector {
    path: PathBuf,
    room: Room,
    marks: tokio::sync::Mutex<Marks>,
    last: Mutex<Option<Pass>>,
}

impl Collector {
    /// Reads what is remembered in `folder`. What cannot be read is forgotten: then everything unnamed has its whole time again. Blocks.
    ///
    /// # Errors
    /// The disk's.
    pub fn open(folder: &Path, room: Room) -> Result<Self, content::Error> {
        let path = folder.join(UNNAMED);
        let since = read(&path)?;
        Ok(Self { path, room, marks: Marks { since, touched: 0 }.into(), last: Mutex::default() })
    }

    fn last(&self) -> MutexGuard<'_, Option<Pass>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The newest pass; none: there was none since the start.
    pub fn newest(&self) -> Option<Pass> {
        *self.last()
    }

    /// One pass. No publication is taken meanwhile, so that none lists a file that goes.
    ///
    /// # Errors
    /// What keeps it from knowing what is named: everything stays then.
    pub async fn collect(
        &self,
        content: &dyn Content,
        repository: &Repository,
        named: &NamedBundles,
        at: Utc,
    ) -> Result<CollectionOutcome, Error> {
        let (newest, guard) = repository.still().await?;
        let mut kept = newest.map(|newest| newest.digests().clone()).unwrap_or_default();
        for bundle in &named.bundles {
            let Ok(digest) = bundle.as_str().parse() else { continue };
            kept.extend(repository.files_of(digest).await?.unwrap_or_default());
        }
        let mut marks = self.marks.lock().await;
        let path = self.path.clone();
        // Another process may have made the pass before.
        marks.since = blocking(move || read(&path)).await?;
        let mut done = CollectionOutcome::default();
        let served_ms = named.served_ms;
        let mut since = BTreeMap::new();
        let seen = marks.touched;
        for stored in content.list().await? {
            marks.touched = marks.touched.max(stored.touched);
            if kept.contains(&stored.digest) {
                continue;
            }
            // Whoever brings it is still there, or the serving time is that of an older copy of the rows: its time begins anew.
            let known = marks.since.get(&stored.digest).filter(|since| stored.touched <= seen && **since <= served_ms);
            let begun = known.copied().unwrap_or(served_ms);
            if served_ms - begun >= self.room.unnamed_ms {
                match content.remove(stored.digest).await {
                    Ok(bytes) if bytes == stored.bytes => {
                        done.files += 1;
                        done.file_bytes += bytes;
                        continue;
                    }
                    // Somebody brings it at this moment.
                    Ok(_) => {}
                    Err(error) => {
                        tracing::error!(%error, digest = %stored.digest, "a file that nobody needs could not be taken away");
                        done.failed += 1;
                    }
                }
            }
            done.unnamed_bytes += stored.bytes;
            since.insert(stored.digest, begun);
        }
        drop(guard);
        // Only after the files: a mark too many is dropped by the next pass, a mark too few keeps a file longer.
        if marks.since != since {
            let (path, text) = (self.path.clone(), serde_json::to_vec(&since));
            let text = text.unwrap_or_else(|e| unreachable!("plain fields: {e}"));
            blocking(move || write_whole(&path, &text)).await?;
            marks.since = since;
        }
        *self.last() = Some(Pass { at, collected: done });
        Ok(done)
    }
}

impl CollectionOutcome {
    /// Says it to whoever watches the server.
    pub fn report_pass(&self, at: Utc) {
        metrics::counter!("midshift_ota_collected_total", "what" => "file").increment(self.files);
        metrics::counter!("midshift_ota_collected_bytes_total", "what" => "file").increment(self.file_bytes);
        metrics::gauge!("midshift_ota_unnamed_bytes").set(self.unnamed_bytes as f64);
        metrics::gauge!("midshift_ota_collect_time_seconds").set((at.0 / 1_000) as f64);
        let Self { files, file_bytes, failed, unnamed_bytes } = *self;
        if files + failed > 0 {
            tracing::info!(files, file_bytes, failed, unnamed_bytes, "software that nobody needs was taken away");
        } else {
            tracing::debug!(unnamed_bytes, "there was no software that nobody needs");
        }
    }
}

#[cfg(test)]
mod tests;
