//! Limits how many events of one robot are kept in a second, EVENT and CRITICAL together: a bucket of tokens for each robot.
//!
//! Invariants:
//! 1. Nothing is lost by it: what waits for a token is not acknowledged, and what finds no room to wait is asked for again.
//! 2. A bucket outlives the sessions of its robot: who dials again has no more tokens than before.
//! 3. It is full after a quiet time, so that what gathered while a robot was cut off is kept at once.
//!
//! Called by sessions. It counts the time of the link, which no speed-up scales, as the agent does.

use midshift_core::ids::RobotId;
use midshift_core::limits;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::time::Instant;

const PER_SECOND: u64 = limits::EVENTS_PER_SECOND as u64;
const FULL_MILLI_TOKENS: u64 = limits::EVENTS_BURST as u64 * 1_000;
/// A robot that is slowed for so long is told to people.
const LASTS: Duration = Duration::from_secs(10);
/// People are told of it so often.
const TOLD_EVERY: Duration = Duration::from_secs(60);

/// The bucket of one robot. An event that is kept takes one token.
#[derive(Debug)]
pub struct EventRate {
    milli_tokens: u64,
    at: Instant,
    /// Since when events wait for tokens; none: none does.
    slowed: Option<Instant>,
    told: Option<Instant>,
}

impl EventRate {
    fn full(now: Instant) -> Self {
        Self { milli_tokens: FULL_MILLI_TOKENS, at: now, slowed: None, told: None }
    }
    fn refill(&mut self, now: Instant) {
        let passed_ms = now.saturating_duration_since(self.at).as_millis() as u64;
        self.milli_tokens =
            self.milli_tokens.saturating_add(passed_ms.saturating_mul(PER_SECOND)).min(FULL_MILLI_TOKENS);
        self.at += Duration::from_millis(passed_ms);
    }
    /// How many of `waiting` events may be kept now. A robot that is slowed gets those of a second together: one commit.
    pub fn allowed(&mut self, waiting: usize, now: Instant) -> usize {
        self.refill(now);
        let tokens = (self.milli_tokens / 1_000) as usize;
        if tokens >= waiting {
            self.slowed = None;
            return waiting;
        }
        self.slowed.get_or_insert(now);
        if tokens >= least(waiting) { tokens } else { 0 }
    }
    /// When some of them are allowed, if none is yet.
    pub fn next_at(&self, waiting: usize) -> Instant {
        let missing = (least(waiting) as u64 * 1_000).saturating_sub(self.milli_tokens);
        self.at + Duration::from_millis(missing.div_ceil(PER_SECOND))
    }
    /// So many were kept.
    pub fn spend(&mut self, events: usize) {
        self.milli_tokens = self.milli_tokens.saturating_sub(events as u64 * 1_000);
    }
    /// Whether people are told now that the robot is slowed.
    pub fn is_told(&mut self, now: Instant) -> bool {
        let lasts = self.slowed.is_some_and(|since| now.duration_since(since) >= LASTS);
        let is_due = self.told.is_none_or(|told| now.duration_since(told) >= TOLD_EVERY);
        if lasts && is_due {
            self.told = Some(now);
        }
        lasts && is_due
    }
}

/// Events that a slowed robot waits for.
fn least(waiting: usize) -> usize {
    waiting.min(PER_SECOND as usize)
}

/// One bucket, which a session and the one that follows it share.
pub type SharedRate = Arc<Mutex<EventRate>>;

/// What a holder that panicked left is a number of tokens all the same.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The buckets of robots that have a session, or left one that was not full.
#[derive(Debug, Default)]
pub struct EventRates(Mutex<BTreeMap<RobotId, SharedRate>>);

