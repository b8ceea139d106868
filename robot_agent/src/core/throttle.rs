//! The rate cap of CRITICAL and EVENT: fifty a second, then facts wait, and facts that only repeat each other are
//! summarised.
//!
//! Invariant: nothing is dropped in silence. What happened to attempts and places waits its turn; of a flapping fault,
//! mode, stop, load or refusal the newest stays, and the count of changes it stands for is told.

use midshift_core::limits;
use midshift_core::robot::Lane;
use midshift_core::robot_events::RobotEvent;
use midshift_core::time::{LinkDuration, LinkTime};
use std::collections::VecDeque;

/// An event that waits for its turn.
#[derive(Debug)]
struct Waiting {
    lane: Lane,
    event: RobotEvent,
    more: u32,
}

/// Tokens of one second and what waits for them.
#[derive(Debug)]
pub struct Throttle {
    milli_tokens: u64,
    at: LinkTime,
    waiting: VecDeque<Waiting>,
    /// Changes that were summarised since the start.
    pub summarised: u64,
}

const PER_SECOND: u64 = limits::EVENTS_PER_SECOND as u64;

impl Throttle {
    /// With a full second of tokens.
    pub fn new(now: LinkTime) -> Self {
        Self { milli_tokens: PER_SECOND * 1000, at: now, waiting: VecDeque::new(), summarised: 0 }
    }

    /// Takes one event in; it comes out of [`Self::ready`] at once or later.
    pub fn push(&mut self, lane: Lane, event: RobotEvent) {
        let same = |w: &&mut Waiting| repeats(&w.event, &event);
        if let Some(waiting) = self.waiting.iter_mut().rev().find(same) {
            waiting.event = event;
            waiting.more += 1;
            self.summarised += 1;
        } else {
            self.waiting.push_back(Waiting { lane, event, more: 0 });
        }
    }

    /// The next event that may be written now.
    pub fn ready(&mut self, now: LinkTime) -> Option<(Lane, RobotEvent)> {
        let earned = now.since(self.at).as_ms() * PER_SECOND;
        self.milli_tokens = (self.milli_tokens + earned).min(PER_SECOND * 1000);
        self.at = self.at.max(now);
        if self.milli_tokens < 1000 {
            return None;
        }
        let next = self.waiting.pop_front()?;
        self.milli_tokens -= 1000;
        Some((next.lane, told(next.event, next.more)))
    }

    /// When the next one may be written, if any waits.
    pub fn next_at(&self) -> Option<LinkTime> {
        let missing = 1000u64.saturating_sub(self.milli_tokens);
        (!self.waiting.is_empty()).then(|| self.at + LinkDuration(missing.div_ceil(PER_SECOND)))
    }
}

/// Whether `newer` makes `older` needless.
fn repeats(older: &RobotEvent, newer: &RobotEvent) -> bool {
    match (older, newer) {
        (RobotEvent::Fault { fault: a, .. }, RobotEvent::Fault { fault: b, .. }) => a.code == b.code,
        (RobotEvent::StaleAuthority { what: a, .. }, RobotEvent::StaleAuthority { what: b, .. }) => a == b,
        (RobotEvent::Mode(_), RobotEvent::Mode(_))
        | (RobotEvent::HardwareStop(_), RobotEvent::HardwareStop(_))
        | (RobotEvent::Load(_), RobotEvent::Load(_))
        | (RobotEvent::BatteryCritical { .. }, RobotEvent::BatteryCritical { .. }) => true,
        _ => false,
    }
}

/// The event with the number of changes it stands for, where it has a text.
fn told(mut event: RobotEvent, more: u32) -> RobotEvent {
    if more > 0 {
        let note = format!(" (and {more} more)");
        match &mut event {
            RobotEvent::Fault { fault, .. } => fault.message.push_str(&note),
            RobotEvent::StaleAuthority { detail, .. } => detail.push_str(&note),
            RobotEvent::Mode(_) => tracing::warn!(changes = more, "changes of mode summarised"),
            RobotEvent::HardwareStop(_) => tracing::warn!(changes = more, "changes of the hardware stop summarised"),
            RobotEvent::Load(_) => tracing::warn!(changes = more, "changes of the load summarised"),
            _ => tracing::warn!(changes = more, "changes summarised"),
        }
    }
    event
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::ids::PlaceId;
    use midshift_core::robot::{Fault, FaultClass};
    use midshift_core::robot_events::PlaceNews;

    fn fault(cleared: bool) -> RobotEvent {
        RobotEvent::Fault { fault: Fault { code: 7, class: FaultClass::Mechanical, message: "arm".into() }, cleared }
    }

    #[test]
    fn a_flapping_fault_is_summarised_with_its_count_and_places_only_wait() {
        let mut throttle = Throttle::new(LinkTime(0));
        let place = |n: u64| RobotEvent::Place {
            place_id: PlaceId::parse("door").expect("a name"),
            grant_id: n,
            news: PlaceNews::Entered,
        };
        for n in 0..60 {
            throttle.push(Lane::Event, place(n));
        }
        for n in 0..5 {
            throttle.push(Lane::Critical, fault(n % 2 == 1));
        }
        let mut out = Vec::new();
        while let Some((_, event)) = throttle.ready(LinkTime(0)) {
            out.push(event);
        }
        assert_eq!(out.len(), 50);
        assert_eq!(throttle.next_at(), Some(LinkTime(20)));
        while let Some((_, event)) = throttle.ready(LinkTime(1_000)) {
            out.push(event);
        }
        assert_eq!(out[..60], (0..60).map(place).collect::<Vec<_>>());
        assert_eq!(out.len(), 61);
        let RobotEvent::Fault { fault, cleared: false } = &out[60] else { panic!("{:?}", out[60]) };
        assert_eq!((fault.message.as_str(), throttle.summarised), ("arm (and 4 more)", 4));
    }
}
