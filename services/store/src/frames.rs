//! Samples as they came from the robots, in bulk and in order of arrival: a log of frames, not rows with revisions.
//!
//! Invariant: a frame is acknowledged only once it is durable, and what is missing is said in a gap, never left out silently.
//! Frames are not decoded here. Called by telemetry; if this log fails, nothing else does.

use crate::Error;
use async_trait::async_trait;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::privacy;
use midshift_core::time::{Clock, Utc};
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Bytes of frames kept unless configured otherwise.
pub const FRAME_BYTES_DEFAULT: u64 = 2 * 1024 * 1024 * 1024;
/// Gaps kept in memory by [`MemoryFrames`], and listed at most by one call.
pub const GAPS_MAX: usize = 10_000;
/// After this no frame is kept, milliseconds.
pub(crate) const DAYS_MS: u64 = limits::STATUS_DAYS * 24 * 3_600_000;
/// Bytes of a ring's name.
const RING_BYTES_MAX: usize = 64;

/// Consecutive STATUS samples of one robot, encoded by the caller.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The robot that made them.
    pub robot_id: RobotId,
    /// The robot's ring that numbers them.
    pub ring: Arc<str>,
    /// Number of the first sample.
    pub first_seq: u64,
    /// Number of the last sample.
    pub last_seq: u64,
    /// The samples.
    pub bytes: Arc<[u8]>,
}

/// A frame with its place in the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredFrame {
    /// Rises with every group of frames; frames of one group share it.
    pub position: u64,
    /// When the group became durable, UTC unix ms.
    pub at_unix_ms: i64,
    /// The frame.
    pub frame: Frame,
}

/// How far a robot's ring has become durable: the acknowledgement.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FrameMark {
    /// The robot that the ring is of.
    pub robot_id: RobotId,
    /// Its ring.
    pub ring: Arc<str>,
    /// Highest sample number.
    pub seq: u64,
}

/// Samples that will never come, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Gap {
    /// The robot that lost them.
    pub robot_id: RobotId,
    /// Its ring.
    pub ring: Arc<str>,
    /// Lane in the spelling of the wire (`STATUS`).
    pub lane: Arc<str>,
    /// First missing number.
    pub from_seq: u64,
    /// Last missing number.
    pub to_seq: u64,
    /// Code of the reason (`OVERFLOW`).
    pub reason: Arc<str>,
    /// When it was noticed, UTC unix ms.
    pub at_unix_ms: i64,
}

/// What makes the samples of one frame coarser; none: they cannot be read. Done twice, it is as done once.
pub type Coarsen = fn(&[u8]) -> Option<Vec<u8>>;

/// When the oldest of what is kept became durable, UTC unix ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FramesOldest {
    /// Of all frames; none: there is none.
    pub any: Option<i64>,
    /// Of those that are as they came; none: there is none.
    pub precise: Option<i64>,
}

/// Whether a row that became durable then is so old, or so plainly of a wrong clock, that it is to be treated as old.
pub(crate) fn is_aged(at_unix_ms: i64, now: Utc, age_ms: u64) -> bool {
    now.ms_since(Utc(at_unix_ms)) >= age_ms || at_unix_ms > now.0
}

/// The log of frames.
#[async_trait]
pub trait FrameLog: Send + Sync + 'static {
    /// Appends frames; returns after the fsync that holds them. All or none.
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error>;
    /// How far each ring has come, sorted by robot and ring; for start-up.
    async fn marks(&self) -> Result<Vec<FrameMark>, Error>;
    /// How far one ring has come, whoever wrote it; 0: nothing of it is kept.
    async fn mark(&self, robot_id: &RobotId, ring: &str) -> Result<u64, Error> {
        let marks = self.marks().await?;
        Ok(marks.iter().find(|m| m.robot_id == *robot_id && *m.ring == *ring).map_or(0, |m| m.seq))
    }
    /// Forgets how far rings have come, each only if its mark is still as it was read. Returns how many were forgotten.
    async fn forget(&self, marks: Vec<FrameMark>) -> Result<u64, Error>;
    /// Frames after a position, whole groups, until `bytes_max` is passed. Empty: there is nothing newer.
    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error>;
    /// Writes gaps down; durable on return.
    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error>;
    /// Newest gaps of one robot or of all, newest first, at most [`GAPS_MAX`].
    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error>;
    /// Takes the oldest frames out until the kept ones are within their bytes and their days ([`privacy::Retention::Coarsened`]); in small
    /// slices. Returns the bytes freed.
    async fn prune(&self) -> Result<u64, Error>;
    /// Lets `coarsen` at the samples of frames that are older than [`privacy::PRECISE_MS`], each once whoever else does so, oldest first; in small slices,
    /// each of one transaction. Frames keep their positions and numbers. Returns how many rows were changed.
    async fn coarsen(&self, coarsen: Coarsen) -> Result<u64, Error>;
    /// How old what is kept is.
    async fn oldest(&self) -> Result<FramesOldest, Error>;
}

