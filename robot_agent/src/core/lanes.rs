//! Sends the lanes: picks the next batch, limits what is unacknowledged, and applies the server's answers.
//!
//! Invariants:
//! 1. A sample is sent only after it is durable, and in order. After a reconnect it goes on from what the server has.
//! 2. CRITICAL and EVENT need no credit.
//! 3. STATUS takes one path at a time. What gathered before the session goes over bulk; only then newer STATUS goes on
//!    the session.
//! 4. A backlog of at most [`limits::REPLAY_ON_LINK_MAX`], or one that bulk does not take, goes on the session, with at
//!    most a quarter of the credit.

use crate::storage::ring::{Item, Ring};
use midshift_core::limits;
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxItem, Sample};
use midshift_proto::session::LaneBatch;

/// Unacknowledged samples of CRITICAL or EVENT under way at most. They need no credit; the queue to the wire needs a
/// bound.
const URGENT_IN_FLIGHT: u64 = 1_024;
/// What one STATUS sample takes on the wire at most, bytes.
pub const STATUS_SAMPLE_BYTES: usize = 192;

/// Where sending stands in each lane.
#[derive(Clone, Debug)]
pub struct Sender {
    cursor: [u64; 3],
    durable: [u64; 3],
    replay_to: u64,
    /// STATUS up to `replay_to` goes over bulk.
    apart: bool,
    /// A batch of it is on its way there.
    under_way: bool,
    credit_bytes: usize,
}

impl Sender {
    /// Before the first session. Everything in `ring` is durable.
    pub fn new(ring: &Ring) -> Self {
        let durable = Lane::ALL.map(|lane| ring.lane(lane).produced);
        Self { cursor: durable, durable, replay_to: 0, apart: false, under_way: false, credit_bytes: 0 }
    }

    /// A new session begins: everything unacknowledged is sent again, and what STATUS there is counts as old.
    pub fn connected(&mut self, ring: &Ring, credit_bytes: usize) {
        self.cursor = Lane::ALL.map(|lane| ring.lane(lane).acked);
        let status = ring.lane(Lane::Status);
        self.replay_to = status.produced;
        self.apart = status.samples.len() + status.gaps.len() > limits::REPLAY_ON_LINK_MAX;
        self.under_way = false;
        self.credit_bytes = credit_bytes;
    }

    /// What is left of old STATUS goes on the session.
    pub fn replay_on_link(&mut self) {
        (self.apart, self.under_way) = (false, false);
    }

    /// Whether old STATUS still has to go over bulk, or be answered there.
    pub fn replays_apart(&self) -> bool {
        self.apart && (self.under_way || self.cursor[Lane::Status as usize] < self.replay_to)
    }

    /// The next batch of old STATUS, if one may go over bulk now: all that is durable, as far as it fits.
    pub fn next_replay(&mut self, ring: &Ring) -> Option<LaneBatch> {
        if self.under_way || !self.replays_apart() {
            return None;
        }
        let batch = self.gather(ring, Lane::Status, self.durable[Lane::Status as usize]);
        self.under_way = batch.is_some();
        batch
    }

    /// The batch that was under way is answered or lost: on from what the server has.
    pub fn replayed(&mut self, ring: &Ring) {
        self.under_way = false;
        self.cursor[Lane::Status as usize] = ring.lane(Lane::Status).acked;
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

    /// The next message of a lane on the session, if one may go now.
    pub fn next_batch(&mut self, ring: &Ring, lane: Lane) -> Option<LaneBatch> {
        if lane == Lane::Status && self.replays_apart() {
            return None;
        }
        let may_reach = (ring.lane(lane).acked + self.window(lane)).min(self.durable[lane as usize]);
        self.gather(ring, lane, may_reach)
    }

    /// What follows the cursor: samples up to a number, and durable gaps.
    fn gather(&mut self, ring: &Ring, lane: Lane, may_reach: u64) -> Option<LaneBatch> {
        let at = lane as usize;
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
