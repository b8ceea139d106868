//! EVENT and CRITICAL of one session: numbers are checked on arrival, kept in one item with their mark, acknowledged after its commit.
//!
//! Laws: a batch is taken iff its first number is at most one past the last; a known prefix is dropped; a hole is answered with `expect`; an
//! acknowledgement leaves only after the commit; a poison sample is recorded, acknowledged and skipped; what finds no room
//! to wait is passed over, and asked for again once there is some.

use crate::bugs::Bugs;
use crate::inner::Inner;
use midshift_core::ids::RobotId;
use midshift_core::item::{Expect, Fact, Item};
use midshift_core::robot::Lane;
use midshift_core::robot_events::{InboxEntry, InboxItem};
use midshift_core::rows::{Log, Revision, Writer};
use midshift_core::session::LaneMark;
use midshift_core::time::Utc;
use midshift_proto::session::{LaneAck, LaneBatch};
use midshift_store::{CommitError, load};
use std::collections::VecDeque;
use std::sync::Arc;

/// Facts that wait for the commit under way or for their rate; what comes beyond is asked for again once half of them are kept.
const WAITING_MAX: usize = 1_024;
/// Facts of one item.
const FACTS_PER_ITEM: usize = 200;

/// What came of one batch on arrival.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Arrived {
    /// Tell the robot to send again from here.
    pub expect: Option<LaneAck>,
    /// Everything was known already: say again what is durable.
    pub known: bool,
}

/// The two lanes of one ring.
#[derive(Debug)]
pub struct Events {
    durable: LaneMark,
    revision: Revision,
    /// Highest numbers taken, durable or not.
    taken: [u64; 2],
    waiting: VecDeque<InboxEntry>,
    /// Of which lanes something found no room to wait: the rest of it is passed over until it is asked for again.
    owed: [bool; 2],
}

fn index(lane: Lane) -> Option<usize> {
    match lane {
        Lane::Critical => Some(0),
        Lane::Event => Some(1),
        Lane::Status => None,
    }
}

fn numbers(item: &InboxItem) -> (u64, u64) {
    match item {
        InboxItem::Sample(sample) => (sample.seq, sample.seq),
        InboxItem::Poison { seq, .. } => (*seq, *seq),
        InboxItem::Gap(gap) => (gap.from_seq, gap.to_seq),
    }
}

/// One item on its way to the store.
pub struct Batch {
    mark: LaneMark,
    item: Item,
}

