//! A moment between which and another one milliseconds count, whatever is done to the wall clock meanwhile.
//!
//! Invariant: moments of one run of the server are compared on its link clock; only between two runs is the wall all
//! there is.

use crate::time::{LinkTime, Now, Utc};
use serde::{Deserialize, Serialize};

/// When something was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    /// UTC of the wall.
    pub wall_unix_ms: Utc,
    /// UTC of the wall when the run of the server began that saw it.
    pub run_started_unix_ms: Utc,
    /// The link clock of that run.
    pub link_ms: LinkTime,
}

impl Stamp {
    /// `now`, in the run that began at `started`.
    pub const fn new(now: &Now, started: &Now) -> Self {
        Self { wall_unix_ms: now.wall, run_started_unix_ms: started.wall, link_ms: now.link }
    }

    /// Milliseconds from `earlier` to `self`; zero if `earlier` is later.
    pub const fn ms_since(&self, earlier: &Self) -> u64 {
        if self.run_started_unix_ms.0 == earlier.run_started_unix_ms.0 {
            self.link_ms.since(earlier.link_ms).as_ms()
        } else {
            self.wall_unix_ms.ms_since(earlier.wall_unix_ms)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_clock_that_is_set_back_makes_nothing_shorter_and_another_run_has_only_the_wall() {
        let at = |wall: i64, link: u64| Now { wall: Utc(wall), link: LinkTime(link), ..Now::default() };
        let (first, second) = (at(1_000, 5), at(50_000, 5));
        let parked = Stamp::new(&at(10_000, 9_000), &first);
        assert_eq!(Stamp::new(&at(2_000, 9_400), &first).ms_since(&parked), 400);
        assert_eq!(Stamp::new(&at(50_300, 300), &second).ms_since(&parked), 40_300);
    }
}
