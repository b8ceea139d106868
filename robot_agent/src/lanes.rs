//! The sending side of the lanes: what goes up next, how much may be under way, and what an answer of the server means.
//!
//! Invariant: a sample is sent only after it is durable, in order, and after a break again from what the server has. CRITICAL and
//! EVENT need no credit; STATUS from before the session takes at most a quarter of it. Called by the core alone.

use crate::ring::{Item, Ring};
use midshift_core::limits;
use midshift_core::robot::Lane;
use midshift_core::work::{InboxItem, Sample};
use midshift_proto::session::LaneBatch;

/// Unacknowledged samples of CRITICAL or EVENT under way at most. They need no credit; the queue to the wire needs a bound.
const URGENT_IN_FLIGHT: u64 = 1_024;
/// What one STATUS sample takes on the wire at most, bytes.
const STATUS_SAMPLE_BYTES: usize = 192;

/// Where sending stands in each lane.
#[derive(Clone, Debug)]
pub struct Sender {
    cursor: [u64; 3],
    durable: [u64; 3],
    replay_to: u64,
    credit_bytes: usize,
}

impl Sender {
    /// Before the first session. Everything in `ring` is durable.
    pub fn new(ring: &Ring) -> Self {
        let durable = Lane::ALL.map(|lane| ring.lane(lane).produced);
        Self { cursor: durable, durable, replay_to: 0, credit_bytes: 0 }
    }

    /// A new session begins: everything unacknowledged is sent again, and what STATUS there is counts as old.
    pub fn connected(&mut self, ring: &Ring, credit_bytes: usize) {
        self.cursor = Lane::ALL.map(|lane| ring.lane(lane).acked);
        self.replay_to = ring.lane(Lane::Status).produced;
        self.credit_bytes = credit_bytes;
    }

    /// STATUS that may be under way, bytes.
    pub fn credit(&mut self, bytes: usize) {
        self.credit_bytes = bytes;
    }

    /// Everything up to these numbers is durable.
    pub fn durable(&mut self, produced: [u64; 3]) {
        self.durable = produced;
    }

    /// The server wants `expect` next: go back to it.
    pub fn rewind(&mut self, lane: Lane, expect: u64) {
        self.cursor[lane as usize] = expect.saturating_sub(1);
    }

    /// The next message of a lane, if one may go now.
    pub fn next_batch(&mut self, ring: &Ring, lane: Lane) -> Option<LaneBatch> {
        let at = lane as usize;
        let may_reach = (ring.lane(lane).acked + self.window(lane)).min(self.durable[at]);
        let mut items = Vec::new();
        while items.len() < limits::SAMPLES_PER_MESSAGE {
            match ring.after(lane, self.cursor[at]) {
                Some(Item::Gap(gap)) if gap.to_seq <= self.durable[at] => {
                    self.cursor[at] = gap.to_seq;
                    items.push(InboxItem::Gap(gap));
                }
                Some(Item::Sample(sample)) if sample.seq <= may_reach => {
                    self.cursor[at] = sample.seq;
                    items.push(InboxItem::Sample(Sample::clone(&sample)));
                }
                _ => break,
            }
        }
        (!items.is_empty()).then_some(LaneBatch { lane, items })
    }

    /// Samples of a lane that may be unacknowledged.
    fn window(&self, lane: Lane) -> u64 {
        if lane != Lane::Status {
            return URGENT_IN_FLIGHT;
        }
        let credit = self.credit_bytes.min(limits::STATUS_IN_FLIGHT_BYTES);
        let replays = self.cursor[lane as usize] < self.replay_to;
        let bytes = if replays { credit / 4 } else { credit };
        (bytes / STATUS_SAMPLE_BYTES) as u64
    }
}