impl EventRates {
    /// The bucket of a robot; a full one, if none is known.
    pub fn rate_of(&self, robot_id: &RobotId, now: Instant) -> SharedRate {
        let full = || Arc::new(Mutex::new(EventRate::full(now)));
        lock(&self.0).entry(robot_id.clone()).or_insert_with(full).clone()
    }
    /// Forgets the bucket of a robot that has no session any more, if it is full.
    pub fn leave(&self, robot_id: &RobotId, now: Instant) {
        let mut rates = lock(&self.0);
        let is_needless = rates.get(robot_id).is_some_and(|rate| {
            let mut bucket = lock(rate);
            bucket.refill(now);
            Arc::strong_count(rate) == 1 && bucket.milli_tokens == FULL_MILLI_TOKENS
        });
        if is_needless {
            rates.remove(robot_id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BURST: usize = limits::EVENTS_BURST as usize;

    fn robot() -> RobotId {
        RobotId::parse("r1").expect("a valid id")
    }
    fn after_ms(begin: Instant, ms: u64) -> Instant {
        begin + Duration::from_millis(ms)
    }

    #[test]
    fn a_backlog_is_kept_at_once_and_what_goes_on_a_second_at_a_time() {
        let begin = Instant::now();
        let mut rate = EventRate::full(begin);
        assert_eq!(rate.allowed(BURST, begin), BURST);
        rate.spend(BURST);
        assert_eq!((rate.allowed(200, begin), rate.next_at(200)), (0, after_ms(begin, 1_000)));
        assert_eq!(rate.allowed(200, after_ms(begin, 999)), 0);
        assert_eq!(rate.allowed(200, after_ms(begin, 1_000)), 50);
        rate.spend(50);
        assert_eq!(rate.next_at(3), after_ms(begin, 1_060), "the last few wait for no more than they are");
        assert_eq!(rate.allowed(3, after_ms(begin, 1_060)), 3);
        rate.spend(3);
        assert_eq!(rate.allowed(BURST, after_ms(begin, 3_600_000)), BURST, "it is full again, and no fuller");
        assert_eq!(rate.allowed(BURST + 1, after_ms(begin, 3_600_000)), BURST);
    }

    #[test]
    fn a_robot_that_says_as_much_as_it_may_is_never_slowed() {
        let begin = Instant::now();
        let mut rate = EventRate::full(begin);
        for second in 0..3_600 {
            assert_eq!(rate.allowed(50, after_ms(begin, second * 1_000)), 50);
            rate.spend(50);
        }
    }

    #[test]
    fn people_are_told_once_a_minute_of_a_robot_that_is_slowed_for_long() {
        let begin = Instant::now();
        let mut rate = EventRate::full(begin);
        rate.spend(BURST);
        let mut told = Vec::new();
        for second in 0..140 {
            let now = after_ms(begin, second * 1_000);
            // For a second in between nothing waits.
            let waiting = if second == 100 { 0 } else { 1_000 };
            let allowed = rate.allowed(waiting, now);
            rate.spend(allowed);
            told.extend(rate.is_told(now).then_some(second));
        }
        assert_eq!(told, [10, 70, 130]);
    }

    #[test]
    fn a_bucket_outlives_its_session_until_it_is_full() {
        let (rates, begin) = (EventRates::default(), Instant::now());
        let first = rates.rate_of(&robot(), begin);
        lock(&first).spend(BURST);
        let next = rates.rate_of(&robot(), begin);
        assert!(Arc::ptr_eq(&first, &next), "a session shares it with the one that follows");
        drop(first);
        rates.leave(&robot(), after_ms(begin, 3_600_000));
        assert_eq!(lock(&rates.0).len(), 1, "a session has it");
        drop(next);
        lock(&rates.rate_of(&robot(), begin)).spend(1);
        rates.leave(&robot(), after_ms(begin, 3_600_000));
        assert_eq!(lock(&rates.0).len(), 1, "it is not full");
        rates.leave(&robot(), after_ms(begin, 3_600_100));
        assert_eq!(lock(&rates.0).len(), 0);
    }
}
