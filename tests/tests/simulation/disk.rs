//! Disks that outlive their process: they take time, and the server's may fail in every way a disk can.
//!
//! Invariant: what was acknowledged is there after a crash; what was not may be there or not.

use crate::newer::Newer;
use crate::observer::Shared;
use midshift_agent::memory::MemoryStore as RobotMemoryStore;
use midshift_agent::store::{Error as RobotError, Op, RobotMemory, Store as RobotStore};
use midshift_core::audit::Head;
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Item;
use midshift_core::rows::{Key, Log, Naming, Row, RowSelection, Seq, Writer};
use midshift_store::{
    Applied, Cause, Coarsen, CommitError, Error, FeedPage, Frame, FrameLog, FrameMark, FramesOldest, Gap, MemoryFrames,
    MemoryStore, Query, Retention, Snapshot, Store, StoreId, StoredFrame, Subjects,
};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::watch;

/// How the server's disk behaves at the moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mood {
    /// A commit takes up to this, milliseconds.
    pub slow_ms: u64,
    /// Commits whose outcome nobody learns, in thousand. Half of them are applied.
    pub unknown_permille: u32,
    /// Nothing can be read or written.
    pub gone: bool,
}

impl Mood {
    /// A healthy disk.
    pub const GOOD: Self = Self { slow_ms: 8, unknown_permille: 0, gone: false };
}

struct State {
    mood: Mood,
    rng: StdRng,
    unknown: u64,
    refused: u64,
    slow: u64,
}

/// The server's disk.
pub struct ServerDisk {
    inner: Arc<MemoryStore>,
    observer: Shared,
    newer: Option<Newer>,
    state: Mutex<State>,
}

fn cause(text: &'static str) -> Cause {
    Arc::new(std::io::Error::other(text))
}

impl ServerDisk {
    /// A healthy disk over `inner`, watched by `observer`; `newer` says which version of the server writes.
    pub fn new(inner: Arc<MemoryStore>, observer: Shared, seed: u64, newer: Option<Newer>) -> Self {
        let rng = StdRng::seed_from_u64(seed ^ 0x6469_736b);
        let state = Mutex::new(State { mood: Mood::GOOD, rng, unknown: 0, refused: 0, slow: 0 });
        Self { inner, observer, newer, state }
    }
    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// From now on it behaves like this.
    pub fn set(&self, mood: Mood) {
        self.state().mood = mood;
    }
    /// What it did wrong so far, by name.
    pub fn hits(&self) -> [(&'static str, u64); 3] {
        let state = self.state();
        [
            ("commit without an answer", state.unknown),
            ("call a disk refused", state.refused),
            ("commit on a slow disk", state.slow),
        ]
    }
    fn readable(&self) -> Result<(), Error> {
        let mut state = self.state();
        if state.mood.gone {
            state.refused += 1;
            return Err(Error::Unavailable(cause("the disk is gone")));
        }
        Ok(())
    }
}

#[async_trait::async_trait]
impl Store for ServerDisk {
    fn id(&self) -> &StoreId {
        self.inner.id()
    }
    fn site_id(&self) -> &SiteId {
        self.inner.site_id()
    }
    fn is_shared(&self) -> bool {
        self.inner.is_shared()
    }
    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        let count = items.len();
        let (before, after) = {
            let mut state = self.state();
            let slow_ms = state.mood.slow_ms;
            state.slow += u64::from(slow_ms > Mood::GOOD.slow_ms);
            (state.rng.random_range(0..=slow_ms), state.rng.random_range(0..=slow_ms / 2))
        };
        tokio::time::sleep(Duration::from_millis(before)).await;
        let (gone, unknown, applies) = {
            let mut state = self.state();
            let permille = state.mood.unknown_permille;
            let unknown = state.rng.random_range(0..1_000) < permille;
            state.unknown += u64::from(unknown);
            state.refused += u64::from(state.mood.gone);
            (state.mood.gone, unknown, state.rng.random_bool(0.5))
        };
        if gone {
            return vec![Err(CommitError::Unavailable(cause("the disk is gone"))); count];
        }
        let unheard = || vec![Err(CommitError::Unknown(cause("the disk did not answer"))); count];
        if unknown && !applies {
            return unheard();
        }
        let items = match &self.newer {
            Some(newer) => newer.writes(items),
            None => items,
        };
        let results = self.inner.commit(items).await;
        self.observer.committed();
        tokio::time::sleep(Duration::from_millis(after)).await;
        if unknown { unheard() } else { results }
    }
    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        self.readable()?;
        self.inner.get(keys).await
    }
    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        self.readable()?;
        self.inner.list(query).await
    }
    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        self.readable()?;
        self.inner.read(parts, named).await
    }
    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.readable()?;
        self.inner.feed(after, logs, limit).await
    }
    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.readable()?;
        self.inner.feed_of(subjects, after, limit).await
    }
    fn wake(&self) -> watch::Receiver<Seq> {
        self.inner.wake()
    }
    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        self.inner.raise_head(at_least).await
    }
    async fn audit_heads(&self) -> Result<BTreeMap<Writer, Head>, Error> {
        self.readable()?;
        self.inner.audit_heads().await
    }
    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        self.inner.prune(keep).await
    }
}

