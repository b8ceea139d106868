//! Limits how often a repeated failure is logged: at once the first time, and once a minute with a count after that.
//!
//! Invariant: a reason is never lost, and however fast it comes it is logged at most once a minute. Called by the
//! session and the stop line.

use std::time::Duration;
use tokio::time::Instant;

/// The same reason is logged so often, real time.
const EVERY: Duration = Duration::from_secs(60);
/// Reasons that are told apart; of more the oldest is forgotten, and logged anew.
const REASONS_MAX: usize = 8;

/// One reason that was logged.
struct LoggedReason {
    why: String,
    at: Instant,
    /// How often it came since it was logged.
    times: u32,
}

/// Reasons that were logged since something worked.
#[derive(Default)]
pub(crate) struct Repeats(Vec<LoggedReason>);

impl Repeats {
    /// How often `why` came since it was logged last, this time included, if it is to be logged now; none: it is only
    /// counted.
    pub(crate) fn count(&mut self, why: &str) -> Option<u32> {
        let now = Instant::now();
        let Some(known) = self.0.iter_mut().find(|logged| logged.why == why) else {
            if self.0.len() >= REASONS_MAX {
                self.0.remove(0);
            }
            self.0.push(LoggedReason { why: why.to_owned(), at: now, times: 0 });
            return Some(1);
        };
        known.times += 1;
        if now.duration_since(known.at) < EVERY {
            return None;
        }
        known.at = now;
        Some(std::mem::take(&mut known.times))
    }

    /// It works: what fails next is logged at once.
    pub(crate) fn forget(&mut self) {
        self.0.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_reason_is_logged_at_once_and_then_once_a_minute_with_how_often_it_came() {
        let mut repeats = Repeats::default();
        let mut logged = Vec::new();
        for second in 0..150 {
            // Two reasons that take turns are two reasons.
            let why = if second % 2 == 0 { "refused" } else { "silent" };
            logged.extend(repeats.count(why).map(|times| (second, why, times)));
            tokio::time::advance(Duration::from_secs(1)).await;
        }
        let expected = [
            (0, "refused", 1),
            (1, "silent", 1),
            (60, "refused", 30),
            (61, "silent", 30),
            (120, "refused", 30),
            (121, "silent", 30),
        ];
        assert_eq!(logged, expected);
        repeats.forget();
        assert_eq!(repeats.count("refused"), Some(1), "it worked in between");
    }

    #[tokio::test(start_paused = true)]
    async fn reasons_without_end_take_no_memory_without_end() {
        let mut repeats = Repeats::default();
        for n in 0..1_000 {
            assert_eq!(repeats.count(&format!("reason {n}")), Some(1));
        }
        assert_eq!(repeats.0.len(), REASONS_MAX);
    }
}
