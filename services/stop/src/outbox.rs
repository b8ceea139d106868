//! What waits for one robot to read it.
//!
//! Invariant: bounded, and whoever puts something in never waits. A robot that reads too slowly is told everything anew from the latch when it reads again, so that
//! nothing is lost by leaving messages out. An answer to a check-in never overtakes what it speaks of.

use crate::engaged::EngagedStops;
use crate::frames;
use crate::proof::Key;
use crate::threads::lock;
use bytes::Bytes;
use midshift_core::ids::StopId;
use midshift_core::limits;
use midshift_core::reason::Refusal;
use midshift_core::time::{LinkDuration, LinkTime};
use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use tokio_util::sync::CancellationToken;
use tonic::Status;

/// One message of stops and resets, for all robots.
#[derive(Clone)]
pub struct Frame {
    /// State of the latch with it.
    pub generation: u64,
    /// The message as it is sent, encoded.
    pub bytes: Bytes,
    /// What it resets, so that it can be said again.
    pub resets: Arc<[StopId]>,
}

/// Why a line ends.
#[derive(Clone, Debug)]
pub enum End {
    /// In order.
    Done,
    /// For a reason that the robot hears.
    Refused(Refusal),
}

struct Waiting {
    frames: VecDeque<Frame>,
    /// Bytes to send before anything else: the whole, as it was when it was begun to be said.
    whole: VecDeque<Bytes>,
    /// Some: everything is to be said anew, with these resets.
    behind: Option<BTreeSet<StopId>>,
    /// State of the latch that was handed to the connection.
    sent: u64,
    answers: VecDeque<(u64, u64)>,
    moves_over: bool,
    unread_since: Option<LinkTime>,
    end: Option<End>,
    waker: Option<Waker>,
}

/// The outbox of one line.
pub struct Outbox {
    waiting: Mutex<Waiting>,
    /// The line is over.
    pub gone: CancellationToken,
}

impl Outbox {
    /// Of a robot that keeps these stops: of those that were reset it hears so.
    pub fn new(listed: BTreeSet<StopId>) -> Self {
        let waiting = Waiting {
            frames: VecDeque::new(),
            whole: VecDeque::new(),
            behind: Some(listed),
            sent: 0,
            answers: VecDeque::new(),
            moves_over: false,
            unread_since: None,
            end: None,
            waker: None,
        };
        Self { waiting: Mutex::new(waiting), gone: CancellationToken::new() }
    }

    fn change_waiting(&self, now: LinkTime, change: impl FnOnce(&mut Waiting)) {
        let mut waiting = lock(&self.waiting);
        change(&mut waiting);
        waiting.unread_since.get_or_insert(now);
        let waker = waiting.waker.take();
        drop(waiting);
        if let Some(waker) = waker {
            waker.wake();
        }
    }

    /// A change of the latch.
    pub fn add_change(&self, frame: &Frame, now: LinkTime) {
        self.change_waiting(now, |waiting| {
            if waiting.behind.is_none() && waiting.frames.len() < limits::STOP_OUTBOX_MAX {
                return waiting.frames.push_back(frame.clone());
            }
            // Too much for it: it is told from the latch when it reads again. What it was told to forget is in no list of what is engaged.
            let left: Vec<Frame> = waiting.frames.drain(..).collect();
            let behind = waiting.behind.get_or_insert_default();
            behind.extend(left.iter().chain([frame]).flat_map(|frame| frame.resets.iter().cloned()));
        });
    }

    /// The answer to a check-in that came when the latch was at `generation`.
    pub fn answer(&self, nonce: u64, generation: u64, now: LinkTime) {
        self.change_waiting(now, |waiting| {
            if waiting.answers.len() >= limits::STOP_ANSWERS_MAX {
                waiting.answers.pop_front();
            }
            // An answer waits for a change that nobody put in: it is said from the latch.
            let is_held = waiting.answers.front().is_some_and(|(_, generation)| *generation > waiting.sent);
            if is_held && waiting.frames.is_empty() && waiting.whole.is_empty() {
                waiting.behind.get_or_insert_default();
            }
            waiting.answers.push_back((nonce, generation));
        });
    }

    /// The robot is to dial again.
    pub fn move_over(&self, now: LinkTime) {
        self.change_waiting(now, |waiting| waiting.moves_over = true);
    }

    /// The robot is to dial again, and this line ends when it has read what waits for it.
    pub fn finish(&self, now: LinkTime) {
        self.change_waiting(now, |waiting| {
            waiting.moves_over = true;
            waiting.end.get_or_insert(End::Done);
        });
        self.gone.cancel();
    }

    /// Ends the line.
    pub fn end(&self, end: End, now: LinkTime) {
        self.change_waiting(now, |waiting| {
            waiting.frames.clear();
            waiting.whole.clear();
            waiting.answers.clear();
            waiting.behind = None;
            waiting.end.get_or_insert(end);
        });
        self.gone.cancel();
    }

    /// State of the latch that this robot was told on this line.
    pub fn sent(&self) -> u64 {
        lock(&self.waiting).sent
    }

    /// For how long something has waited to be read.
    pub fn unread_for(&self, now: LinkTime) -> LinkDuration {
        lock(&self.waiting).unread_since.map_or(LinkDuration(0), |since| now.since(since))
    }

