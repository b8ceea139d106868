//! One rule for everything that lets a robot act: authority is anchored to a heartbeat the robot itself sent.
//!
//! A buffered message must never start a body. Each downward message that gives authority carries the highest heartbeat of that
//! session which the server had processed when it wrote the message. The robot refuses when more than `valid_ms` have passed since it
//! *sent* that heartbeat, and stands when no echo has renewed it for [`limits::AUTHORITY`]. The server gives the same thing to another
//! only when [`limits::LEASE`] has passed since it *processed* the robot's last heartbeat. Processed is never before sent and the lease
//! is longer by more than two clocks drift apart, so the robot's clock always ends first. No wall clock takes part.
//! Called by the agent (refuse, go on) and by fleet (grant, grant again).

use crate::limits;
use crate::time::{LinkDuration, LinkTime};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Permission to start something, bound to one session and one heartbeat of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Authority {
    /// Session whose heartbeat it is anchored to.
    pub session_epoch: u64,
    /// Highest heartbeat of that session the server had processed.
    pub hb: u64,
    /// Milliseconds of link time from the robot's sending of that heartbeat.
    pub valid_ms: u64,
}

/// Why the robot refused authority.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Stale {
    /// Anchored to another session.
    #[error("anchored to session {anchored}, this is {current}")]
    OtherSession {
        /// Session in the message.
        anchored: u64,
        /// Session of the robot.
        current: u64,
    },
    /// Its heartbeat is older than all that are remembered, or was never sent.
    #[error("heartbeat {0} is not remembered")]
    UnknownHeartbeat(u64),
    /// Too late.
    #[error("{late_ms} ms too late")]
    Late {
        /// Milliseconds past its validity.
        late_ms: u64,
    },
}

/// The robot's memory of when it sent its heartbeats, and of the newest that was echoed.
#[derive(Clone, Debug)]
pub struct SentHeartbeats {
    session_epoch: u64,
    sent: VecDeque<(u64, LinkTime)>,
    lease_from: Option<LinkTime>,
}

impl SentHeartbeats {
    /// A new session: everything anchored to an older one is stale. `carried` is the lease point the robot still stands on.
    pub fn new(session_epoch: u64, carried: Option<LinkTime>) -> Self {
        Self { session_epoch, sent: VecDeque::with_capacity(limits::HEARTBEATS_REMEMBERED), lease_from: carried }
    }
    /// Notes the sending of heartbeat `hb` at `now`.
    pub fn sent(&mut self, hb: u64, now: LinkTime) {
        if self.sent.len() == limits::HEARTBEATS_REMEMBERED {
            self.sent.pop_front();
        }
        self.sent.push_back((hb, now));
    }
    /// Notes that the server has processed `hb`: authority to go on counts from its *sending*.
    pub fn echoed(&mut self, hb: u64) {
        if let Some((_, at)) = self.sent.iter().find(|(n, _)| *n == hb) {
            self.lease_from = self.lease_from.max(Some(*at));
        }
    }
    /// Until when the robot may go on with an attempt it has accepted; none before the first echo.
    pub fn lease_until(&self) -> Option<LinkTime> {
        self.lease_from.map(|at| at + limits::AUTHORITY)
    }
    /// The sending time of the newest echoed heartbeat.
    pub fn lease_from(&self) -> Option<LinkTime> {
        self.lease_from
    }
    /// When `authority` ends for the robot; none if its anchor gives nothing.
    pub fn ends(&self, authority: &Authority) -> Option<LinkTime> {
        let (_, at) =
            self.sent.iter().find(|(n, _)| *n == authority.hb && authority.session_epoch == self.session_epoch)?;
        Some(*at + LinkDuration(authority.valid_ms))
    }
    /// Whether `authority` still lets the robot act at `now`.
    pub fn check(&self, authority: &Authority, now: LinkTime) -> Result<(), Stale> {
        if authority.session_epoch != self.session_epoch {
            return Err(Stale::OtherSession { anchored: authority.session_epoch, current: self.session_epoch });
        }
        let Some((_, at)) = self.sent.iter().find(|(n, _)| *n == authority.hb) else {
            return Err(Stale::UnknownHeartbeat(authority.hb));
        };
        let end = *at + LinkDuration(authority.valid_ms);
        if now > end {
            return Err(Stale::Late { late_ms: now.since(end).as_ms() });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn offer(hb: u64) -> Authority {
        Authority { session_epoch: 7, hb, valid_ms: limits::OFFER_VALID.as_ms() }
    }

    #[test]
    fn a_message_held_twelve_seconds_moves_nobody() {
        let mut sent = SentHeartbeats::new(7, None);
        sent.sent(1, LinkTime(1_000));
        assert_eq!(sent.check(&offer(1), LinkTime(6_000)), Ok(()));
        assert_eq!(sent.check(&offer(1), LinkTime(13_000)), Err(Stale::Late { late_ms: 7_000 }));
    }

    #[test]
    fn another_sessions_anchor_is_refused_whatever_its_age() {
        let mut sent = SentHeartbeats::new(8, None);
        sent.sent(1, LinkTime(0));
        assert_eq!(sent.check(&offer(1), LinkTime(0)), Err(Stale::OtherSession { anchored: 7, current: 8 }));
    }

    #[test]
    fn a_heartbeat_that_fell_out_of_memory_gives_nothing() {
        let mut sent = SentHeartbeats::new(7, None);
        for hb in 1..=65 {
            sent.sent(hb, LinkTime(hb));
        }
        assert_eq!(sent.check(&offer(1), LinkTime(66)), Err(Stale::UnknownHeartbeat(1)));
        assert_eq!(sent.check(&offer(2), LinkTime(66)), Ok(()));
    }

    #[test]
    fn the_lease_counts_from_sending_and_never_moves_back() {
        let mut sent = SentHeartbeats::new(7, None);
        assert_eq!(sent.lease_until(), None);
        sent.sent(1, LinkTime(1_000));
        sent.sent(2, LinkTime(2_000));
        sent.echoed(2);
        sent.echoed(1);
        assert_eq!(sent.lease_until(), Some(LinkTime(32_000)));
    }

    proptest! {
        /// Whatever the delay and up to 2 % drift: when the server may grant again, the robot stands already.
        #[test]
        fn the_robot_always_ends_first(up in 0u64..20_000, drift in -20i64..=20) {
            let mut sent = SentHeartbeats::new(1, None);
            sent.sent(1, LinkTime(0));
            sent.echoed(1);
            // Real time from sending until the server may grant again, read on a robot clock that runs `drift` permille slow or fast.
            let real = (LinkTime(up) + limits::LEASE).0;
            let robot = real * 1_000u64.saturating_add_signed(drift) / 1_000;
            prop_assert!(sent.lease_until().is_some_and(|end| end < LinkTime(robot)));
        }
    }
}
