//! The process' clocks: tokio's monotonic clock, so that a simulation can own it, and the wall's UTC read once at the start.

use midshift_core::time::{Clock, ScaledClock, Utc};
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};
use tokio::time::Instant;

/// UTC of the machine, unix ms.
#[expect(clippy::disallowed_methods, reason = "the one place where the machine's wall clock is read")]
pub fn wall() -> Utc {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Utc(i64::try_from(since.as_millis()).unwrap_or(i64::MAX))
}

/// Clocks that start now; the site clock runs `rate_permille` thousandths of real time.
pub fn clock(rate_permille: u32) -> Arc<dyn Clock> {
    at(wall(), rate_permille)
}

/// Clocks whose UTC is `utc` now.
pub fn at(utc: Utc, rate_permille: u32) -> Arc<dyn Clock> {
    let started = Instant::now();
    let micros = move || u64::try_from(started.elapsed().as_micros()).unwrap_or(u64::MAX);
    Arc::new(ScaledClock::new(micros, utc, rate_permille))
}
