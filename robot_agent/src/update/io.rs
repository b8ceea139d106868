//! Does the jobs of the updater: asks the repository, fetches bytes, makes and checks sets, writes the switch record.
//!
//! Invariant: it decides nothing. Bytes are believed only after the whole file was checked; what fails for a reason that may pass is
//! [`Failure::Later`]. Called by the shell, one job at a time.

use super::{Done, Failure, Job};
use crate::sets::{self, CHUNK_BYTES, Sets, Wanted};
use async_trait::async_trait;
use midshift_bundle::digest::Digest;
use midshift_bundle::manifest::{MANIFEST_BYTES_MAX, Manifest};
use midshift_bundle::trust::{self, Reading, Source, Trusted};
use midshift_core::reason::{Code, Reason};
use std::fmt;
use std::io;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::time::Instant;
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;

/// Bytes asked for at a time.
pub const RANGE_BYTES: u64 = 4 * 1024 * 1024;
/// What came is made durable this often, if it does not become so by its amount.
const SYNC_EVERY: Duration = Duration::from_secs(2);

/// Bytes of one range, in order, in pieces of any length.
pub type Pieces = std::pin::Pin<Box<dyn tokio_stream::Stream<Item = io::Result<Vec<u8>>> + Send>>;

/// Where metadata and bytes come from.
#[async_trait]
pub trait Remote: fmt::Debug + Send + Sync {
    /// The metadata document of this name; none: there is none.
    async fn metadata(&self, name: &str) -> io::Result<Option<Vec<u8>>>;
    /// A range of content.
    async fn range(&self, digest: &Digest, range: Range<u64>) -> io::Result<Pieces>;
}

/// Does jobs.
#[async_trait]
pub trait Worker: Send {
    /// Does one job. When `leave` is cancelled a download ends soon; what came is kept.
    async fn work(&mut self, job: Job, leave: CancellationToken) -> Done;
}

/// Sets on this machine and a repository elsewhere.
pub struct UpdateWorker {
    sets: Arc<Mutex<Box<dyn Sets>>>,
    remote: Arc<dyn Remote>,
}

/// Metadata of a [`Remote`] as `trust` asks for it.
#[derive(Debug)]
struct Metadata(Arc<dyn Remote>);

#[async_trait]
impl Source for Metadata {
    async fn fetch(&self, name: &str) -> io::Result<Option<Vec<u8>>> {
        self.0.metadata(name).await
    }
}

fn later(error: impl fmt::Display) -> Done {
    Done::Failed(Failure::Later(error.to_string()))
}

fn refused(reason: impl Into<Reason>) -> Done {
    Done::Failed(Failure::Refused(reason.into()))
}

fn disk(error: &sets::Error) -> Done {
    match error {
        sets::Error::Io { .. } if error.is_full() => refused(Reason::new(Code::NoRoom, error.to_string())),
        _ => later(error),
    }
}

#[async_trait]
impl Worker for UpdateWorker {
    async fn work(&mut self, job: Job, leave: CancellationToken) -> Done {
        match job {
            Job::Look => match self.on_disk(|sets| sets.holdings()).await {
                Ok(holdings) => Done::Holdings(Box::new(holdings)),
                Err(error) => later(error),
            },
            Job::Refresh { trusted, clock } => self.refresh(&trusted, clock).await,
            Job::Fetch { wanted, rate_bytes_s } => self.fetch(wanted, rate_bytes_s, &leave).await,
            Job::Manifest { wanted } => match self.fetch(wanted, 0, &leave).await {
                Done::Ok => self.manifest(wanted).await,
                failed => failed,
            },
            Job::Stage(set) => self.done(move |sets| sets.stage(&set)).await,
            Job::Verify(set) => self.verify(set.as_str()).await,
            Job::Write(mut switch) => self
                .on_disk(move |sets| sets.write_switch(&mut switch).map(|()| Done::Written(switch)))
                .await
                .unwrap_or_else(later),
            Job::Collect(keep) => self.done(move |sets| sets.collect(&keep)).await,
        }
    }
}

impl UpdateWorker {
    /// Over these sets and this repository.
    pub fn new(sets: Box<dyn Sets>, remote: Arc<dyn Remote>) -> Self {
        Self { sets: Arc::new(Mutex::new(sets)), remote }
    }

