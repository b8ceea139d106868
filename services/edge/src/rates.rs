//! How fast each may ask: a token bucket for each principal, kept as the one moment at which it is full again. Its last tokens are for what matters most.
//!
//! Invariant: pure but for the memory of buckets, which is bounded. Who is forgotten begins with a full bucket: nobody is worse off for
//! being forgotten, and many who take turns gain no more than many would have.

use crate::config::Rate;
use lru::LruCache;
use midshift_core::overload::Class;
use std::hash::Hash;
use std::num::NonZeroUsize;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::time::Instant;

/// What a bucket holds.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bucket {
    /// Time that a token takes to come back.
    pub token: Duration,
    /// Tokens of a full one.
    pub burst: u32,
}

impl From<Rate> for Bucket {
    fn from(rate: Rate) -> Self {
        Self { token: Duration::from_secs(1) / rate.per_second.get(), burst: rate.burst.get() }
    }
}

impl Bucket {
    /// Takes one token of a bucket that is full again at `full_at`; none: there is none for this class, and the bucket stays as it is. What is kept for
    /// higher classes is no less for long: tokens come back as fast for all.
    fn fill(self, full_at: Instant, now: Instant, class: Class) -> Option<Instant> {
        let full_at = full_at.max(now) + self.token;
        let share = u32::try_from(class.share(self.burst as usize)).unwrap_or(self.burst);
        (full_at - now <= self.token * share).then_some(full_at)
    }
}

/// The buckets of all.
pub(crate) struct Rates<K> {
    bucket: Bucket,
    full_at: Mutex<LruCache<K, Instant>>,
}

impl<K: Eq + Hash + Clone> Rates<K> {
    /// At most `remembered` buckets.
    pub fn new(bucket: impl Into<Bucket>, remembered: usize) -> Self {
        let remembered = NonZeroUsize::new(remembered).unwrap_or(NonZeroUsize::MIN);
        Self { bucket: bucket.into(), full_at: Mutex::new(LruCache::new(remembered)) }
    }

    /// Whether `key` may ask for something of this class now; if so, one token of it is gone.
    pub fn admit(&self, key: &K, now: Instant, class: Class) -> bool {
        let mut buckets = self.full_at.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(full_at) = buckets.get_mut(key) {
            let taken = self.bucket.fill(*full_at, now, class);
            *full_at = taken.unwrap_or(*full_at);
            return taken.is_some();
        }
        if let Some(full_at) = self.bucket.fill(now, now, class) {
            buckets.put(key.clone(), full_at);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::num::NonZeroU32;

    const SECOND: Duration = Duration::from_secs(1);

    fn rate(per_second: u32, burst: u32) -> Rate {
        let count = |n| NonZeroU32::new(n).expect("not zero");
        Rate { per_second: count(per_second), burst: count(burst) }
    }

    /// How many of `tries` are let in.
    fn let_in(rates: &Rates<&'static str>, key: &'static str, now: Instant, tries: usize) -> usize {
        (0..tries).filter(|_| rates.admit(&key, now, Class::Stop)).count()
    }

    #[test]
    fn a_burst_is_let_in_and_then_only_what_has_come_back() {
        let (rates, now) = (Rates::new(rate(10, 5), 8), Instant::now());
        assert_eq!(let_in(&rates, "a", now, 100), 5);
        assert_eq!(let_in(&rates, "a", now + SECOND / 10, 100), 1, "a token a tenth of a second");
        assert_eq!(let_in(&rates, "a", now + 100 * SECOND, 100), 5, "never more than a burst is saved up");
    }

    #[test]
    fn who_floods_with_what_can_wait_can_still_decide_and_stop_and_gets_no_less_for_long() {
        let (rates, mut now) = (Rates::new(rate(10, 10), 8), Instant::now());
        let let_in = |class, tries, now| (0..tries).filter(|_| rates.admit(&"a", now, class)).count();
        assert_eq!(Class::ALL.map(|class| let_in(class, 100, now)), [6, 1, 1, 1, 1]);
        let mut bulk = 0;
        for _ in 0..100 {
            now += SECOND / 10;
            bulk += let_in(Class::Bulk, 5, now);
        }
        assert_eq!(bulk, 96, "ten a second once the four above its share have come back");
    }

    #[test]
    fn refusals_cost_nothing_and_others_notice_nothing() {
        let (rates, now) = (Rates::new(rate(1, 1), 8), Instant::now());
        assert_eq!(let_in(&rates, "a", now, 1_000), 1);
        assert_eq!(let_in(&rates, "b", now, 1), 1);
        assert_eq!(let_in(&rates, "a", now + SECOND, 1), 1, "a thousand refusals did not push it further away");
    }

    #[test]
    fn the_memory_is_bounded_and_keeps_who_asks_most() {
        let (rates, now) = (Rates::new(rate(1, 1), 2), Instant::now());
        assert_eq!(let_in(&rates, "flood", now, 2), 1);
        for other in ["b", "c", "d"] {
            assert_eq!(let_in(&rates, other, now, 1), 1);
            assert_eq!(let_in(&rates, "flood", now, 1), 0, "it is heard all the time, so it is remembered");
        }
        assert_eq!(rates.full_at.lock().expect("not poisoned").len(), 2);
        assert_eq!(let_in(&rates, "b", now, 1), 1, "forgotten, so it begins anew");
    }
}