impl Events {
    /// From what is durable.
    pub fn new(durable: LaneMark, revision: Revision) -> Self {
        let taken = [durable.critical, durable.event];
        Self { taken, durable, revision, waiting: VecDeque::new(), owed: [false; 2] }
    }
    /// Durable numbers as acknowledgements.
    pub fn acks(&self) -> [LaneAck; 2] {
        [(Lane::Critical, self.durable.critical), (Lane::Event, self.durable.event)].map(|(lane, seq)| LaneAck {
            lane,
            seq,
            expect: None,
        })
    }
    /// Numbers taken, as a naive server would acknowledge them.
    pub fn taken(&self) -> [LaneAck; 2] {
        [(Lane::Critical, self.taken[0]), (Lane::Event, self.taken[1])].map(|(lane, seq)| LaneAck {
            lane,
            seq,
            expect: None,
        })
    }
    /// Takes a batch of one lane.
    pub fn arrive(&mut self, batch: LaneBatch, bugs: Bugs, entry: impl Fn(InboxItem) -> InboxEntry) -> Arrived {
        let Some(at) = index(batch.lane) else { return Arrived::default() };
        let mut known = true;
        for item in batch.items {
            let (first, last) = numbers(&item);
            if last <= self.taken[at] {
                continue;
            }
            known = false;
            self.owed[at] |= self.waiting.len() >= WAITING_MAX;
            if self.owed[at] {
                break;
            }
            if first > self.taken[at] + 1 && !bugs.holes_are_taken() {
                return Arrived { expect: Some(self.expect(at)), known };
            }
            self.taken[at] = last;
            self.waiting.push_back(entry(item));
        }
        Arrived { expect: None, known }
    }
    /// The robot is to send a lane again from behind what was taken.
    fn expect(&self, at: usize) -> LaneAck {
        metrics::counter!("midshift_telemetry_expects_total").increment(1);
        let [critical, event] = self.acks();
        LaneAck { expect: Some(self.taken[at] + 1), ..if at == 0 { critical } else { event } }
    }
    /// What is asked for again, now that there is room for it: a robot that is asked sooner sends in vain.
    pub fn ask_again(&mut self) -> Vec<LaneAck> {
        if self.owed == [false; 2] || self.waiting.len() > WAITING_MAX / 2 {
            return Vec::new();
        }
        let owed = std::mem::take(&mut self.owed);
        (0..owed.len()).filter(|at| owed[*at]).map(|at| self.expect(at)).collect()
    }
    /// Facts that wait for a commit.
    pub fn waiting(&self) -> usize {
        self.waiting.len()
    }
    /// The next item to commit, of `allowed` facts at most, at this moment of the wall; none if nothing waits or is allowed.
    pub fn next_batch(&mut self, robot_id: &RobotId, wall: Utc, allowed: usize) -> Option<Batch> {
        let many = self.waiting.len().min(FACTS_PER_ITEM).min(allowed);
        if many == 0 {
            return None;
        }
        let mut mark = LaneMark { at_unix_ms: wall.0, ..self.durable.clone() };
        let mut item = Item::new(Writer::Telemetry, robot_id.as_str());
        for entry in self.waiting.drain(..many) {
            let (_, last) = numbers(&entry.what);
            match entry.lane {
                Lane::Critical => mark.critical = last,
                _ => mark.event = last,
            }
            item.facts.push(fact(robot_id, &entry));
        }
        let expect = if self.revision == Revision(0) { Expect::Absent } else { Expect::At(self.revision) };
        item.put_row(&mark, expect, "lane.durable");
        Some(Batch { mark, item })
    }
    /// The batch is durable.
    pub fn done(&mut self, mark: LaneMark) {
        self.durable = mark;
        self.revision = self.revision.next();
    }
    /// Nobody can say what became of the batch: everything since the durable numbers must come again.
    pub fn forget_taken(&mut self) {
        *self = Self::new(self.durable.clone(), self.revision);
    }
    /// The batch is not: go on from what the store has, and ask for the rest again.
    pub fn reset(&mut self, durable: LaneMark, revision: Revision) -> [LaneAck; 2] {
        *self = Self::new(durable, revision);
        self.acks().map(|ack| LaneAck { expect: Some(ack.seq + 1), ..ack })
    }
}

fn fact(robot_id: &RobotId, entry: &InboxEntry) -> Fact {
    let kind = match (&entry.what, entry.lane) {
        (InboxItem::Gap(_), _) => "robot.gap",
        (InboxItem::Poison { .. }, _) => "robot.poison",
        (InboxItem::Sample(_), Lane::Critical) => "robot.critical",
        (InboxItem::Sample(_), _) => "robot.event",
    };
    metrics::counter!("midshift_telemetry_facts_total", "kind" => kind).increment(1);
    Fact { log: Log::RobotInbox, subject: Arc::from(robot_id.as_str()), kind, body: entry.text() }
}

/// What came of a commit.
pub enum Outcome {
    /// Durable: so many facts, up to these numbers.
    Done(LaneMark, usize),
    /// Not, or nobody knows: this is what the store has.
    Again(LaneMark, Revision),
    /// The store does not answer.
    Lost,
}

