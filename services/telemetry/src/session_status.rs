//! STATUS of a session: taken, handed to the writer that all sessions share, and acknowledged once it is kept.
//!
//! Invariant: nothing is acknowledged, and no replay answered, before it is durable; a session is not woken by its writes unless somebody waits.

use crate::registry::Replay;
use crate::replay::overloaded;
use crate::session::{End, Session, close};
use crate::status::{self, Arrived};
use crate::waits::Keeping;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::robot::Lane;
use midshift_core::time::LinkDuration;
use midshift_proto::session::{CloseCode, LaneAck, LaneBatch};
use std::sync::atomic::Ordering::Relaxed;
use tokio::sync::oneshot::error::TryRecvError;
use tracing::field::Empty;

impl Session {
    /// STATUS that came on the session.
    pub(crate) fn status(&mut self, batch: &LaneBatch) -> Option<End> {
        self.in_charge.as_ref()?;
        match self.arrive(batch) {
            Arrived::Taken if self.inner.parts.bugs.status_ack_before_write() => {
                let seq = batch.items.iter().map(|item| status::numbers(item).1).max().unwrap_or(0);
                self.change_out(|out| out.acks.push(LaneAck { lane: Lane::Status, seq, expect: None }));
            }
            Arrived::Taken => {}
            Arrived::Known => self.ack_status(),
            Arrived::Expect(ack) => self.change_out(|out| out.acks.push(ack)),
            Arrived::OverCredit => {
                tracing::warn!(peer = Empty, robot_id = %self.robot_id, "session ended by status beyond its credit");
                return Some(close(CloseCode::TooSlow, Code::Overloaded, LinkDuration(1_000)));
            }
        }
        None
    }

    fn arrive(&mut self, batch: &LaneBatch) -> Arrived {
        // The session before this one may have kept more since the Welcome was made: neither a hole nor to be kept again.
        self.status.learn(self.status_mark.load(Relaxed));
        self.status.arrive(batch, self.inner.parts.clock.now().wall)
    }

    /// Old STATUS that came over bulk: the same lane, the same rules, and another way for the answer.
    pub(crate) fn replay(&mut self, replay: Replay) {
        let last = replay.batch.items.iter().map(|item| status::numbers(item).1).max().unwrap_or(0);
        // Whoever asked may have stopped waiting; what was taken is kept all the same.
        match self.arrive(&replay.batch) {
            Arrived::Taken | Arrived::Known if !self.status.is_kept(last) => {
                self.replaying = Some((last, replay.answer));
            }
            Arrived::Taken | Arrived::Known => drop(replay.answer.send(Ok(self.status.ack()))),
            Arrived::Expect(ack) => drop(replay.answer.send(Ok(ack))),
            Arrived::OverCredit => drop(replay.answer.send(Err(overloaded()))),
        }
    }

    /// Hands over what waits to be kept, one write at a time.
    pub(crate) fn keep_status(&mut self) {
        self.look_for_kept();
        if self.keeping.is_none()
            && let Some(write) = self.status.next_write()
        {
            let last_seq = write.last_seq();
            let written = self.inner.status_writer.queue(write, self.status_mark.clone());
            self.keeping = Some(Keeping { last_seq, is_hurried: false, written });
        }
        if self.is_urgent()
            && let Some(keeping) = self.keeping.as_mut().filter(|keeping| !keeping.is_hurried)
        {
            keeping.is_hurried = true;
            self.inner.status_writer.hurry();
        }
    }

    /// Somebody waits for what is being kept: the robot for its credit, a replay, or another gateway that will look how far this session came.
    fn is_urgent(&self) -> bool {
        let is_moving = self.in_charge.as_ref().is_some_and(|in_charge| in_charge.moving.load(Relaxed));
        self.replaying.is_some() || self.status.is_half_spent() || is_moving
    }

    /// Whether to be woken when it is kept; else it is enough to look when there is something else to do.
    pub(crate) fn awaits_kept(&self) -> bool {
        self.keeping.is_some() && (self.is_urgent() || self.status.has_more())
    }

    fn look_for_kept(&mut self) {
        let written = self.keeping.as_mut().map(|keeping| keeping.written.try_recv());
        match written {
            None | Some(Err(TryRecvError::Empty)) => {}
            Some(written) => self.status_written(written.unwrap_or_default()),
        }
    }

    /// What was handed over is kept, or is not.
    pub(crate) fn status_written(&mut self, is_kept: bool) {
        let Some(Keeping { last_seq, .. }) = self.keeping.take() else { return };
        if is_kept {
            self.status.kept(last_seq);
            if let Some((_, answer)) = self.replaying.take_if(|(last, _)| self.status.is_kept(*last)) {
                drop(answer.send(Ok(self.status.ack())));
            } else if self.status.is_half_spent() {
                self.ack_status();
            }
        } else {
            let ack = self.status.lost();
            if let Some((_, answer)) = self.replaying.take() {
                drop(answer.send(Err(Refusal::new(Kind::Unavailable, Code::StoreUnavailable))));
            }
            self.change_out(|out| out.acks.push(ack));
        }
    }

    /// No echo took an acknowledgement along.
    pub(crate) fn look_for_ack(&mut self) {
        self.look_for_kept();
        if self.status.has_ack() {
            self.ack_status();
        } else {
            self.status.look_later();
        }
    }

    fn ack_status(&mut self) {
        let ack = self.status.ack();
        self.change_out(|out| out.acks.push(ack));
    }
}
