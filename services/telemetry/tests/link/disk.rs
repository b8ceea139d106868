//! A frame log that can be told to be slow: what telemetry sees of a disk that has other things to do.

use async_trait::async_trait;
use midshift_core::ids::RobotId;
use midshift_store::{Error, Frame, FrameLog, FrameMark, Gap, MemoryFrames, StoredFrame};
use std::sync::Arc;
use tokio::sync::watch;

pub struct Disk {
    inner: MemoryFrames,
    stuck: watch::Sender<bool>,
}

impl Disk {
    pub fn over(inner: MemoryFrames) -> Arc<Self> {
        Arc::new(Self { inner, stuck: watch::Sender::new(false) })
    }
    /// From now on nothing gets to the disk, or everything does again.
    pub fn stick(&self, stuck: bool) {
        self.stuck.send_replace(stuck);
    }
}

#[async_trait]
impl FrameLog for Disk {
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error> {
        // The sender lives as long as this disk.
        let _ = self.stuck.subscribe().wait_for(|stuck| !stuck).await;
        self.inner.append(frames).await
    }
    async fn marks(&self) -> Result<Vec<FrameMark>, Error> {
        self.inner.marks().await
    }
    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error> {
        self.inner.read(after, bytes_max).await
    }
    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error> {
        self.inner.report_gaps(gaps).await
    }
    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error> {
        self.inner.gaps(robot_id, limit).await
    }
    async fn prune(&self) -> Result<u64, Error> {
        self.inner.prune().await
    }
}
