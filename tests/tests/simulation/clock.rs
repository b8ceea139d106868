//! Clocks of simulated machines: one true time, and for each process a link clock and a wall clock that may be wrong.
//!
//! Invariant: bodies and tasks live in true time; only what a machine reads of its own oscillator is skewed.

use midshift_core::time::{Clock, LinkTime, Now, SiteTime, Utc};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;

/// UTC at the beginning of each run, unix milliseconds.
pub const BEGIN_UNIX_MS: i64 = 1_790_000_000_000;

/// True time: the simulated network's own, or what the loop around it last noted.
#[derive(Clone, Debug, Default)]
pub struct TrueTime(Arc<AtomicU64>);

impl TrueTime {
    /// Notes how far the simulation has come, for whoever asks from outside of it.
    pub fn note(&self, elapsed: Duration) {
        self.0.store(micros(elapsed), Relaxed);
    }
    /// Microseconds since the beginning.
    pub fn us(&self) -> u64 {
        turmoil::sim_elapsed().map_or_else(|| self.0.load(Relaxed), micros)
    }
    /// Site time, which is true time.
    pub fn site(&self) -> SiteTime {
        SiteTime(self.us() / 1000)
    }
}

fn micros(elapsed: Duration) -> u64 {
    elapsed.as_micros() as u64
}

/// How wrong a machine's clocks are.
#[derive(Clone, Copy, Debug, Default)]
pub struct Skew {
    /// How much faster than true the link clock runs, hundredths of a percent.
    pub drift: i64,
    /// How far the wall clock is ahead, milliseconds.
    pub wall_ms: i64,
}

/// The clocks of one process.
pub struct MachineClock {
    time: TrueTime,
    booted_us: u64,
    skew: Skew,
}

impl MachineClock {
    /// A process that starts now: its link clock starts again.
    pub fn boot(time: &TrueTime, skew: Skew) -> Arc<dyn Clock> {
        Arc::new(Self { booted_us: time.us(), time: time.clone(), skew })
    }
}

impl Clock for MachineClock {
    fn now(&self) -> Now {
        let us = self.time.us();
        let link_us = (us - self.booted_us) as i64 * (10_000 + self.skew.drift) / 10_000;
        let utc = Utc(BEGIN_UNIX_MS).plus_ms(us / 1000);
        Now {
            site: SiteTime(us / 1000),
            link: LinkTime(link_us.unsigned_abs() / 1000 + 1_000),
            utc,
            wall: Utc(utc.0 + self.skew.wall_ms),
            jump: None,
        }
    }
    fn rate_permille(&self) -> u32 {
        1_000
    }
}
