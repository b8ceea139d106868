//! Does the jobs of the updater: asks the repository, fetches bytes, makes and checks sets, writes the switch record.
//!
//! Invariant: it decides nothing. Bytes are believed only after the whole file was checked; what fails for a reason
//! that may pass is [`Failure::Later`]. Called by the shell, one job at a time.

use super::jobs::{Done, Failure, Job};
use super::migration;
use crate::sets::{self, CHUNK_BYTES, FileRef, Sets};
use async_trait::async_trait;
use midshift_bundle::digest::Digest;
use midshift_bundle::encoding::{ENCODED_BYTES_MAX, ENCODED_BYTES_MIN};
use midshift_bundle::key_set::{self, KeySet};
use midshift_bundle::manifest::{MANIFEST_BYTES_MAX, Manifest};
use midshift_bundle::set::SetManifest;
use midshift_bundle::trust::{self, Listed, Reading, Refreshed, Source, Trusted};
use midshift_core::reason::{Code, Reason};
use std::collections::BTreeMap;
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
    /// A range of content, or of an encoding of it. `NotFound`: there is none.
    async fn range(&self, digest: &Digest, range: Range<u64>) -> io::Result<Pieces>;
    /// How content is best fetched by a robot that has `bases`. A repository without encodings says: as it is.
    async fn plan_download(&self, _wanted: &FileRef, _bases: &[Digest]) -> io::Result<DownloadPlan> {
        Ok(DownloadPlan::AsItIs)
    }
}

/// How content is best fetched.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DownloadPlan {
    /// As it is.
    AsItIs,
    /// Something shorter that it can be made of, from `base` if that is a patch.
    Shorter {
        /// What the robot has.
        base: Option<Digest>,
        /// What is fetched.
        encoded: FileRef,
    },
}