    /// What the connection sends next: of a robot that is behind, from the latch. Whoever puts something in later wakes it.
    pub fn poll_next(
        &self,
        engaged_stops: &Mutex<EngagedStops>,
        key: &Key,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Bytes, Status>>> {
        let mut waiting = lock(&self.waiting);
        if let Some(bytes) = waiting.next(engaged_stops, key) {
            return Poll::Ready(Some(Ok(bytes)));
        }
        // The connection takes more than there is.
        waiting.unread_since = None;
        match waiting.end.take() {
            Some(End::Done) => Poll::Ready(None),
            Some(End::Refused(refusal)) => Poll::Ready(Some(Err(midshift_proto::status(&refusal, None)))),
            None => {
                waiting.waker = Some(cx.waker().clone());
                Poll::Pending
            }
        }
    }

    #[cfg(test)]
    fn held(&self) -> (usize, usize) {
        let waiting = lock(&self.waiting);
        (waiting.frames.len() + waiting.whole.len(), waiting.answers.len())
    }
}

impl Waiting {
    fn next(&mut self, engaged_stops: &Mutex<EngagedStops>, key: &Key) -> Option<Bytes> {
        if let Some(bytes) = self.whole.pop_front() {
            return Some(bytes);
        }
        if let Some(resets) = self.behind.take() {
            let mut engaged_stops = lock(engaged_stops);
            self.whole.extend(engaged_stops.everything().iter().cloned());
            let resets = resets.iter().filter_map(|id| engaged_stops.latch().reset_of(id));
            self.whole.extend(frames::encode_changes([], resets, 0));
            self.sent = engaged_stops.generation();
            self.whole.push_back(frames::synced(self.sent, &key.public()));
            return self.whole.pop_front();
        }
        while let Some(frame) = self.frames.pop_front() {
            // A stop that was said with the whole needs not be said again. A reset may not be in it: the whole is what is engaged.
            if frame.generation > self.sent || !frame.resets.is_empty() {
                self.sent = self.sent.max(frame.generation);
                return Some(frame.bytes);
            }
        }
        if let Some((nonce, _)) = self.answers.pop_front_if(|(_, generation)| *generation <= self.sent) {
            return Some(frames::check_in_answer(nonce, self.sent));
        }
        std::mem::take(&mut self.moves_over).then(frames::move_over)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::changes::{self, Wanted};
    use crate::{Parts, StopService};
    use midshift_core::identity::Caller;
    use midshift_core::robot::StopLevel;
    use midshift_core::stop::Scope;
    use midshift_core::time::{ScaledClock, Utc};

    fn frame(generation: u64, reset: Option<&str>) -> Frame {
        let resets = reset.map(|id| StopId::parse(id).unwrap()).into_iter().collect();
        Frame { generation, bytes: Bytes::from(generation.to_string()), resets }
    }

    #[test]
    fn a_robot_that_reads_nothing_holds_a_bounded_number_and_hears_of_every_reset_later() {
        let outbox = Outbox::new(BTreeSet::new());
        lock(&outbox.waiting).behind = None;
        for n in 1..100_u64 {
            outbox.add_change(&frame(n, Some(&format!("STOP-{n}"))), LinkTime(5));
            outbox.answer(n, n, LinkTime(5));
            let (frames, answers) = outbox.held();
            assert!(frames <= limits::STOP_OUTBOX_MAX && answers <= limits::STOP_ANSWERS_MAX);
        }
        let waiting = lock(&outbox.waiting);
        assert_eq!(waiting.behind.as_ref().map(BTreeSet::len), Some(99));
        assert_eq!(waiting.answers.back(), Some(&(99, 99)), "the newest answer is kept");
        drop(waiting);
        assert_eq!(outbox.unread_for(LinkTime(10_005)), limits::STOP_LINE_SILENT);
    }

    #[test]
    fn a_robot_that_was_told_the_whole_before_a_reset_was_put_in_hears_of_the_reset_all_the_same() {
        let folder = tempfile::tempdir().unwrap();
        let clock = Arc::new(ScaledClock::new(|| 0, Utc(1_000), 1000));
        let parts = Parts { folder: folder.path().join("stop"), site: None, clock };
        let inner = StopService::open(parts, CancellationToken::new()).unwrap().inner;
        let wanted = Wanted {
            scope: Scope::Fleet,
            level: StopLevel::Halt,
            reason: String::new(),
            request: None,
            actor: "anna".into(),
        };
        let stop_id = changes::engage(&inner, wanted).unwrap().stop.stop_id;
        let outbox = Outbox::new(BTreeSet::new());
        let heard = || -> Vec<Bytes> {
            std::iter::from_fn(|| lock(&outbox.waiting).next(&inner.engaged_stops, &inner.key)).collect()
        };
        heard();
        let resetting =
            changes::reset(&inner, stop_id, "over".to_owned(), &Caller::local()).expect("nobody is asked here");
        // The latch has it; the lines are told one after the other, and this one checks in twice before its turn.
        let (reset, generation) = lock(&inner.engaged_stops).settle(resetting.version, Utc(1_000)).remove(0);
        outbox.answer(1, generation, LinkTime(5));
        outbox.answer(2, generation, LinkTime(5));
        let synced = frames::synced(generation, &inner.key.public());
        assert!(heard().contains(&synced), "it is told the whole");
        let bytes = frames::encode_changes([], [&reset], generation).remove(0);
        outbox.add_change(&Frame { generation, bytes: bytes.clone(), resets: [reset.stop_id].into() }, LinkTime(5));
        assert_eq!(heard(), [bytes]);
    }
}
