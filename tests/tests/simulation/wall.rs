//! The wall of the server's machine: it goes with true time, and a test may set it.
//!
//! Invariant: only what the server reads as UTC is set, as on a machine; site clock and link clock go on. While nobody sets it the server has the clock that it
//! would have anyway.

use crate::clock::{BEGIN_UNIX_MS, MachineClock, Skew, TrueTime};
use midshift_core::time::{Clock, Doubt, Jump, Now, Utc};
use midshift_core::wall_clock::WallClock;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering::Relaxed};

/// What the wall says; clones are the same wall.
#[derive(Clone)]
pub struct ServerWall {
    time: TrueTime,
    ahead_ms: Arc<AtomicI64>,
    is_believed: Arc<AtomicBool>,
}

impl ServerWall {
    /// One that nobody has set.
    pub fn new(time: &TrueTime) -> Self {
        Self { time: time.clone(), ahead_ms: Arc::default(), is_believed: Arc::default() }
    }
    /// Sets it so far ahead of true time, milliseconds.
    pub fn set(&self, ahead_ms: i64) {
        self.ahead_ms.store(ahead_ms, Relaxed);
    }
    /// The naive rule: the server is never in doubt, whatever its wall did.
    pub fn believe(&self) {
        self.is_believed.store(true, Relaxed);
    }
    /// The clocks of a server that starts now.
    pub fn boot(&self) -> Arc<dyn Clock> {
        let machine = MachineClock::boot(&self.time, Skew::default());
        let (link, time, ahead_ms) = (machine.clone(), self.time.clone(), self.ahead_ms.clone());
        let wall = move || Utc(BEGIN_UNIX_MS + ahead_ms.load(Relaxed)).plus_ms(time.us() / 1000);
        let wall = Box::new(WallClock::new(move || link.now().link.0 * 1000, wall, |_| {}));
        Arc::new(ServerClock { machine, wall, is_believed: self.is_believed.clone() })
    }
}

struct ServerClock {
    machine: Arc<dyn Clock>,
    wall: Box<dyn Clock>,
    is_believed: Arc<AtomicBool>,
}

impl Clock for ServerClock {
    fn now(&self) -> Now {
        let Now { utc, wall, jump, .. } = self.wall.now();
        Now { utc, wall, jump, ..self.machine.now() }
    }
    fn rate_permille(&self) -> u32 {
        self.machine.rate_permille()
    }
    fn last_jump(&self) -> Option<Jump> {
        self.wall.last_jump()
    }
    fn doubt(&self) -> Option<Doubt> {
        self.wall.doubt().filter(|_| !self.is_believed.load(Relaxed))
    }
}