/// Whether a file of so many bytes may come encoded; others come as they are.
pub(crate) fn may_come_encoded(length: u64) -> bool {
    (ENCODED_BYTES_MIN..=ENCODED_BYTES_MAX).contains(&length)
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

/// Why a download did not come to its end.
enum Stop {
    /// The server has no such content.
    Gone(String),
    /// Anything else.
    Failed(Failure),
}

fn ended(result: Result<(), Stop>) -> Done {
    match result {
        Ok(()) => Done::Ok,
        Err(Stop::Gone(why)) => later(why),
        Err(Stop::Failed(failure)) => Done::Failed(failure),
    }
}

fn unreached(why: impl fmt::Display) -> Stop {
    Stop::Failed(Failure::Later(why.to_string()))
}

fn stopped(error: sets::Error) -> Stop {
    Stop::Failed(of_disk(&error))
}

fn of_disk(error: &sets::Error) -> Failure {
    match error {
        sets::Error::Io { .. } if error.is_full() => Failure::Refused(Reason::new(Code::NoRoom, error.to_string())),
        _ => Failure::Later(error.to_string()),
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
            Job::Refresh { trusted, clock, keys_after } => self.refresh(&trusted, clock, keys_after).await,
            Job::Fetch { wanted, bases, rate_bytes_s } => {
                ended(self.fetch(wanted, &bases, &mut Pace::new(rate_bytes_s), &leave).await)
            }
            Job::Manifest { wanted } => match self.fetch_whole(wanted, &mut Pace::new(0), &leave).await {
                Ok(()) => self.manifest(wanted).await,
                Err(failed) => ended(Err(failed)),
            },
            Job::Stage(set) => self.done(move |sets| sets.stage(&set)).await,
            Job::Verify(set) => self.verify(set.as_str()).await,
            Job::Check { set, file } => self.held(move |sets| sets.check(&set, &file)).await,
            Job::Mend(set) => self.mend(*set, &leave).await,
            Job::Write(mut switch) => self
                .on_disk(move |sets| sets.write_switch(&mut switch).map(|()| Done::Written(switch)))
                .await
                .unwrap_or_else(later),
            Job::Migrate { set, due } => match self.on_disk(move |sets| sets.program(&set)).await {
                Some(program) => {
                    migration::call(&program, &set.to_string(), &due).await.map_or_else(Done::Failed, |()| Done::Ok)
                }
                None => Done::Ok,
            },
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
        self.on_disk(verb).await.map_or_else(|error| Done::Failed(of_disk(&error)), |()| Done::Ok)
    }

    async fn refresh(&self, trusted: &Trusted, clock: Reading, keys_after: u64) -> Done {
        let failed = match trusted.verify_repository(Arc::new(Metadata(self.remote.clone())), clock).await {
            Ok(refreshed) => match self.key_sets(&refreshed, keys_after).await {
                Ok(key_sets) => return Done::Refreshed { refreshed: Box::new(refreshed), key_sets },
                Err(error) => {
                    let (trusted, failure) = (Box::new(refreshed.trusted), Failure::Later(error.to_string()));
                    return Done::Believed { trusted, failure };
                }
            },
            Err(failed) => failed,
        };
        let failure = match failed.error {
            error if error.is_unreachable() => Failure::Later(error.to_string()),
            error @ trust::Error::Store { .. } => Failure::Later(error.to_string()),
            error => Failure::Refused(Reason::new(Code::MetadataRefused, error.to_string())),
        };
        match failed.rooted {
            Some(trusted) => Done::Believed { trusted, failure },
            None => Done::Failed(failure),
        }
    }

    /// Listed sets of directive keys with a higher number than `after`. One that is longer than any is left out.
    async fn key_sets(&self, refreshed: &Refreshed, after: u64) -> io::Result<BTreeMap<u64, Vec<u8>>> {
        let numbered = |(name, listed): (&String, &Listed)| Some((KeySet::number_of(name)?, *listed));
        let newer = refreshed.targets.iter().filter_map(numbered).filter(|(number, _)| *number > after);
        let newer: BTreeMap<u64, Listed> =
            newer.filter(|(_, listed)| (1..=key_set::ENVELOPE_BYTES_MAX as u64).contains(&listed.length)).collect();
        let mut sets = BTreeMap::new();
        for (number, listed) in newer.into_iter().take(key_set::SETS_MAX) {
            let mut bytes = Vec::new();
            let mut pieces = self.remote.range(&listed.digest, 0..listed.length).await?;
            while let Some(piece) = pieces.next().await {
                bytes.extend(piece?);
                if bytes.len() as u64 > listed.length {
                    break;
                }
            }
            if Digest::of_content(&bytes) != listed.digest {
                return Err(io::Error::new(io::ErrorKind::InvalidData, "a set of directive keys came as other bytes"));
            }
            sets.insert(number, bytes);
        }
        Ok(sets)
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

    /// Reads what runs: other bytes than were signed are no trouble that passes.
    async fn held(&self, verb: impl FnOnce(&mut dyn Sets) -> Result<(), sets::Error> + Send + 'static) -> Done {
        match self.on_disk(verb).await {
            Ok(()) => Done::Ok,
            Err(error @ sets::Error::Io { .. }) => later(error),
            Err(error) => refused(Reason::new(Code::RunningSetBad, error.to_string())),
        }
    }

    /// Has all of a set's bytes anew that are not what was signed, and puts them in place.
    async fn mend(&self, set: SetManifest, leave: &CancellationToken) -> Done {
        for component in set.components.values() {
            let wanted = FileRef { digest: component.digest, length: component.length };
            if let Err(error) = self.on_disk(move |sets| sets.discard(&wanted)).await {
                return Done::Failed(of_disk(&error));
            }
            if let Err(failed) = self.fetch_whole(wanted, &mut Pace::new(0), leave).await {
                return ended(Err(failed));
            }
        }
        self.held(move |sets| sets.mend(&set)).await
    }

    async fn manifest(&self, wanted: FileRef) -> Done {
        match self.on_disk(move |sets| sets.read(&wanted.digest, MANIFEST_BYTES_MAX as u64)).await {
            Ok(bytes) => match Manifest::from_bytes(&bytes) {
                Ok(manifest) => Done::Manifest { manifest: Box::new(manifest), bytes },
                Err(refusal) => refused(Reason::new(Code::BundleUnfit, refusal.reason.text())),
            },
            Err(error) => later(error),
        }
    }

    /// Has a file by the shortest way that leads to it. One that was begun as it is goes on so.
    async fn fetch(
        &self,
        wanted: FileRef,
        bases: &[Digest],
        pace: &mut Pace,
        leave: &CancellationToken,
    ) -> Result<(), Stop> {
        let missing = self.on_disk(move |sets| sets.missing(&wanted)).await.map_err(stopped)?;
        let begun = missing.iter().map(|range| range.end - range.start).sum::<u64>() < wanted.length;
        let noted = self.on_disk(move |sets| sets.is_fetched_as_it_is(&wanted)).await.map_err(stopped)?;
        if may_come_encoded(wanted.length) && !begun && !noted && self.fetch_encoded(wanted, bases, pace, leave).await?
        {
            return Ok(());
        }
        self.fetch_whole(wanted, pace, leave).await
    }

    /// Whether an encoded target led to the file. One that did not is noted before anything else is tried, so that it is
    /// not tried again.
    async fn fetch_encoded(
        &self,
        wanted: FileRef,
        bases: &[Digest],
        pace: &mut Pace,
        leave: &CancellationToken,
    ) -> Result<bool, Stop> {
        let Some((base, encoded)) = self.shorter(wanted, bases).await? else { return Ok(false) };
        let failed = match self.fetch_whole(encoded, pace, leave).await {
            Ok(()) => match self.on_disk(move |sets| sets.decode(&wanted, base.as_ref(), &encoded)).await {
                Ok(()) => return Ok(true),
                Err(error) => error.to_string(),
            },
            // It was withdrawn meanwhile: the file comes as it is.
            Err(Stop::Gone(_)) => return Ok(false),
            Err(Stop::Failed(Failure::Refused(reason))) => reason.text().to_owned(),
            Err(later) => return Err(later),
        };
        tracing::warn!(digest = %wanted.digest, ?base, failed, "a shorter way does not lead to the file: it comes as it is");
        self.on_disk(move |sets| sets.fetch_as_it_is(&wanted)).await.map_err(stopped)?;
        Ok(false)
    }

    /// An encoded target that the server names and that can lead there.
    async fn shorter(&self, wanted: FileRef, bases: &[Digest]) -> Result<Option<(Option<Digest>, FileRef)>, Stop> {
        let DownloadPlan::Shorter { base, encoded } =
            self.remote.plan_download(&wanted, bases).await.map_err(unreached)?
        else {
            return Ok(None);
        };
        let is_one = encoded.length > 0 && encoded.length < wanted.length && encoded.digest != wanted.digest;
        let has_base = base.is_none_or(|base| bases.contains(&base));
        Ok((is_one && has_base).then_some((base, encoded)))
    }

    /// Fetches what is missing and checks the whole.
    async fn fetch_whole(&self, wanted: FileRef, pace: &mut Pace, leave: &CancellationToken) -> Result<(), Stop> {
        for gap in self.on_disk(move |sets| sets.missing(&wanted)).await.map_err(stopped)? {
            let mut from = gap.start;
            while from < gap.end {
                let range = from..gap.end.min(from + RANGE_BYTES);
                tokio::select! {
                    biased;
                    () = leave.cancelled() => {
                        self.synced(wanted).await?;
                        return Err(unreached("left"));
                    }
                    fetched = self.fetch_range(wanted, range.clone(), pace) => fetched?,
                }
                from = range.end;
            }
        }
        match self.on_disk(move |sets| sets.sync(&wanted).and_then(|()| sets.seal(&wanted))).await {
            Ok(()) => Ok(()),
            Err(error @ sets::Error::Corrupt { .. }) => {
                Err(Stop::Failed(Failure::Refused(Reason::new(Code::BundleCorrupt, error.to_string()))))
            }
            Err(error) => Err(stopped(error)),
        }
    }

    /// Whole chunks go to the disk as they are complete; what is left of the last is dropped if the way breaks.
    async fn fetch_range(&self, wanted: FileRef, range: Range<u64>, pace: &mut Pace) -> Result<(), Stop> {
        let mut pieces =
            self.remote.range(&wanted.digest, range.clone()).await.map_err(|error| match error.kind() {
                io::ErrorKind::NotFound => Stop::Gone(error.to_string()),
                _ => unreached(error),
            })?;
        let (mut at, mut gathered) = (range.start, Vec::new());
        let mut synced = Instant::now();
        while let Some(piece) = pieces.next().await {
            let piece = match piece {
                Ok(piece) => piece,
                Err(error) => {
                    self.synced(wanted).await?;
                    return Err(unreached(error));
                }
            };
            pace.took(piece.len() as u64).await;
            gathered.extend_from_slice(&piece);
            let end = at + gathered.len() as u64;
            if end > range.end {
                return Err(unreached("more bytes than were asked for"));
            }
            let rest = if end == range.end { 0 } else { gathered.len() % CHUNK_BYTES as usize };
            let whole = gathered.len() - rest;
            if whole > 0 {
                let bytes: Vec<u8> = gathered.drain(..whole).collect();
                let written = self.on_disk(move |sets| sets.write(&wanted, at, &bytes)).await;
                written.map_err(stopped)?;
                at += whole as u64;
            }
            if synced.elapsed() >= SYNC_EVERY {
                self.synced(wanted).await?;
                synced = Instant::now();
            }
        }
        if at == range.end { Ok(()) } else { Err(unreached("the bytes ended early")) }
    }

    async fn synced(&self, wanted: FileRef) -> Result<(), Stop> {
        self.on_disk(move |sets| sets.sync(&wanted)).await.map_err(stopped)
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
