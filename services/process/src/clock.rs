//! The process' clocks, by the site's rate: the machine's own, or a scaled one of a simulation.

use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_os::clock::{micros, real};
use std::sync::Arc;

pub use midshift_os::clock::wall;

/// Clocks that start now; the site clock runs `rate_permille` thousandths of real time. One that is not real is a simulation's own, with its wall.
pub fn clock(rate_permille: u32) -> Arc<dyn Clock> {
    match rate_permille {
        1000 => real(|_| metrics::counter!("midshift_clock_jumps_total").increment(1)),
        _ => at(wall(), rate_permille),
    }
}

/// Clocks whose UTC is `utc` now, whatever the wall says later.
pub fn at(utc: Utc, rate_permille: u32) -> Arc<dyn Clock> {
    Arc::new(ScaledClock::new(micros(), utc, rate_permille))
}
