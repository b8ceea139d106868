//! What a launcher decides, without doing it: which set starts next, which try of it that is, and when a set on trial has had its tries.
//!
//! Standard library only, as the launcher. Invariant: a committed set is never put away; tries of one set do not count for another.
//! Called by [`crate::launcher`], and by a swarm in one process, whose agents have no launcher.

use crate::switch::Switch;
use std::time::Duration;

/// A set on trial is put away after so many starts that did not run well.
pub const TRIES_MAX: u32 = 2;
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
    pub fn of(&self, set: &str) -> u32 {
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
        Self::new(set, self.of(set).saturating_add(1))
    }
    /// The set ran well: none of them counts any more.
    pub fn clear(&mut self) {
        self.count = 0;
    }
    /// Time before the next start.
    pub fn pause(&self) -> Duration {
        let (first, longest) = PAUSE_MS;
        Duration::from_millis(first.saturating_mul(1 << self.count.saturating_sub(1).min(16)).min(longest))
    }
}

/// Puts a set on trial that has had its tries away: `current` runs next. Gives its tries; none: nothing changed.
pub fn put_away(switch: &mut Switch, tries: &Tries) -> Option<u32> {
    let had = tries.of(switch.running());
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
    use crate::switch::FACTORY;

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
        assert_eq!((tries.of("v1"), tries.of("v2")), (3, 0));
        assert_eq!((tries.plus_one("v1").of("v1"), tries.plus_one("v2").of("v2")), (4, 1));
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
    fn a_program_runs_well_after_thirty_pulses_and_each_thirty_more() {
        let well: Vec<u32> = (0..=60).filter(|pulses| is_well(*pulses)).collect();
        assert_eq!(well, [30, 60]);
    }
}