/// Where the same disk keeps STATUS.
pub struct ServerFrames {
    inner: MemoryFrames,
    disk: Arc<ServerDisk>,
}

impl ServerFrames {
    /// Over `inner`, as healthy as `disk` is.
    pub fn new(inner: MemoryFrames, disk: Arc<ServerDisk>) -> Self {
        Self { inner, disk }
    }
    async fn write(&self) -> Result<(), Error> {
        let slow_ms = self.disk.state().mood.slow_ms;
        tokio::time::sleep(Duration::from_millis(slow_ms / 2)).await;
        self.disk.readable()
    }
}

#[async_trait::async_trait]
impl FrameLog for ServerFrames {
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error> {
        self.write().await?;
        self.inner.append(frames.clone()).await?;
        self.disk.observer.stored(&frames);
        Ok(())
    }
    async fn marks(&self) -> Result<Vec<FrameMark>, Error> {
        self.inner.marks().await
    }
    async fn forget(&self, marks: Vec<FrameMark>) -> Result<u64, Error> {
        self.inner.forget(marks).await
    }
    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error> {
        self.inner.read(after, bytes_max).await
    }
    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error> {
        if gaps.iter().any(|gap| !self.disk.observer.lock().is_player(&gap.robot_id)) {
            self.disk.observer.lock().find(format!("I9 status in order, once, without gaps: {gaps:?}"));
        }
        self.inner.report_gaps(gaps).await
    }
    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error> {
        self.inner.gaps(robot_id, limit).await
    }
    async fn prune(&self) -> Result<u64, Error> {
        self.inner.prune().await
    }
    async fn coarsen(&self, coarsen: Coarsen) -> Result<u64, Error> {
        self.inner.coarsen(coarsen).await
    }
    async fn oldest(&self) -> Result<FramesOldest, Error> {
        self.inner.oldest().await
    }
}

/// A robot's disk: each write takes some milliseconds, and a crash in them loses it.
pub struct RobotDisk {
    inner: RobotMemoryStore,
    robot_id: RobotId,
    observer: Shared,
    rng: StdRng,
}

impl RobotDisk {
    /// A handle of one process on what outlives it.
    pub fn open(inner: RobotMemoryStore, robot_id: RobotId, observer: Shared, seed: u64) -> Self {
        Self { inner, robot_id, observer, rng: StdRng::seed_from_u64(seed) }
    }
}

#[async_trait::async_trait]
impl RobotStore for RobotDisk {
    async fn load(&mut self, new_ring_id: &str) -> Result<RobotMemory, RobotError> {
        Ok(self.inner.load_now(new_ring_id))
    }
    async fn commit(&mut self, ops: &[Op]) -> Result<(), RobotError> {
        let (before, after) = (self.rng.random_range(0..12), self.rng.random_range(0..4));
        tokio::time::sleep(Duration::from_millis(before)).await;
        self.inner.commit_now(ops);
        self.observer.ledger(&self.robot_id, ops);
        tokio::time::sleep(Duration::from_millis(after)).await;
        Ok(())
    }
}
