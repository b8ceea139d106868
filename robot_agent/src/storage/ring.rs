//! The ring of samples: numbered per lane, kept until the server has stored them, never lost in silence (laws L1, L2,
//! L4, L5).
//!
//! Invariant: a number is given once; what is freed before it was acknowledged leaves a [`Gap`]; CRITICAL and EVENT
//! never make room. Pure values: decisions give [`Op`]s, and applying an operation is the only way to change a ring.
//! Called by the core and the stores.

use super::op::Op;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot::Lane;
use midshift_core::robot_events::{Gap, Sample, SampleBody};
use std::collections::VecDeque;
use std::sync::Arc;

/// The samples and gaps of one lane that the server has not acknowledged.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LaneBuffer {
    /// Highest number ever given. 0: none.
    pub produced: u64,
    /// Everything up to here is stored by the server.
    pub acked: u64,
    /// Not acknowledged, rising.
    pub samples: VecDeque<Arc<Sample>>,
    /// Announced as missing and not acknowledged, rising, never overlapping.
    pub gaps: VecDeque<Gap>,
}

impl LaneBuffer {
    /// Oldest number that can still be sent, as sample or gap; the next number to be given if nothing is kept.
    pub fn first(&self) -> u64 {
        let sample = self.samples.front().map(|s| s.seq);
        let gap = self.gaps.front().map(|g| g.from_seq);
        sample.into_iter().chain(gap).min().unwrap_or(self.produced + 1)
    }
}

/// What comes next on the way up.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// A sample.
    Sample(Arc<Sample>),
    /// A range that will never come.
    Gap(Gap),
}

/// All lanes of one ring.
#[derive(Clone, Debug, PartialEq)]
pub struct Ring {
    /// Random, made when the ring was formatted.
    pub id: String,
    lanes: [LaneBuffer; 3],
}

/// Share of a full STATUS lane that is freed at once.
const THIN_BY: usize = 8;

impl Ring {
    /// An empty ring.
    pub fn new(id: impl Into<String>) -> Self {
        Self { id: id.into(), lanes: Default::default() }
    }

    /// One lane.
    pub fn lane(&self, lane: Lane) -> &LaneBuffer {
        &self.lanes[lane as usize]
    }

    /// One lane, for a store that reads it back.
    pub fn lane_mut(&mut self, lane: Lane) -> &mut LaneBuffer {
        &mut self.lanes[lane as usize]
    }

    /// The operations that add one sample: room is made first if STATUS is full.
    pub fn append(&self, lane: Lane, robot_unix_ms: i64, body: SampleBody) -> Vec<Op> {
        let buffer = self.lane(lane);
        let mut ops = Vec::new();
        if lane == Lane::Status && buffer.samples.len() >= limits::RING_STATUS_MAX {
            let room = limits::RING_STATUS_MAX / THIN_BY;
            if let (Some(first), Some(last)) = (buffer.samples.front(), buffer.samples.get(room - 1)) {
                let before = buffer.gaps.iter().find(|g| g.to_seq + 1 == first.seq).map(|g| g.from_seq);
                let from_seq = before.unwrap_or(first.seq);
                ops.push(Op::Gap(Gap { lane, from_seq, to_seq: last.seq, reason: Code::Overflow.into() }));
            }
        }
        let sample = Sample { seq: buffer.produced + 1, robot_unix_ms, body };
        ops.push(Op::Append(lane, Arc::new(sample)));
        ops
    }

    /// The operation that obeys an acknowledgement, if it says anything new.
    pub fn ack(&self, lane: Lane, seq: u64) -> Option<Op> {
        let buffer = self.lane(lane);
        let seq = seq.min(buffer.produced);
        let news = seq > buffer.acked || buffer.gaps.front().is_some_and(|g| g.to_seq <= seq);
        news.then_some(Op::Free(lane, seq))
    }

    /// The gap to announce if the server expects a number that was freed; none if it can be sent again.
    pub fn expected(&self, lane: Lane, expect: u64) -> Option<Op> {
        let first = self.lane(lane).first();
        let lost = expect >= 1 && expect < first;
        lost.then(|| Op::Gap(Gap { lane, from_seq: expect, to_seq: first - 1, reason: Code::FreedAfterAck.into() }))
    }

    /// The operations that move a lane's numbers past `watermark`, which the server has from a later life of this ring:
    /// a disk that was put back. Samples with used numbers would be dropped as known.
    pub fn jump(&self, lane: Lane, watermark: u64) -> Vec<Op> {
        let buffer = self.lane(lane);
        if watermark <= buffer.produced {
            return Vec::new();
        }
        let mut ops = vec![Op::Jump(lane, watermark)];
        for (at, sample) in buffer.samples.iter().enumerate() {
            let seq = watermark + 1 + at as u64;
            ops.push(Op::Append(lane, Arc::new(Sample { seq, ..Sample::clone(sample) })));
        }
        ops
    }

    /// What to send after number `cursor`. None: nothing yet.
    pub fn after(&self, lane: Lane, cursor: u64) -> Option<Item> {
        let buffer = self.lane(lane);
        if let Some(gap) = buffer.gaps.iter().find(|g| g.from_seq <= cursor + 1 && g.to_seq > cursor) {
            return Some(Item::Gap(gap.clone()));
        }
        let at = buffer.samples.partition_point(|s| s.seq <= cursor);
        buffer.samples.get(at).map(|s| Item::Sample(s.clone()))
    }

    /// Applies one operation; others than those of the ring change nothing.
    pub fn apply(&mut self, op: &Op) {
        match op {
            Op::Append(lane, sample) => {
                let buffer = self.lane_mut(*lane);
                buffer.produced = sample.seq;
                buffer.samples.push_back(sample.clone());
            }
            Op::Free(lane, seq) => {
                let buffer = self.lane_mut(*lane);
                buffer.acked = buffer.acked.max(*seq);
                while buffer.samples.front().is_some_and(|s| s.seq <= *seq) {
                    buffer.samples.pop_front();
                }
                buffer.gaps.retain(|g| g.to_seq > *seq);
            }
            Op::Gap(gap) => {
                let buffer = self.lane_mut(gap.lane);
                buffer.samples.retain(|s| s.seq < gap.from_seq || s.seq > gap.to_seq);
                buffer.gaps.retain(|g| g.from_seq < gap.from_seq || g.to_seq > gap.to_seq);
                let at = buffer.gaps.partition_point(|g| g.from_seq < gap.from_seq);
                buffer.gaps.insert(at, gap.clone());
            }
            Op::Jump(lane, watermark) => {
                let buffer = self.lane_mut(*lane);
                *buffer = LaneBuffer { produced: *watermark, acked: *watermark, ..LaneBuffer::default() };
            }
            _ => {}
        }
    }
}
