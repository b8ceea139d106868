//! STATUS of one session: numbers are checked on arrival, samples are kept as they came in the frame log, and acknowledged in bulk after that.
//!
//! Laws: those of [`crate::events`]. A gap that the robot announces is written down before it is acknowledged; while nothing can be
//! written, nothing is acknowledged, and what the robot's ring has to thin meanwhile is such a gap later. Old samples come over bulk, new ones
//! on the session, by one numbering: whichever way a batch took, what is known of it is dropped. Invariant: what waits for the
//! disk is bounded by the credit the robot was given; a robot that sends more is let go.

use crate::precision::coarsen_late;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Reason;
use midshift_core::robot::Lane;
use midshift_core::robot_events::InboxItem;
use midshift_core::time::Utc;
use midshift_proto::link::v1;
use midshift_proto::session::{LaneAck, LaneBatch};
use midshift_store::{Frame, Gap};
use prost::Message;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// STATUS is acknowledged with the first echo after this, or at half of its credit.
const ACK_AFTER: Duration = Duration::from_millis(1_500);
/// Without an echo it is acknowledged by itself after this.
const ACK_WITHIN: Duration = Duration::from_millis(2_500);
/// STATUS of one session that may wait for the disk, bytes: the credit, and as much again for what the two ends count differently.
const WAITING_BYTES_MAX: usize = 2 * limits::STATUS_IN_FLIGHT_BYTES;

/// What came of one batch on arrival.
#[derive(Debug, PartialEq, Eq)]
pub enum Arrived {
    /// What was new waits to be kept.
    Taken,
    /// Nothing in it was new: say again what is durable, or the robot sends it for ever.
    Known,
    /// Tell the robot to send again from here.
    Expect(LaneAck),
    /// More than its credit is under way.
    OverCredit,
}

/// What is to be kept together. Written twice after a failure, it says the same twice.
#[derive(Debug, Default)]
pub struct Write {
    /// Samples, in order.
    pub frames: Vec<Frame>,
    /// What will never come.
    pub gaps: Vec<Gap>,
}

impl Write {
    /// What its frames weigh.
    pub fn bytes(&self) -> usize {
        self.frames.iter().map(|frame| frame.bytes.len()).sum()
    }
    /// Up to which number all is durable once it is kept.
    pub fn last_seq(&self) -> u64 {
        self.frames.last().map_or(0, |frame| frame.last_seq)
    }
    /// Leaves out all up to a number that is known.
    pub fn leave_out(&mut self, seq: u64) {
        self.frames.retain_mut(|frame| {
            if frame.first_seq <= seq
                && let Ok(mut wire) = v1::LaneBatch::decode(&*frame.bytes)
            {
                frame.first_seq = seq + 1;
                leave_out(&mut wire, seq);
                frame.bytes = Arc::from(wire.encode_to_vec());
            }
            frame.first_seq <= frame.last_seq
        });
        self.gaps.retain_mut(|gap| {
            gap.from_seq = gap.from_seq.max(seq + 1);
            gap.from_seq <= gap.to_seq
        });
    }
}

fn leave_out(wire: &mut v1::LaneBatch, seq: u64) {
    wire.samples.retain(|sample| sample.seq > seq);
    wire.gaps.retain_mut(|gap| {
        gap.from_seq = gap.from_seq.max(seq + 1);
        gap.from_seq <= gap.to_seq
    });
}

/// The STATUS lane of one ring.
pub struct StatusLane {
    robot_id: RobotId,
    ring: Arc<str>,
    taken: u64,
    durable: u64,
    acked: u64,
    /// Of what was taken since what was acknowledged.
    unacked_bytes: usize,
    waiting: Write,
    /// Of what waits and of what is being written.
    unkept_bytes: usize,
    /// Since when there is something to acknowledge, or to look for it.
    owed_since: Instant,
}

