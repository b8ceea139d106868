//! Room for robots that say hello: so many are carried out at a time, as many again and more wait on their streams, and the rest are given turns.
//!
//! Invariant: nobody waits longer than [`limits::HELLO_WAITS`]; those who are sent away come again one after the other, not together.

use midshift_core::limits;
use midshift_core::reason::{Code, Kind, Reason, Refusal};
use midshift_core::time::LinkDuration;
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::{Semaphore, SemaphorePermit};
use tokio::time::{Instant, timeout_at};

/// The room of one process.
pub struct Hellos {
    /// For those that are carried out.
    room: Semaphore,
    /// For those that wait until they are.
    waiting: Semaphore,
    turns: Mutex<Turns>,
}

impl Default for Hellos {
    fn default() -> Self {
        let (room, waiting) = (Semaphore::new(limits::HELLOS_MAX), Semaphore::new(limits::HELLOS_WAITING_MAX));
        Self { room, waiting, turns: Mutex::default() }
    }
}

impl Hellos {
    /// Room to carry a Hello out, once `ready` is over.
    ///
    /// # Errors
    /// There is none for so long, or `ready` takes so long: with a turn to come again.
    pub async fn enter(&self, ready: impl Future<Output = ()>) -> Result<SemaphorePermit<'_>, Refusal> {
        let Ok(_waits) = self.waiting.try_acquire() else { return Err(self.put_off(crowded())) };
        let end = Instant::now() + Duration::from_millis(limits::HELLO_WAITS.as_ms());
        if timeout_at(end, ready).await.is_err() {
            return Err(self.put_off(Refusal::new(Kind::Unavailable, Code::StoreUnavailable)));
        }
        match timeout_at(end, self.room.acquire()).await {
            Ok(Ok(room)) => Ok(room),
            _ => Err(self.put_off(crowded())),
        }
    }

    fn put_off(&self, refusal: Refusal) -> Refusal {
        metrics::counter!("midshift_telemetry_hellos_put_off_total").increment(1);
        let mut turns = self.turns.lock().unwrap_or_else(PoisonError::into_inner);
        refusal.again_after(turns.give_next(Instant::now()))
    }
}

fn crowded() -> Refusal {
    Refusal::new(Kind::Exhausted, Reason::new(Code::Overloaded, "there is no room for one more hello"))
}

/// The line of those who were sent away: none of them stands anywhere, each has a moment of its own.
#[derive(Default)]
struct Turns {
    last: Option<Instant>,
}

impl Turns {
    /// The next turn, from now. Behind the last one that may be given the line begins anew, between those who have theirs.
    fn give_next(&mut self, now: Instant) -> LinkDuration {
        let first = now + Duration::from_millis(limits::HELLO_AGAIN.as_ms());
        let end = now + Duration::from_millis(limits::HELLO_AGAIN_MAX.as_ms());
        let next = self.last.map(|last| last + Duration::from_millis(limits::HELLO_STEP.as_ms()));
        let turn = next.filter(|next| (first..=end).contains(next)).unwrap_or(first);
        self.last = Some(turn);
        LinkDuration((turn - now).as_millis() as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn robots_that_are_put_off_together_come_again_one_after_the_other() {
        let (mut turns, now) = (Turns::default(), Instant::now());
        let (first, step, end) =
            (limits::HELLO_AGAIN.as_ms(), limits::HELLO_STEP.as_ms(), limits::HELLO_AGAIN_MAX.as_ms());
        let line = (end - first) / step + 1;
        for n in 0..line {
            assert_eq!(turns.give_next(now).as_ms(), first + n * step);
        }
        assert_eq!(turns.give_next(now).as_ms(), first, "none is sent away for longer, so the line begins anew");
        let later = now + Duration::from_millis(first);
        assert_eq!(turns.give_next(later).as_ms(), first, "a line that is over counts for nobody");
    }

    #[tokio::test(start_paused = true)]
    async fn what_waits_goes_in_as_soon_as_another_is_done() {
        let hellos = Hellos::default();
        let mut inside = Vec::new();
        for _ in 0..limits::HELLOS_MAX {
            inside.push(hellos.enter(std::future::ready(())).await.expect("room"));
        }
        let started = Instant::now();
        let (entered, ()) = tokio::join!(hellos.enter(std::future::ready(())), async { drop(inside.pop()) });
        assert!(entered.is_ok());
        let refused = hellos.enter(std::future::ready(())).await.expect_err("no room in time");
        assert_eq!((refused.kind(), refused.reason.code), (Kind::Exhausted, Code::Overloaded));
        assert_eq!(started.elapsed().as_millis() as u64, limits::HELLO_WAITS.as_ms());
        let refused = Hellos::default().enter(std::future::pending()).await.expect_err("never ready");
        assert_eq!((refused.kind(), refused.reason.code), (Kind::Unavailable, Code::StoreUnavailable));
        assert_eq!(refused.again_after.map(LinkDuration::as_ms), Some(limits::HELLO_AGAIN.as_ms()));
    }
}