/// Commits a batch; after any failure reads what the store has, since every error is an unknown outcome.
pub async fn commit(inner: Arc<Inner>, batch: Batch) -> Outcome {
    let id = midshift_core::rows::Record::id(&batch.mark);
    let facts = batch.item.facts.len();
    match inner.parts.store.commit(vec![batch.item]).await.pop() {
        Some(Ok(_)) => return Outcome::Done(batch.mark, facts),
        Some(Err(CommitError::Conflict { .. })) => {}
        Some(Err(error)) => tracing::warn!(%error, "robot events were not stored"),
        None => {}
    }
    match load::<LaneMark>(inner.parts.store.as_ref(), &id).await {
        Ok(Some((mark, revision))) => Outcome::Again(mark, revision),
        Ok(None) => Outcome::Again(LaneMark { critical: 0, event: 0, ..batch.mark }, Revision(0)),
        Err(_) => Outcome::Lost,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::reason::Code;
    use midshift_core::robot::Mode;
    use midshift_core::robot_events::{Gap, RobotEvent, Sample, SampleBody};

    fn robot() -> RobotId {
        RobotId::parse("r1").expect("a valid id")
    }
    fn fresh() -> Events {
        let mark = LaneMark::fresh(robot(), "ring");
        Events::new(mark, Revision(0))
    }
    fn sample(seq: u64) -> InboxItem {
        let body = SampleBody::Event(RobotEvent::Mode(Mode::Automatic));
        InboxItem::Sample(Sample { seq, robot_unix_ms: 0, body })
    }
    fn gap(from_seq: u64, to_seq: u64) -> InboxItem {
        InboxItem::Gap(Gap { lane: Lane::Event, from_seq, to_seq, reason: Code::Overflow.into() })
    }
    fn arrive(events: &mut Events, items: Vec<InboxItem>) -> Arrived {
        let entry = |what| InboxEntry {
            robot_id: robot(),
            session_epoch: 1,
            ring: "ring".into(),
            lane: Lane::Event,
            what,
            stamp_in_future: false,
        };
        events.arrive(LaneBatch { lane: Lane::Event, items }, Bugs::default(), entry)
    }
    fn stored(events: &mut Events) -> usize {
        events.next_batch(&robot(), Utc(0), usize::MAX).map_or(0, |batch| {
            let facts = batch.item.facts.len();
            events.done(batch.mark);
            facts
        })
    }

    #[test]
    fn a_known_prefix_is_dropped_and_nothing_is_stored_twice() {
        let mut events = fresh();
        assert_eq!(arrive(&mut events, vec![sample(1), sample(2)]), Arrived::default());
        assert_eq!(arrive(&mut events, vec![sample(1), sample(2), sample(3)]), Arrived::default());
        assert_eq!(stored(&mut events), 3);
        assert_eq!(events.acks()[1].seq, 3);
        assert!(arrive(&mut events, vec![sample(2), sample(3)]).known);
        assert_eq!(stored(&mut events), 0);
    }

    #[test]
    fn a_hole_is_asked_for_and_what_lies_behind_it_is_not_taken() {
        let mut events = fresh();
        let arrived = arrive(&mut events, vec![sample(1), sample(3)]);
        assert_eq!(arrived.expect, Some(LaneAck { lane: Lane::Event, seq: 0, expect: Some(2) }));
        assert_eq!(stored(&mut events), 1);
        assert_eq!(arrive(&mut events, vec![gap(2, 5), sample(6)]).expect, None);
        assert_eq!(stored(&mut events), 2);
        assert_eq!(events.acks()[1].seq, 6);
    }

    #[test]
    fn nothing_is_acknowledged_before_its_commit_and_a_lost_one_is_asked_for_again() {
        let mut events = fresh();
        arrive(&mut events, vec![sample(1), sample(2)]);
        let batch = events.next_batch(&robot(), Utc(0), usize::MAX).expect("two samples wait");
        assert_eq!(events.acks()[1].seq, 0);
        drop(batch);
        events.forget_taken();
        assert_eq!(arrive(&mut events, vec![sample(1), sample(2)]).expect, None);
        assert_eq!(stored(&mut events), 2);
        let asked = events.reset(LaneMark { event: 1, ..LaneMark::fresh(robot(), "ring") }, Revision(1));
        assert_eq!(asked[1], LaneAck { lane: Lane::Event, seq: 1, expect: Some(2) });
    }

    #[test]
    fn a_flood_is_bounded_and_asked_for_again_once_there_is_room() {
        let mut events = fresh();
        let first = WAITING_MAX as u64 + 1;
        arrive(&mut events, (1..=first).map(sample).collect());
        // Said at once it would be sent again at once, in vain.
        assert_eq!(arrive(&mut events, vec![sample(first), sample(first + 1)]), Arrived::default());
        while events.waiting() > WAITING_MAX / 2 {
            assert_eq!((events.waiting().min(FACTS_PER_ITEM), events.ask_again()), (FACTS_PER_ITEM, vec![]));
            assert_eq!(stored(&mut events), FACTS_PER_ITEM);
        }
        let asked = events.ask_again();
        let seq = events.acks()[1].seq;
        assert_eq!(asked, [LaneAck { lane: Lane::Event, seq, expect: Some(first) }]);
        assert!(events.ask_again().is_empty(), "once");
        arrive(&mut events, (first..first + 10).map(sample).collect());
        while stored(&mut events) > 0 {}
        assert_eq!(events.acks()[1].seq, first + 9);
    }

    #[test]
    fn no_more_is_kept_at_once_than_is_allowed() {
        let mut events = fresh();
        arrive(&mut events, (1..=9).map(sample).collect());
        assert!(events.next_batch(&robot(), Utc(0), 0).is_none());
        let batch = events.next_batch(&robot(), Utc(0), 4).expect("some are allowed");
        assert_eq!((batch.item.facts.len(), batch.mark.event, events.waiting()), (4, 4, 5));
    }
}
