//! Old STATUS on its way beside the session: when the next batch may go, and when the session itself takes what is
//! left.
//!
//! Invariant: one batch is under way at most, at this robot's own pace, and what comes to nothing is sent again from
//! what the server has; a server that does not serve it, or a bulk connection that cannot be had, never keeps the lane
//! back for long. Called by the core alone.

use midshift_core::limits;
use midshift_core::time::{LinkDuration, LinkTime};
use midshift_proto::session::LaneAck;

/// What came of one batch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Replayed {
    /// The server's answer, as on the session.
    Stored(LaneAck),
    /// The server does not know the call.
    NotServed,
    /// Nobody knows, or it was refused; why.
    Failed(String),
}

/// First pause after a batch that came to nothing; it doubles each time.
const PAUSE: LinkDuration = LinkDuration::from_secs(1);
/// However low the cap of downloads is, bytes a second.
const RATE_MIN: u64 = 1024;

/// Pace and patience of one session.
#[derive(Clone, Copy, Debug, Default)]
pub struct Pace {
    next_at: LinkTime,
    failures: u32,
}

impl Pace {
    /// Whether a batch may go now.
    pub fn is_due(&self, now: LinkTime) -> bool {
        now >= self.next_at
    }

    /// When it may, if that is later than now.
    pub fn next_at(&self, now: LinkTime) -> Option<LinkTime> {
        (self.next_at > now).then_some(self.next_at)
    }

    /// A batch of so many bytes goes now. `cap_bytes_s` is what this robot may download a second, 0 if nobody said: it
    /// leaves the larger share of it to downloads.
    pub fn sent(&mut self, now: LinkTime, bytes: usize, cap_bytes_s: u32) {
        let share = if cap_bytes_s == 0 { u64::MAX } else { (u64::from(cap_bytes_s) / 4).max(RATE_MIN) };
        let rate = limits::REPLAY_BYTES_S.min(share);
        self.next_at = now + LinkDuration((bytes as u64 * 1000).div_ceil(rate));
    }

    /// It brought the lane on.
    pub fn went_well(&mut self) {
        self.failures = 0;
    }

    /// It came to nothing. False: it is not worth another try in this session.
    pub fn came_to_nothing(&mut self, now: LinkTime) -> bool {
        let pause = LinkDuration(PAUSE.as_ms() << self.failures.min(8));
        self.failures += 1;
        self.next_at = self.next_at.max(now + pause);
        self.failures < limits::REPLAY_TRIES
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_waits_for_the_one_before_at_the_rate_of_the_robot_or_a_quarter_of_its_cap() {
        let mut pace = Pace::default();
        assert!(pace.is_due(LinkTime(0)));
        pace.sent(LinkTime(1_000), 32 * 1024, 0);
        assert_eq!((pace.is_due(LinkTime(1_499)), pace.next_at(LinkTime(1_499))), (false, Some(LinkTime(1_500))));
        assert_eq!((pace.is_due(LinkTime(1_500)), pace.next_at(LinkTime(1_500))), (true, None));
        pace.sent(LinkTime(2_000), 32 * 1024, 64 * 1024);
        assert_eq!(pace.next_at(LinkTime(2_000)), Some(LinkTime(4_000)));
        pace.sent(LinkTime(2_000), 2 * 1024, 1);
        assert_eq!(pace.next_at(LinkTime(2_000)), Some(LinkTime(4_000)), "a low cap does not end it");
    }

    #[test]
    fn what_comes_to_nothing_is_tried_again_later_and_not_for_ever() {
        let mut pace = Pace::default();
        assert!(pace.came_to_nothing(LinkTime(0)));
        assert_eq!(pace.next_at(LinkTime(0)), Some(LinkTime(1_000)));
        assert!(pace.came_to_nothing(LinkTime(1_000)));
        assert_eq!(pace.next_at(LinkTime(1_000)), Some(LinkTime(3_000)));
        pace.went_well();
        assert!(pace.came_to_nothing(LinkTime(3_000)) && pace.came_to_nothing(LinkTime(4_000)));
        assert!(!pace.came_to_nothing(LinkTime(6_000)));
    }
}