/// First and last number of an item.
pub fn numbers(item: &InboxItem) -> (u64, u64) {
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
            waiting: Write::default(),
            unkept_bytes: 0,
            owed_since: Instant::now(),
        }
    }
    /// Takes a batch that came at `now`, UTC of the wall.
    pub fn arrive(&mut self, batch: &LaneBatch, now: Utc) -> Arrived {
        let (mut first, mut taken, mut gaps) = (None, self.taken, Vec::new());
        for item in &batch.items {
            let (from, to) = numbers(item);
            if to <= taken {
                continue;
            }
            if from > taken + 1 {
                let ack = LaneAck { lane: Lane::Status, seq: self.durable, expect: Some(self.taken + 1) };
                return Arrived::Expect(ack);
            }
            let from = from.max(taken + 1);
            first.get_or_insert(from);
            taken = to;
            if let InboxItem::Gap(gap) = item {
                gaps.push(self.gap(from, to, &gap.reason, now));
            }
        }
        let Some(first_seq) = first else { return Arrived::Known };
        let mut wire = v1::LaneBatch::from(batch);
        leave_out(&mut wire, self.taken);
        coarsen_late(&mut wire, now);
        let bytes = wire.encode_to_vec();
        if self.unkept_bytes + bytes.len() > WAITING_BYTES_MAX {
            return Arrived::OverCredit;
        }
        if self.taken == self.acked {
            self.owed_since = Instant::now();
        }
        self.taken = taken;
        self.unacked_bytes += bytes.len();
        self.unkept_bytes += bytes.len();
        let (robot_id, ring) = (self.robot_id.clone(), self.ring.clone());
        self.waiting.frames.push(Frame { robot_id, ring, first_seq, last_seq: taken, bytes: Arc::from(bytes) });
        self.waiting.gaps.extend(gaps);
        Arrived::Taken
    }
    /// Samples are kept up to here, some of them perhaps by the session before this one after this one had begun.
    pub fn learn(&mut self, durable: u64) {
        if durable > self.taken {
            (self.taken, self.durable) = (durable, durable);
        }
    }
    /// Whether all up to this number is durable.
    pub fn is_kept(&self, seq: u64) -> bool {
        self.durable >= seq
    }
    fn gap(&self, from_seq: u64, to_seq: u64, reason: &Reason, now: Utc) -> Gap {
        Gap {
            robot_id: self.robot_id.clone(),
            ring: self.ring.clone(),
            lane: Arc::from("STATUS"),
            from_seq,
            to_seq,
            reason: Arc::from(reason.name()),
            at_unix_ms: now.0,
        }
    }
    /// What is to be kept next; none if nothing waits.
    pub fn next_write(&mut self) -> Option<Write> {
        (!self.waiting.frames.is_empty()).then(|| std::mem::take(&mut self.waiting))
    }
    /// What was written is durable up to here.
    pub fn kept(&mut self, seq: u64) {
        self.durable = self.durable.max(seq);
        self.unkept_bytes = self.waiting.bytes();
    }
    /// Half of the credit is spent: the robot should not wait for an echo.
    pub fn is_half_spent(&self) -> bool {
        self.unacked_bytes * 2 >= limits::STATUS_IN_FLIGHT_BYTES
    }
    /// It is not: everything since the durable number must come again.
    pub fn lost(&mut self) -> LaneAck {
        (self.taken, self.acked) = (self.durable, self.durable);
        self.waiting = Write::default();
        (self.unkept_bytes, self.unacked_bytes) = (0, 0);
        LaneAck { lane: Lane::Status, seq: self.durable, expect: Some(self.durable + 1) }
    }
    /// Something waits behind what is being kept.
    pub fn has_more(&self) -> bool {
        !self.waiting.frames.is_empty()
    }
    /// Something is durable that was not acknowledged.
    pub fn has_ack(&self) -> bool {
        self.durable > self.acked
    }
    /// There is something to acknowledge beside an echo that leaves now.
    pub fn goes_with_echo(&self) -> bool {
        self.has_ack() && self.owed_since.elapsed() >= ACK_AFTER
    }
    /// When to look for something to acknowledge that no echo took along; none: nothing was taken since.
    pub fn ack_at(&self) -> Option<Instant> {
        (self.taken > self.acked).then_some(self.owed_since + ACK_WITHIN)
    }
    /// Nothing was durable when it was looked for.
    pub fn look_later(&mut self) {
        self.owed_since = Instant::now();
    }
    /// What is durable, as it is acknowledged now.
    pub fn ack(&mut self) -> LaneAck {
        self.acked = self.durable;
        self.unacked_bytes = self.unkept_bytes;
        self.owed_since = Instant::now();
        LaneAck { lane: Lane::Status, seq: self.durable, expect: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::reason::Code;
    use midshift_core::robot::Vitals;
    use midshift_core::robot_events::{Gap as Announced, Sample, SampleBody};

    const NOW: Utc = Utc(7);

    type Ranges = Vec<(u64, u64)>;

    fn lane() -> StatusLane {
        StatusLane::new(RobotId::parse("r1").expect("an id"), Arc::from("ring"), 0)
    }
    fn sample(seq: u64) -> InboxItem {
        InboxItem::Sample(Sample { seq, robot_unix_ms: 0, body: SampleBody::Status(Vitals::default()) })
    }
    fn gap(from_seq: u64, to_seq: u64) -> InboxItem {
        InboxItem::Gap(Announced { lane: Lane::Status, from_seq, to_seq, reason: Code::Overflow.into() })
    }
    fn arrive(lane: &mut StatusLane, items: Vec<InboxItem>) -> Arrived {
        lane.arrive(&LaneBatch { lane: Lane::Status, items }, NOW)
    }
    fn ranges(write: &Write) -> (Ranges, Ranges) {
        let frames = write.frames.iter().map(|f| (f.first_seq, f.last_seq));
        (frames.collect(), write.gaps.iter().map(|g| (g.from_seq, g.to_seq)).collect())
    }

    #[tokio::test]
    async fn nothing_of_a_batch_with_a_hole_is_taken() {
        let mut lane = lane();
        let asked = LaneAck { lane: Lane::Status, seq: 0, expect: Some(1) };
        assert_eq!(arrive(&mut lane, vec![sample(1), sample(3)]), Arrived::Expect(asked));
        assert!(lane.next_write().is_none());
        assert_eq!(arrive(&mut lane, vec![sample(1), sample(2), sample(3)]), Arrived::Taken);
        assert_eq!(lane.next_write().as_ref().map(ranges), Some((vec![(1, 3)], vec![])));
    }

    #[tokio::test]
    async fn what_the_session_before_kept_after_this_one_began_is_no_hole() {
        let mut lane = lane();
        assert!(matches!(arrive(&mut lane, vec![sample(6)]), Arrived::Expect(_)));
        lane.learn(5);
        lane.learn(4);
        assert_eq!(arrive(&mut lane, vec![sample(4), sample(5), sample(6)]), Arrived::Taken);
        assert_eq!(lane.next_write().as_ref().map(ranges), Some((vec![(6, 6)], vec![])));
        assert!(lane.is_kept(5) && !lane.is_kept(6));
        assert_eq!(arrive(&mut lane, vec![sample(5)]), Arrived::Known);
        // It was not told of an older write that ended late.
        lane.kept(3);
        assert_eq!(lane.ack().seq, 5);
    }

    #[tokio::test]
    async fn a_sample_that_comes_a_day_late_is_kept_coarse_and_a_fresh_one_as_it_came() {
        let now = Utc(1_800_000_000_000);
        let pose = Some(midshift_core::robot::Pose { x_mm: 12_345, y_mm: -1, theta_mrad: 7 });
        let at = |seq, age_ms: u64| {
            let body = SampleBody::Status(Vitals { pose, ..Vitals::default() });
            InboxItem::Sample(Sample { seq, robot_unix_ms: now.0.saturating_sub_unsigned(age_ms), body })
        };
        let (day, mut lane) = (midshift_core::privacy::PRECISE_MS, lane());
        let batch = LaneBatch { lane: Lane::Status, items: vec![at(1, day), at(2, day - 1)] };
        assert_eq!(lane.arrive(&batch, now), Arrived::Taken);
        let write = lane.next_write().expect("something waits");
        let kept = v1::LaneBatch::decode(&*write.frames[0].bytes).expect("a batch");
        let headings = kept.samples.iter().map(|sample| match &sample.body {
            Some(v1::sample::Body::Status(vitals)) => vitals.pose.map(|pose| (pose.x_mm, pose.theta_mrad)),
            _ => None,
        });
        assert_eq!(headings.collect::<Vec<_>>(), [Some((12_500, 0)), Some((12_345, 7))]);
    }

    #[tokio::test]
    async fn a_gap_is_kept_from_where_nothing_was_taken() {
        let mut lane = lane();
        assert_eq!(arrive(&mut lane, vec![sample(1), sample(2)]), Arrived::Taken);
        assert_eq!(arrive(&mut lane, vec![gap(1, 5), sample(6)]), Arrived::Taken);
        assert_eq!(lane.next_write().as_ref().map(ranges), Some((vec![(1, 2), (3, 6)], vec![(3, 5)])));
    }
}
