//! What a launcher decides, without doing it: which set starts next, which try of it that is, and when a set on trial
//! has had its tries.
//!
//! Standard library only, as the launcher. Invariant: a committed set is never put away; tries of one set do not count
//! for another. Called by [`crate::launcher`], and by a swarm in one process, whose agents have no launcher.

use super::switch::Switch;
use std::io;
use std::time::Duration;

/// A set on trial is put away after so many starts that did not run well.
pub const TRIES_MAX: u32 = 2;
/// Failures of its environment in a row are waited out so long before the kept set shows whether they are a trial's
/// own.
pub const ENVIRONMENT_WAIT: Duration = Duration::from_secs(600);
/// Without a pulse for so many seconds a program hangs.
pub const HANG_SECONDS: u64 = 15;
/// After so many pulses a program runs well and its tries count from 0 again.
const WELL_AFTER_PULSES: u32 = 30;
/// First and longest pause before the next start, milliseconds.
const PAUSE_MS: (u64, u64) = (250, 30_000);

/// Starts of one set that did not run well. Its text is the launcher's record.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tries {
    set: String,
    count: u32,
}

impl Tries {
    /// So many of `set`.
    pub fn new(set: &str, count: u32) -> Self {
        Self { set: set.to_owned(), count }
    }
    /// Those of `set`: those of another do not count.
    pub fn count_of(&self, set: &str) -> u32 {
        if self.set == set { self.count } else { 0 }
    }
    /// From its text. One that is none counts nothing; lines of a newer version are not looked at.
    pub fn parse(text: &str) -> Self {
        let read = || {
            let (count, set) = text.lines().next()?.trim().strip_prefix("tries ")?.split_once(" of ")?;
            Some(Self::new(set, count.parse().ok()?))
        };
        read().unwrap_or_default()
    }
    /// For the record.
    pub fn text(&self) -> String {
        format!("tries {} of {}\n", self.count, self.set)
    }
    /// With one start more of `set`.
    pub fn plus_one(&self, set: &str) -> Self {
        Self::new(set, self.count_of(set).saturating_add(1))
    }
    /// The set ran well: none of them counts any more.
    pub fn clear(&mut self) {
        self.count = 0;
    }
    /// Time before the next start.
    pub fn pause(&self) -> Duration {
        pause_after(self.count)
    }
}

/// The pause after so many failures in a row.
fn pause_after(failures: u32) -> Duration {
    let (first, longest) = PAUSE_MS;
    Duration::from_millis(first.saturating_mul(1 << failures.saturating_sub(1).min(16)).min(longest))
}

/// Starts in a row that their environment failed: a lock that is taken, a full disk, a device that is missing. They are
/// tries of no set.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Environment {
    /// When the first one of the set on trial failed, on the launcher's own clock.
    since: Option<Duration>,
    /// All of them.
    count: u32,
    /// The kept set was started in place of the one on trial.
    asks_kept: bool,
}

impl Environment {
    /// A start was failed by it. True: it was the kept set's, so the one on trial is not to blame, and is tried as long
    /// once more.
    pub fn failed(&mut self, now: Duration) -> bool {
        let asked = std::mem::take(&mut self.asks_kept);
        self.count = self.count.saturating_add(1);
        self.since = if asked { None } else { self.since.or(Some(now)) };
        asked
    }
    /// A program ran well, or ended in another way.
    pub fn passed(&mut self) {
        *self = Self::default();
    }
    /// Whether the kept set is started now in place of the one on trial, which was failed for `patience`.
    pub fn asks_kept(&mut self, switch: &Switch, patience: Duration, now: Duration) -> bool {
        let is_long = self.since.is_some_and(|since| now.saturating_sub(since) >= patience);
        self.asks_kept = switch.trial.is_some() && is_long;
        self.asks_kept
    }
    /// Time before the next start.
    pub fn pause(&self) -> Duration {
        pause_after(self.count)
    }
}

/// Whether an error of the system is one of the environment, which no set is to blame for.
pub fn is_of_environment(error: &io::Error) -> bool {
    use io::ErrorKind::{OutOfMemory, QuotaExceeded, ReadOnlyFilesystem, ResourceBusy, StorageFull, WouldBlock};
    matches!(error.kind(), OutOfMemory | QuotaExceeded | ReadOnlyFilesystem | ResourceBusy | StorageFull | WouldBlock)
}

