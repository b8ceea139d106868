//! The process' clocks: tokio's monotonic clock, so that a simulation can own it, and the wall's UTC, read whenever the time is asked for.

use midshift_cli::clock::wall;
use midshift_core::time::{Clock, Jump, ScaledClock, Utc};
use midshift_core::wall::WallClock;
use std::fs;
use std::sync::Arc;
use std::time::UNIX_EPOCH;
use tokio::time::Instant;

/// systemd touches it when the clock of the machine was set from the network. The kernel is not asked: the system call filter of our own unit ends a
/// process that calls adjtimex, also one that only reads.
const SYNCED: &str = "/run/systemd/timesync/synchronized";

/// Clocks that start now; the site clock runs `rate_permille` thousandths of real time. One that is not real is a simulation's own, with its wall.
pub fn clock(rate_permille: u32) -> Arc<dyn Clock> {
    match rate_permille {
        1000 => Arc::new(WallClock::new(micros(), wall, log).with_synced(synced)),
        _ => at(wall(), rate_permille),
    }
}

/// Clocks whose UTC is `utc` now, whatever the wall says later.
pub fn at(utc: Utc, rate_permille: u32) -> Arc<dyn Clock> {
    Arc::new(ScaledClock::new(micros(), utc, rate_permille))
}

/// When the network set the clock of this machine last; none: not since the machine started, or nothing here says so.
fn synced() -> Option<Utc> {
    let touched = fs::metadata(SYNCED).and_then(|file| file.modified()).ok()?;
    let since = touched.duration_since(UNIX_EPOCH).ok()?;
    Some(Utc(i64::try_from(since.as_millis()).unwrap_or(i64::MAX)))
}

fn micros() -> impl Fn() -> u64 + Send + Sync {
    let started = Instant::now();
    move || u64::try_from(started.elapsed().as_micros()).unwrap_or(u64::MAX)
}

fn log(jump: &Jump) {
    let (step_ms, from, to) = (jump.step_ms(), jump.from.rfc3339(), jump.to.rfc3339());
    metrics::counter!("midshift_clock_jumps_total").increment(1);
    tracing::warn!(step_ms, from, to, "the wall clock jumped");
}
