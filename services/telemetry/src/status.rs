//! STATUS of one session: numbers are checked on arrival, samples are kept as they came in the frame log, and acknowledged in bulk after that.
//!
//! Laws: those of [`crate::events`]. Invariant: what waits for the disk is bounded by the credit the robot was given; a robot that
//! sends more is let go.

use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::robot::Lane;
use midshift_core::work::InboxItem;
use midshift_proto::link::v1;
use midshift_proto::session::{LaneAck, LaneBatch};
use midshift_store::{Frame, FrameLog};
use prost::Message;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// STATUS is acknowledged at most this often, or at half of its credit.
const ACK_EVERY: Duration = Duration::from_secs(2);
/// After a failed write the robot is asked again not sooner than this.
const RETRY: Duration = Duration::from_millis(200);
/// STATUS of one session that may wait for the disk, bytes: the credit, and as much again for what the two ends count differently.
const WAITING_BYTES_MAX: usize = 2 * limits::STATUS_IN_FLIGHT_BYTES;

/// What came of one batch on arrival.
#[derive(Debug, PartialEq, Eq)]
pub enum Arrived {
    /// What was new waits to be kept.
    Taken,
    /// Tell the robot to send again from here.
    Expect(LaneAck),
    /// More than its credit is under way.
    OverCredit,
}

/// The STATUS lane of one ring.
pub struct StatusLane {
    robot_id: RobotId,
    ring: Arc<str>,
    taken: u64,
    durable: u64,
    acked: u64,
    unacked_bytes: usize,
    waiting: Vec<Frame>,
    /// Of what waits and of what is being written.
    unkept_bytes: usize,
    ack_due: Instant,
}

fn numbers(item: &InboxItem) -> (u64, u64) {
    match item {
        InboxItem::Sample(s) => (s.seq, s.seq),
        InboxItem::Poison { seq, .. } => (*seq, *seq),
        InboxItem::Gap(g) => (g.from_seq, g.to_seq),
    }
}

impl StatusLane {
    /// From what is durable.
    pub fn new(robot_id: RobotId, ring: Arc<str>, durable: u64) -> Self {
        Self {
            robot_id,
            ring,
            taken: durable,
            durable,
            acked: durable,
            unacked_bytes: 0,
            waiting: Vec::new(),
            unkept_bytes: 0,
            ack_due: Instant::now() + ACK_EVERY,
        }
    }
    /// Takes a batch.
    pub fn arrive(&mut self, batch: &LaneBatch) -> Arrived {
        let mut first = None;
        let mut taken = self.taken;
        for item in &batch.items {
            let (from, to) = numbers(item);
            if to <= taken {
                continue;
            }
            if from > taken + 1 {
                let ack = LaneAck { lane: Lane::Status, seq: self.durable, expect: Some(self.taken + 1) };
                return Arrived::Expect(ack);
            }
            first.get_or_insert(from.max(taken + 1));
            taken = to;
        }
        let Some(first_seq) = first else { return Arrived::Taken };
        let bytes = v1::LaneBatch::from(batch).encode_to_vec();
        if self.unkept_bytes + bytes.len() > WAITING_BYTES_MAX {
            return Arrived::OverCredit;
        }
        self.taken = taken;
        self.unacked_bytes += bytes.len();
        self.unkept_bytes += bytes.len();
        let (robot_id, ring) = (self.robot_id.clone(), self.ring.clone());
        self.waiting.push(Frame { robot_id, ring, first_seq, last_seq: taken, bytes: Arc::from(bytes) });
        Arrived::Taken
    }
    /// What is to be kept next; none if nothing waits.
    pub fn next_write(&mut self) -> Option<Vec<Frame>> {
        (!self.waiting.is_empty()).then(|| std::mem::take(&mut self.waiting))
    }
    /// What was written is durable up to here. True: it is time to acknowledge.
    pub fn kept(&mut self, seq: u64) -> bool {
        self.durable = seq;
        self.unkept_bytes = self.waiting.iter().map(|f| f.bytes.len()).sum();
        self.unacked_bytes * 2 >= limits::STATUS_IN_FLIGHT_BYTES
    }
    /// It is not: everything since the durable number must come again.
    pub fn lost(&mut self) -> LaneAck {
        self.taken = self.durable;
        self.waiting.clear();
        self.unkept_bytes = 0;
        LaneAck { lane: Lane::Status, seq: self.durable, expect: Some(self.durable + 1) }
    }
    /// When to acknowledge at the latest; none: there is nothing to.
    pub fn ack_at(&self) -> Option<Instant> {
        (self.durable > self.acked).then_some(self.ack_due)
    }
    /// What is durable, as it is acknowledged now.
    pub fn ack(&mut self) -> LaneAck {
        self.acked = self.durable;
        self.unacked_bytes = 0;
        self.ack_due = Instant::now() + ACK_EVERY;
        LaneAck { lane: Lane::Status, seq: self.durable, expect: None }
    }
}

/// Keeps frames; the number up to which they are durable then, or none if they are not.
pub async fn keep(log: Arc<dyn FrameLog>, frames: Vec<Frame>) -> Option<u64> {
    let last = frames.last().map_or(0, |f| f.last_seq);
    match log.append(frames).await {
        Ok(()) => Some(last),
        Err(error) => {
            tracing::warn!(%error, "status was not stored");
            tokio::time::sleep(RETRY).await;
            None
        }
    }
}
