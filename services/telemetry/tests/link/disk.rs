//! A frame log that can be told to be slow or to refuse: what telemetry sees of a disk that has other things to do, or is full.

use async_trait::async_trait;
use midshift_core::ids::RobotId;
use midshift_store::{Coarsen, Error, Frame, FrameLog, FrameMark, FramesOldest, Gap, MemoryFrames, StoredFrame};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use tokio::sync::watch;

pub struct Disk {
    inner: MemoryFrames,
    stuck: watch::Sender<bool>,
    full: AtomicBool,
    refused: AtomicU64,
    written: watch::Sender<u64>,
}

impl Disk {
    pub fn over(inner: MemoryFrames) -> Arc<Self> {
        Arc::new(Self {
            inner,
            stuck: watch::Sender::new(false),
            full: AtomicBool::new(false),
            refused: AtomicU64::new(0),
            written: watch::Sender::new(0),
        })
    }
    /// From now on nothing gets to the disk, or everything does again.
    pub fn stick(&self, stuck: bool) {
        self.stuck.send_replace(stuck);
    }
    /// From now on every write is refused, or none is.
    pub fn fill(&self, full: bool) {
        self.full.store(full, Relaxed);
    }
    /// Writes that were refused.
    pub fn refused(&self) -> u64 {
        self.refused.load(Relaxed)
    }
    /// Writes of frames that were not refused, once there is one.
    pub async fn written(&self) -> u64 {
        // The sender lives as long as this disk.
        self.written.subscribe().wait_for(|writes| *writes > 0).await.map_or(0, |writes| *writes)
    }
    /// Waits until all up to this number is kept.
    pub async fn has(&self, seq: u64) -> Result<(), Error> {
        let mut written = self.written.subscribe();
        while self.inner.marks().await?.iter().all(|mark| mark.seq < seq) {
            // The sender lives as long as this disk.
            let _ = written.changed().await;
        }
        Ok(())
    }
    fn room(&self) -> Result<(), Error> {
        if self.full.load(Relaxed) {
            self.refused.fetch_add(1, Relaxed);
            return Err(Error::Unavailable(Arc::new(std::io::Error::other("the disk is full"))));
        }
        Ok(())
    }
}

#[async_trait]
impl FrameLog for Disk {
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error> {
        // The sender lives as long as this disk.
        let _ = self.stuck.subscribe().wait_for(|stuck| !stuck).await;
        self.room()?;
        let kept = self.inner.append(frames).await;
        self.written.send_modify(|writes| *writes += 1);
        kept
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
        self.room()?;
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