/// Refuses what would spoil the group it is written with.
pub(crate) fn frames_well_formed(frames: &[Frame]) -> Result<(), Error> {
    for frame in frames {
        numbers_well_formed(&frame.ring, frame.first_seq, frame.last_seq)?;
        if frame.bytes.len() > limits::TELEMETRY_BATCH_BYTES {
            return Err(Error::BadFrame("holds more bytes than one telemetry batch"));
        }
    }
    Ok(())
}

/// As [`frames_well_formed`].
pub(crate) fn gaps_well_formed(gaps: &[Gap]) -> Result<(), Error> {
    gaps.iter().try_for_each(|gap| {
        if [&gap.lane, &gap.reason].into_iter().any(|text| text.as_bytes().contains(&0)) {
            return Err(Error::BadFrame("has a NUL byte in a text"));
        }
        numbers_well_formed(&gap.ring, gap.from_seq, gap.to_seq)
    })
}

fn numbers_well_formed(ring: &str, first: u64, last: u64) -> Result<(), Error> {
    if ring.is_empty() || ring.len() > RING_BYTES_MAX || ring.as_bytes().contains(&0) {
        return Err(Error::BadFrame("ring must be 1-64 bytes without NUL"));
    }
    if first > last || last > i64::MAX.cast_unsigned() {
        return Err(Error::BadFrame("numbers must rise and stay below 2^63"));
    }
    Ok(())
}

/// Highest number per robot and ring.
#[derive(Clone, Debug, Default)]
pub(crate) struct Marks(BTreeMap<(RobotId, Arc<str>), u64>);

impl Marks {
    pub(crate) fn raise(&mut self, robot_id: &RobotId, ring: &Arc<str>, seq: u64) {
        let mark = self.0.entry((robot_id.clone(), ring.clone())).or_default();
        *mark = seq.max(*mark);
    }

    /// Takes a mark out that is still as it was read; whether it was.
    pub(crate) fn forget(&mut self, mark: &FrameMark) -> bool {
        let key = (mark.robot_id.clone(), mark.ring.clone());
        let is_as_read = self.0.get(&key) == Some(&mark.seq);
        if is_as_read {
            self.0.remove(&key);
        }
        is_as_read
    }

    pub(crate) fn list(&self) -> Vec<FrameMark> {
        let mark = |((robot_id, ring), seq): (&(RobotId, Arc<str>), &u64)| FrameMark {
            robot_id: robot_id.clone(),
            ring: ring.clone(),
            seq: *seq,
        };
        self.0.iter().map(mark).collect()
    }
}

/// A [`FrameLog`] in memory; the oldest frames go by themselves.
pub struct MemoryFrames {
    clock: Arc<dyn Clock>,
    bytes_max: u64,
    state: Mutex<FramesState>,
}

/// The frames in memory, with their marks and gaps.
#[derive(Default)]
struct FramesState {
    frames: VecDeque<StoredFrame>,
    bytes: u64,
    position: u64,
    marks: Marks,
    gaps: VecDeque<Gap>,
    /// Position up to which frames were made coarser.
    coarse: u64,
}

impl MemoryFrames {
    /// An empty log that keeps about `bytes_max` bytes of frames.
    pub fn new(clock: Arc<dyn Clock>, bytes_max: u64) -> Self {
        Self { clock, bytes_max, state: Mutex::default() }
    }

