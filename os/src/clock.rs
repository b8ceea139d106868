//! The clocks of a real process: tokio's monotonic clock, so that a simulation can own it, and the wall's UTC, read
//! whenever the time is asked for.
//!
//! Called by programs, at their start.

use midshift_core::time::{Clock, Jump, Utc};
use midshift_core::wall_clock::WallClock;
use std::fs;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};
use tokio::time::Instant;

/// systemd touches it when the clock of the machine was set from the network. The kernel is not asked: the system call
/// filter of our own unit ends a process that calls adjtimex, also one that only reads.
const SYNCED: &str = "/run/systemd/timesync/synchronized";

/// UTC of the machine, unix ms.
#[expect(clippy::disallowed_methods, reason = "the one place where the machine's wall clock is read")]
pub fn wall() -> Utc {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Utc(i64::try_from(since.as_millis()).unwrap_or(i64::MAX))
}

/// Clocks that start now, both as fast as the machine's. Each jump of the wall is logged and given to `jumped`.
pub fn real(jumped: impl Fn(&Jump) + Send + Sync + 'static) -> Arc<dyn Clock> {
    let told = move |jump: &Jump| {
        jumped(jump);
        let (step_ms, from, to) = (jump.step_ms(), jump.from.rfc3339(), jump.to.rfc3339());
        tracing::warn!(step_ms, from, to, "the wall clock jumped");
    };
    Arc::new(WallClock::new(micros(), wall, told).with_synced(synced))
}

/// Microseconds of the monotonic clock since this call.
pub fn micros() -> impl Fn() -> u64 + Send + Sync {
    let started = Instant::now();
    move || u64::try_from(started.elapsed().as_micros()).unwrap_or(u64::MAX)
}

/// When the network set the clock of this machine last; none: not since the machine started, or nothing here says so.
fn synced() -> Option<Utc> {
    let touched = fs::metadata(SYNCED).and_then(|file| file.modified()).ok()?;
    let since = touched.duration_since(UNIX_EPOCH).ok()?;
    Some(Utc(i64::try_from(since.as_millis()).unwrap_or(i64::MAX)))
}