    /// Uses the disk where waiting for it holds nobody up.
    async fn on_disk<T: Send + 'static>(&self, verb: impl FnOnce(&mut dyn Sets) -> T + Send + 'static) -> T {
        let sets = self.sets.clone();
        let used =
            tokio::task::spawn_blocking(move || verb(&mut **sets.lock().unwrap_or_else(PoisonError::into_inner)));
        used.await.unwrap_or_else(|error| std::panic::resume_unwind(error.into_panic()))
    }

    async fn done(&self, verb: impl FnOnce(&mut dyn Sets) -> Result<(), sets::Error> + Send + 'static) -> Done {
        self.on_disk(verb).await.map_or_else(|error| disk(&error), |()| Done::Ok)
    }

    async fn refresh(&self, trusted: &Trusted, clock: Reading) -> Done {
        match trusted.refresh(Arc::new(Metadata(self.remote.clone())), clock).await {
            Ok(refreshed) => Done::Refreshed(Box::new(refreshed)),
            Err(error) if error.is_unreachable() => later(error),
            Err(error @ trust::Error::Store { .. }) => later(error),
            Err(error) => refused(Reason::new(Code::MetadataRefused, error.to_string())),
        }
    }

    async fn verify(&self, set: &str) -> Done {
        // What the robot came with is no set: the launcher has its program.
        let Ok(id) = set.parse::<Digest>() else { return Done::Ok };
        match self.on_disk(move |sets| sets.verify(&id)).await {
            Ok(()) => Done::Ok,
            Err(error @ sets::Error::Io { .. }) => later(error),
            Err(error) => refused(Reason::new(Code::KeptSetBad, error.to_string())),
        }
    }

    async fn manifest(&self, wanted: Wanted) -> Done {
        match self.on_disk(move |sets| sets.read(&wanted.digest, MANIFEST_BYTES_MAX as u64)).await {
            Ok(bytes) => match Manifest::from_bytes(&bytes) {
                Ok(manifest) => Done::Manifest(Box::new(manifest)),
                Err(refusal) => refused(Reason::new(Code::BundleUnfit, refusal.reason.text())),
            },
            Err(error) => later(error),
        }
    }

    /// Fetches what is missing and checks the whole.
    async fn fetch(&self, wanted: Wanted, rate_bytes_s: u32, leave: &CancellationToken) -> Done {
        let missing = match self.on_disk(move |sets| sets.missing(&wanted)).await {
            Ok(missing) => missing,
            Err(error) => return disk(&error),
        };
        let mut pace = Pace::new(rate_bytes_s);
        for gap in missing {
            let mut from = gap.start;
            while from < gap.end {
                let range = from..gap.end.min(from + RANGE_BYTES);
                tokio::select! {
                    biased;
                    () = leave.cancelled() => {
                        let kept = self.on_disk(move |sets| sets.sync(&wanted)).await;
                        return kept.map_or_else(|error| disk(&error), |()| later("left"));
                    }
                    ended = self.fetch_range(wanted, range.clone(), &mut pace) => if let Err(done) = ended {
                        return done;
                    },
                }
                from = range.end;
            }
        }
        match self.on_disk(move |sets| sets.sync(&wanted).and_then(|()| sets.seal(&wanted))).await {
            Ok(()) => Done::Ok,
            Err(error @ sets::Error::Corrupt { .. }) => refused(Reason::new(Code::BundleCorrupt, error.to_string())),
            Err(error) => disk(&error),
        }
    }

    /// Whole chunks go to the disk as they are complete; what is left of the last is dropped if the way breaks.
    async fn fetch_range(&self, wanted: Wanted, range: Range<u64>, pace: &mut Pace) -> Result<(), Done> {
        let mut pieces = self.remote.range(&wanted.digest, range.clone()).await.map_err(later)?;
        let (mut at, mut gathered) = (range.start, Vec::new());
        let mut synced = Instant::now();
        while let Some(piece) = pieces.next().await {
            let piece = match piece {
                Ok(piece) => piece,
                Err(error) => {
                    self.synced(wanted).await?;
                    return Err(later(error));
                }
            };
            pace.took(piece.len() as u64).await;
            gathered.extend_from_slice(&piece);
            let end = at + gathered.len() as u64;
            if end > range.end {
                return Err(later("more bytes than were asked for"));
            }
            let rest = if end == range.end { 0 } else { gathered.len() % CHUNK_BYTES as usize };
            let whole = gathered.len() - rest;
            if whole > 0 {
                let bytes: Vec<u8> = gathered.drain(..whole).collect();
                let written = self.on_disk(move |sets| sets.write(&wanted, at, &bytes)).await;
                written.map_err(|error| disk(&error))?;
                at += whole as u64;
            }
            if synced.elapsed() >= SYNC_EVERY {
                self.synced(wanted).await?;
                synced = Instant::now();
            }
        }
        if at == range.end { Ok(()) } else { Err(later("the bytes ended early")) }
    }

    async fn synced(&self, wanted: Wanted) -> Result<(), Done> {
        self.on_disk(move |sets| sets.sync(&wanted)).await.map_err(|error| disk(&error))
    }
}

/// Keeps a download to its rate.
struct Pace {
    rate_bytes_s: u32,
    begun: Instant,
    bytes: u64,
}

impl Pace {
    fn new(rate_bytes_s: u32) -> Self {
        Self { rate_bytes_s, begun: Instant::now(), bytes: 0 }
    }
    /// Waits as long as so many bytes more should have taken.
    async fn took(&mut self, bytes: u64) {
        if self.rate_bytes_s > 0 {
            self.bytes += bytes;
            let should_ms = self.bytes.saturating_mul(1_000) / u64::from(self.rate_bytes_s);
            tokio::time::sleep_until(self.begun + Duration::from_millis(should_ms)).await;
        }
    }
}
