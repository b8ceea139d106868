//! When a stop service that answers nothing is ended, so that another takes its place.
//!
//! Invariant: a look counts only if whoever looked was on time itself: a machine that stood still, or has no time for its checker, says nothing of the service.
//! Called by what looks after a stop service on one box. Absent on purpose: which process that is, and how it is ended.

use crate::limits;
use crate::time::LinkTime;

/// One look at the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Look {
    /// When it was to begin.
    pub due: LinkTime,
    /// When it began.
    pub begun: LinkTime,
    /// When it was over, answered or given up.
    pub ended: LinkTime,
    /// What came back.
    pub answer: Answer,
}

/// What came back.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// It serves.
    Heard,
    /// Nothing, within [`limits::STOP_LOOK_WITHIN`].
    None,
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It answers, or it is not known yet that it does not.
    Leave,
    /// It hangs: its process is ended.
    Kill,
    /// It hangs, and one was ended a moment ago: a person is told.
    Tell,
}

/// What has been seen of the service on one port.
#[derive(Clone, Debug, Default)]
pub struct Hung {
    missed: u32,
    killed: Option<LinkTime>,
}

impl Look {
    fn is_on_time(&self) -> bool {
        let (late, took) = (self.begun.since(self.due), self.ended.since(self.begun));
        let most = limits::STOP_LOOK_WITHIN.as_ms() + limits::STOP_LOOK_LATE.as_ms();
        late <= limits::STOP_LOOK_LATE && took.as_ms() <= most
    }
}

impl Hung {
    /// Counts one look. A kill that it asks for counts as done.
    pub fn saw(&mut self, look: Look) -> Verdict {
        if look.answer == Answer::Heard || !look.is_on_time() {
            self.missed = 0;
            return Verdict::Leave;
        }
        self.missed += 1;
        if self.missed < limits::STOP_LOOKS_MISSED {
            return Verdict::Leave;
        }
        if self.killed.is_some_and(|at| look.ended.since(at) < limits::STOP_KILL_EVERY) {
            return Verdict::Tell;
        }
        (self.missed, self.killed) = (0, Some(look.ended));
        Verdict::Kill
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One look that takes its whole second.
    fn look_at(at_ms: u64, answer: Answer) -> Look {
        Look { due: LinkTime(at_ms), begun: LinkTime(at_ms), ended: LinkTime(at_ms + 1_000), answer }
    }

    /// Verdicts of looks in vain, one after the other from a moment on.
    fn in_vain(hung: &mut Hung, from_ms: u64, looks: u64) -> Vec<Verdict> {
        (0..looks).map(|n| hung.saw(look_at(from_ms + n * 1_000, Answer::None))).collect()
    }

    #[test]
    fn three_looks_in_a_row_in_vain_end_it_and_an_answer_begins_anew() {
        use Verdict::{Kill, Leave};
        let mut hung = Hung::default();
        assert_eq!(in_vain(&mut hung, 0, 2), [Leave, Leave]);
        assert_eq!(hung.saw(look_at(2_000, Answer::Heard)), Leave);
        assert_eq!(in_vain(&mut hung, 3_000, 3), [Leave, Leave, Kill]);
    }

    #[test]
    fn a_look_of_a_checker_that_was_late_itself_counts_for_nothing() {
        use Verdict::{Kill, Leave};
        let late = limits::STOP_LOOK_LATE.as_ms() + 1;
        let began_late =
            |at| Look { begun: LinkTime(at + late), ended: LinkTime(at + late + 1_000), ..look_at(at, Answer::None) };
        let ended_late = |at| Look { ended: LinkTime(at + 1_000 + late), ..look_at(at, Answer::None) };
        for late in [began_late(2_000), ended_late(2_000)] {
            let mut hung = Hung::default();
            assert_eq!(in_vain(&mut hung, 0, 2), [Leave, Leave]);
            assert_eq!(hung.saw(late), Leave, "{late:?}");
            assert_eq!(in_vain(&mut hung, 10_000, 3), [Leave, Leave, Kill], "and those before it no more");
        }
    }

    #[test]
    fn one_process_is_ended_in_thirty_seconds_and_meanwhile_a_person_is_told() {
        use Verdict::{Kill, Leave, Tell};
        let mut hung = Hung::default();
        assert_eq!(in_vain(&mut hung, 0, 3), [Leave, Leave, Kill]);
        assert_eq!(in_vain(&mut hung, 3_000, 4), [Leave, Leave, Tell, Tell]);
        // Ended at 3 s.
        assert_eq!(hung.saw(look_at(31_999, Answer::None)), Tell);
        assert_eq!(hung.saw(look_at(32_000, Answer::None)), Kill);
        assert_eq!(in_vain(&mut hung, 33_000, 3), [Leave, Leave, Tell]);
    }
}
