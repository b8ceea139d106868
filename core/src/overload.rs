//! What is shed first when there is more to do than can be done: stop > control > events > status > bulk.
//!
//! Invariant: pure. Each method names its class in its .proto file, beside who may call it; the port sheds by it, and nothing else does: inside a session
//! lanes have an order of their own ([`crate::robot::Lane`]). A class never waits for one below it.

use crate::limits;

/// How long something is still done as a port fills up; lowest first. The wire names them in `midshift.common.v1.LoadClass`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Class {
    /// Many bytes that can wait.
    Bulk,
    /// How things are, which can be asked again.
    Status,
    /// What happened, in order.
    Events,
    /// What decides something, and the lines of robots.
    Control,
    /// Engaging a stop.
    Stop,
}

/// Naive rules, for twins of tests. Only with the feature `seeded-bugs`.
pub mod bugs {
    crate::seeded_bugs! {
        /// Every class is the highest one.
        ClassesAreAlike classes_are_alike;
        /// Each request leaves a seat taken behind it.
        SeatsAreKept seats_are_kept;
    }
}

impl Class {
    /// All, lowest first.
    pub const ALL: [Self; 5] = [Self::Bulk, Self::Status, Self::Events, Self::Control, Self::Stop];

    /// The class that counts.
    #[must_use]
    pub fn with(self, bugs: bugs::Bugs) -> Self {
        if bugs.classes_are_alike() { Self::Stop } else { self }
    }

    /// How many of `whole` may be taken when this class asks for one more; what is left over is for the classes above it. Each class above keeps
    /// [`limits::CLASS_KEPT_PERMILLE`] for itself, rounded down: what is too small to be divided is for everybody.
    pub const fn share(self, whole: usize) -> usize {
        let above = match self {
            Self::Bulk => 4,
            Self::Status => 3,
            Self::Events => 2,
            Self::Control => 1,
            Self::Stop => 0,
        };
        whole
            - whole / 1000 * limits::CLASS_KEPT_PERMILLE * above
            - whole % 1000 * limits::CLASS_KEPT_PERMILLE * above / 1000
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_class_leaves_something_to_those_above_it_and_the_highest_may_have_all() {
        let shares = |whole| Class::ALL.map(|class| class.share(whole));
        assert_eq!(shares(1_000), [600, 700, 800, 900, 1_000]);
        assert_eq!(shares(65_536), [39_322, 45_876, 52_429, 58_983, 65_536]);
        assert_eq!(shares(10), [6, 7, 8, 9, 10]);
    }

    #[test]
    fn what_is_too_small_to_be_divided_is_for_everybody_and_nothing_overflows() {
        assert_eq!(Class::ALL.map(|class| class.share(1)), [1; 5]);
        assert_eq!(Class::ALL.map(|class| class.share(0)), [0; 5]);
        assert!(Class::Bulk.share(usize::MAX) < Class::Stop.share(usize::MAX));
    }
}