/// Puts a set on trial that has had its tries away: `current` runs next. Gives its tries; none: nothing changed.
pub fn put_away(switch: &mut Switch, tries: &Tries) -> Option<u32> {
    let had = tries.count_of(switch.running());
    let is_over = switch.trial.is_some() && had >= TRIES_MAX;
    is_over.then(|| {
        switch.fall_back(had);
        had
    })
}

/// Whether so many pulses mean that the program runs well, if its set [`is_trusted`].
pub const fn is_well(pulses: u32) -> bool {
    pulses > 0 && pulses.is_multiple_of(WELL_AFTER_PULSES)
}

/// Whether a program that runs well clears its tries: a set on probation is not believed before it is proven.
pub fn is_trusted(switch: &Switch) -> bool {
    switch.trial.as_ref().is_none_or(|trial| trial.is_proven)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::launcher::switch::FACTORY;

    #[test]
    fn pauses_grow_to_a_limit() {
        let pauses: Vec<_> = [1, 2, 3, 40].map(|count| Tries::new("v1", count).pause().as_millis()).into();
        assert_eq!(pauses, [250, 500, 1_000, 30_000]);
    }

    #[test]
    fn a_record_is_read_back_and_a_damaged_one_counts_nothing() {
        let tries = Tries::new("v1", 3);
        assert_eq!(Tries::parse(&tries.text()), tries);
        assert_eq!(Tries::parse(&format!("{}mood curious\n", tries.text())), tries);
        assert_eq!((tries.count_of("v1"), tries.count_of("v2")), (3, 0));
        assert_eq!((tries.plus_one("v1").count_of("v1"), tries.plus_one("v2").count_of("v2")), (4, 1));
        for text in ["", "tries", "tries x of v1", "tries 3"] {
            assert_eq!(Tries::parse(text), Tries::default(), "{text}");
        }
    }

    #[test]
    fn a_set_on_trial_is_put_away_after_its_tries_and_a_committed_one_never() {
        let mut switch = Switch::default();
        switch.try_out("v1");
        assert!(!is_trusted(&switch));
        assert_eq!(put_away(&mut switch, &Tries::new("v1", TRIES_MAX - 1)), None);
        assert_eq!(put_away(&mut switch, &Tries::new("v0", TRIES_MAX)), None, "tries of another set");
        assert_eq!(put_away(&mut switch, &Tries::new("v1", TRIES_MAX)), Some(TRIES_MAX));
        assert_eq!((switch.running(), is_trusted(&switch)), (FACTORY, true));
        switch.try_out("v2");
        switch.prove();
        assert!(is_trusted(&switch));
        switch.commit();
        assert_eq!(put_away(&mut switch, &Tries::new("v2", 40)), None);
    }

    #[test]
    fn the_kept_set_is_asked_after_ten_minutes_of_failures_in_a_row_and_a_trial_that_shares_them_waits_as_long_again() {
        let mut switch = Switch::default();
        let second = Duration::from_secs;
        let mut environment = Environment::default();
        assert!(!environment.failed(second(5)));
        assert!(!environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(9_000)), "nothing is on trial");
        switch.try_out("v1");
        assert!(!environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(604)));
        assert!(!environment.failed(second(604)));
        assert!(environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(605)));
        assert!(environment.failed(second(606)), "it was the kept set's");
        assert!(!environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(9_000)), "the trial has not failed since");
        assert!(!environment.failed(second(610)));
        assert!(!environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(1_209)));
        assert!(environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(1_210)));
        environment.passed();
        assert!(!environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(9_000)));
        assert!(!environment.failed(second(9_001)), "they are counted anew");
        assert!(!environment.asks_kept(&switch, ENVIRONMENT_WAIT, second(9_600)));
    }

    #[test]
    fn a_program_runs_well_after_thirty_pulses_and_each_thirty_more() {
        let well: Vec<u32> = (0..=60).filter(|pulses| is_well(*pulses)).collect();
        assert_eq!(well, [30, 60]);
    }
}
