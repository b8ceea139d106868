//! Two clocks as two types that do not mix, and UTC.
//!
//! `Site*` is the time of the work (motion, battery, task timeouts, back-off); `midshift dev --speedup` scales it.
//! `Link*` is monotonic and never scaled (heartbeats, authority, resend, commits). A service reads both from a [`Clock`].

use serde::{Deserialize, Serialize};
use std::ops::{Add, Sub};

macro_rules! clock_types {
    ($(#[$i:meta])* $instant:ident, $(#[$d:meta])* $duration:ident) => {
        $(#[$i])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $instant(pub u64);
        $(#[$d])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub struct $duration(pub u64);

        impl $duration {
            /// From whole seconds.
            pub const fn from_secs(secs: u64) -> Self {
                Self(secs * 1000)
            }
            /// As a number of milliseconds.
            pub const fn as_ms(self) -> u64 {
                self.0
            }
            /// Seconds as a float, for formulas of motion and energy.
            pub fn as_secs_f64(self) -> f64 {
                self.0 as f64 / 1000.0
            }
        }
        impl $instant {
            /// Time since `earlier`; zero if `earlier` is later.
            pub const fn since(self, earlier: Self) -> $duration {
                $duration(self.0.saturating_sub(earlier.0))
            }
        }
        impl Add<$duration> for $instant {
            type Output = Self;
            fn add(self, d: $duration) -> Self {
                Self(self.0.saturating_add(d.0))
            }
        }
        impl Sub<$duration> for $instant {
            type Output = Self;
            fn sub(self, d: $duration) -> Self {
                Self(self.0.saturating_sub(d.0))
            }
        }
    };
}

clock_types!(
    /// Milliseconds on the site clock of this process, from its start.
    SiteTime,
    /// Milliseconds of site time.
    SiteDuration
);
clock_types!(
    /// Milliseconds on the monotonic link clock of this process, from its start.
    LinkTime,
    /// Milliseconds of link time.
    LinkDuration
);

/// Milliseconds since 1970, UTC. Shown to people and kept in records; never used to order what two machines did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Utc(pub i64);

impl Utc {
    /// `self + ms`.
    pub const fn plus_ms(self, ms: u64) -> Self {
        Self(self.0.saturating_add(ms as i64))
    }
    /// Milliseconds from `earlier` to `self`; zero if `earlier` is later.
    pub const fn ms_since(self, earlier: Self) -> u64 {
        if self.0 > earlier.0 { (self.0 - earlier.0) as u64 } else { 0 }
    }
    /// Reads RFC 3339 with its offset, to the millisecond; none: it is not of that form.
    pub fn parse_rfc3339(text: &str) -> Option<Self> {
        text.parse::<jiff::Timestamp>().ok().map(|t| Self(t.as_millisecond()))
    }
    /// RFC 3339 text in UTC with milliseconds.
    pub fn rfc3339(self) -> String {
        jiff::Timestamp::from_millisecond(self.0).map_or_else(|_| self.0.to_string(), |t| format!("{t:.3}"))
    }
}

/// One step of the wall clock against the monotonic one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Jump {
    /// UTC at which the wall would have been without it.
    pub from: Utc,
    /// UTC of the wall when it was seen.
    pub to: Utc,
    /// When it was seen.
    pub at: LinkTime,
    /// Milliseconds that the wall passed over; zero for a jump back.
    pub skipped_ms: u64,
}

/// Why nothing is signed by the wall.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Doubt {
    /// Milliseconds that it is ahead of where it should be; negative: behind.
    pub step_ms: i64,
    /// UTC of the wall when that was seen.
    pub at: Utc,
}

/// One reading of all clocks, taken once per decision so that a decision sees one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Now {
    /// Site clock.
    pub site: SiteTime,
    /// Link clock.
    pub link: LinkTime,
    /// UTC on the site clock: it runs `rate` times as fast as the wall in `dev`. Task records, deadlines.
    pub utc: Utc,
    /// UTC of the wall. Generations, session epochs, store sequence.
    pub wall: Utc,
    /// What the wall jumped in this run by more than an hour; none: it did not, or the site clock is a simulation's own.
    pub jump: Option<Jump>,
}

