//! The one clock of a shift: tokio's paused time, which goes on only while nobody has anything to do.
//!
//! Invariant: site time and link time are the same time, and nobody's clock is wrong.

use midshift_core::time::{Clock, LinkTime, Now, SiteTime, Utc};
use std::sync::Arc;
use tokio::time::Instant;

/// UTC at the beginning of every shift, unix milliseconds.
const BEGIN_UNIX_MS: i64 = 1_790_000_000_000;
/// The link clock has run so long already when a shift begins, milliseconds: a time of 0 means "never" to nobody.
const LINK_BEGIN_MS: u64 = 1_000;

/// Virtual time since the beginning of the shift.
pub struct VirtualClock {
    begun: Instant,
}

impl VirtualClock {
    /// A clock that begins now. Called on the runtime whose time is paused.
    pub fn begin() -> Arc<Self> {
        Arc::new(Self { begun: Instant::now() })
    }

    /// Milliseconds since the beginning.
    pub fn elapsed_ms(&self) -> u64 {
        Instant::now().duration_since(self.begun).as_millis() as u64
    }
}

impl Clock for VirtualClock {
    fn now(&self) -> Now {
        let ms = self.elapsed_ms();
        let utc = Utc(BEGIN_UNIX_MS).plus_ms(ms);
        Now { site: SiteTime(ms), link: LinkTime(LINK_BEGIN_MS + ms), utc, wall: utc, jump: None }
    }

    fn rate_permille(&self) -> u32 {
        1_000
    }
}