    fn state(&self) -> MutexGuard<'_, FramesState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl FramesState {
    fn prune(&mut self, bytes_max: u64) -> u64 {
        let before = self.bytes;
        while self.bytes > bytes_max {
            let Some(oldest) = self.frames.pop_front() else { break };
            self.bytes -= oldest.frame.bytes.len() as u64;
        }
        before - self.bytes
    }
}

#[async_trait]
impl FrameLog for MemoryFrames {
    async fn append(&self, frames: Vec<Frame>) -> Result<(), Error> {
        frames_well_formed(&frames)?;
        let at_unix_ms = self.clock.now().wall.0;
        let mut state = self.state();
        state.position += 1;
        let position = state.position;
        for frame in frames {
            state.marks.raise(&frame.robot_id, &frame.ring, frame.last_seq);
            state.bytes += frame.bytes.len() as u64;
            state.frames.push_back(StoredFrame { position, at_unix_ms, frame });
        }
        state.prune(self.bytes_max);
        Ok(())
    }

    async fn marks(&self) -> Result<Vec<FrameMark>, Error> {
        Ok(self.state().marks.list())
    }

    async fn forget(&self, marks: Vec<FrameMark>) -> Result<u64, Error> {
        let mut state = self.state();
        Ok(marks.iter().filter(|mark| state.marks.forget(mark)).count() as u64)
    }

    async fn read(&self, after: u64, bytes_max: usize) -> Result<Vec<StoredFrame>, Error> {
        let state = self.state();
        let start = state.frames.partition_point(|f| f.position <= after);
        let (mut page, mut bytes): (Vec<StoredFrame>, usize) = (Vec::new(), 0);
        for stored in state.frames.range(start..) {
            if bytes > bytes_max && page.last().is_some_and(|last| last.position != stored.position) {
                break;
            }
            bytes += stored.frame.bytes.len();
            page.push(stored.clone());
        }
        Ok(page)
    }

    async fn report_gaps(&self, gaps: Vec<Gap>) -> Result<(), Error> {
        gaps_well_formed(&gaps)?;
        let mut state = self.state();
        state.gaps.extend(gaps);
        let over = state.gaps.len().saturating_sub(GAPS_MAX);
        state.gaps.drain(..over);
        Ok(())
    }

    async fn gaps(&self, robot_id: Option<&RobotId>, limit: usize) -> Result<Vec<Gap>, Error> {
        let state = self.state();
        let of_robot = state.gaps.iter().rev().filter(|gap| robot_id.is_none_or(|id| *id == gap.robot_id));
        Ok(of_robot.take(limit.min(GAPS_MAX)).cloned().collect())
    }

    async fn prune(&self) -> Result<u64, Error> {
        let now = self.clock.now().steady_wall();
        let mut state = self.state();
        let aged = state.frames.iter().take_while(|f| now.ms_since(Utc(f.at_unix_ms)) >= DAYS_MS).count();
        let freed: u64 = state.frames.drain(..aged).map(|f| f.frame.bytes.len() as u64).sum();
        state.bytes -= freed;
        Ok(freed + state.prune(self.bytes_max))
    }

    async fn coarsen(&self, coarsen: Coarsen) -> Result<u64, Error> {
        let now = self.clock.now().steady_wall();
        let mut guard = self.state();
        let state = &mut *guard;
        let mut changed = 0;
        let start = state.frames.partition_point(|f| f.position <= state.coarse);
        for stored in state.frames.range_mut(start..).take_while(|f| is_aged(f.at_unix_ms, now, privacy::PRECISE_MS)) {
            state.bytes -= stored.frame.bytes.len() as u64;
            stored.frame.bytes = Arc::from(coarsen(&stored.frame.bytes).unwrap_or_default());
            state.bytes += stored.frame.bytes.len() as u64;
            state.coarse = stored.position;
            changed += 1;
        }
        Ok(changed)
    }

    async fn oldest(&self) -> Result<FramesOldest, Error> {
        let state = self.state();
        let precise = state.frames.iter().find(|f| f.position > state.coarse);
        Ok(FramesOldest { any: state.frames.front().map(|f| f.at_unix_ms), precise: precise.map(|f| f.at_unix_ms) })
    }
}