/// Where a service or an agent reads the time. Implemented by the programs over tokio's clock, so that a simulation can own it.
pub trait Clock: Send + Sync + 'static {
    /// All clocks at one moment.
    fn now(&self) -> Now;
    /// How fast the site clock runs, thousandths; 1000 is real time.
    fn rate_permille(&self) -> u32;
    /// The newest jump of the wall against the link clock in this run, however large.
    fn last_jump(&self) -> Option<Jump> {
        None
    }
    /// Why nothing may be signed by the wall now, and no time told that robots believe. None: it may.
    fn doubt(&self) -> Option<Doubt> {
        None
    }
    /// All clocks at a moment at which the wall is not in doubt, by one reading: what is signed has this time.
    ///
    /// # Errors
    /// Why nothing may be signed now.
    fn undoubted(&self) -> Result<Now, Doubt> {
        self.doubt().map_or_else(|| Ok(self.now()), Err)
    }
    /// Holds the wall of a start against the newest time that was written down before it.
    fn check_start(&self, _newest: Utc) {}
    /// A person says that the wall is right.
    fn accept_wall(&self) {}
}

/// Clocks of a simulation: a monotonic source in microseconds, a UTC base, and a rate. Their wall never jumps; that of a machine may, see
/// [`crate::wall_clock::WallClock`].
///
/// Scaled site time is advanced by reading it. If nobody read it for more than 2 s of site time the loop has fallen
/// behind, and the site clock slows instead of jumping: [`ScaledClock::site_elapsed_ms`] against the link clock gives the rate
/// that was really reached. At rate 1000 it never slows.
pub struct ScaledClock<F> {
    monotonic_us: F,
    utc_base: Utc,
    rate_permille: u32,
    state: std::sync::Mutex<(u64, u64)>,
}

/// The largest step of a scaled site clock between two readings, microseconds of site time.
const MAX_SITE_STEP_US: u64 = 2_000_000;

impl<F: Fn() -> u64 + Send + Sync + 'static> ScaledClock<F> {
    /// `monotonic_us` counts microseconds from an arbitrary start; `utc_base` is UTC at that start.
    pub fn new(monotonic_us: F, utc_base: Utc, rate_permille: u32) -> Self {
        Self { monotonic_us, utc_base, rate_permille, state: std::sync::Mutex::new((0, 0)) }
    }
    /// Site milliseconds since the start.
    pub fn site_elapsed_ms(&self) -> u64 {
        self.now().site.0
    }
}

impl<F: Fn() -> u64 + Send + Sync + 'static> Clock for ScaledClock<F> {
    fn now(&self) -> Now {
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let mono_us = (self.monotonic_us)().max(state.0);
        let step_us = (mono_us - state.0).saturating_mul(u64::from(self.rate_permille)) / 1000;
        let step_us = if self.rate_permille == 1000 { step_us } else { step_us.min(MAX_SITE_STEP_US) };
        *state = (mono_us, state.1 + step_us);
        let site_ms = state.1 / 1000;
        Now {
            site: SiteTime(site_ms),
            link: LinkTime(mono_us / 1000),
            utc: self.utc_base.plus_ms(site_ms),
            wall: self.utc_base.plus_ms(mono_us / 1000),
            jump: None,
        }
    }
    fn rate_permille(&self) -> u32 {
        self.rate_permille
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

    fn clock(rate: u32) -> (Arc<AtomicU64>, ScaledClock<impl Fn() -> u64 + Send + Sync + 'static>) {
        let us = Arc::new(AtomicU64::new(0));
        let source = us.clone();
        (us, ScaledClock::new(move || source.load(Relaxed), Utc(1_000), rate))
    }

    #[test]
    fn the_site_clock_runs_at_its_rate_and_the_link_clock_does_not() {
        let (us, clock) = clock(20_000);
        us.store(50_000, Relaxed);
        let now = clock.now();
        assert_eq!((now.site, now.link, now.utc, now.wall), (SiteTime(1_000), LinkTime(50), Utc(2_000), Utc(1_050)));
    }

    #[test]
    fn a_loop_that_fell_behind_slows_the_scaled_site_clock_only() {
        let (us, scaled) = clock(20_000);
        us.store(1_000_000, Relaxed);
        assert_eq!(scaled.now().site, SiteTime(2_000));
        let (us, real) = self::clock(1000);
        us.store(9_000_000, Relaxed);
        assert_eq!(real.now().site, SiteTime(9_000));
    }
}
