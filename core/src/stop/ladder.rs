//! The silence ladder: a robot that the stop service does not answer slows down, then stands, by its own clock alone.
//!
//! A check-in carries a number that was never used before, and only its own answer feeds the ladder, as of the moment at which the robot *sent* it: a server
//! that hangs, or an answer that lay in a buffer, feeds nothing. The ladder does not latch: three good check-ins end it. Invariant: by the link clock, which
//! nothing scales; the less a robot knows of people around it, the shorter its patience.

use crate::limits;
use crate::time::{LinkDuration, LinkTime};

/// How far the silence has come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// It is answered.
    #[default]
    Heard,
    /// Drives slowly.
    Slow,
    /// Stands where it is.
    Stand,
}

/// Whether people may be around a robot. One that cannot tell says [`Around::People`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Around {
    /// An area without people.
    Robots,
    /// People, or nobody knows.
    People,
}

impl Around {
    /// From the last answered check-in to slowing down and to standing.
    pub const fn patience(self) -> (LinkDuration, LinkDuration) {
        match self {
            Self::Robots => (limits::SILENCE_SLOW, limits::SILENCE_STAND),
            Self::People => (limits::SILENCE_SLOW_PEOPLE, limits::SILENCE_STAND_PEOPLE),
        }
    }
}

/// One robot's ladder since it began.
#[derive(Clone, Debug)]
pub struct Ladder {
    /// When the newest check-in was sent that was answered; at first when the robot began.
    fed: LinkTime,
    /// When the stage rose last: only check-ins sent since then count for its end.
    risen: LinkTime,
    stage: Stage,
    good: u32,
}

impl Ladder {
    /// A robot that has heard nothing yet stands.
    pub const fn begin(now: LinkTime) -> Self {
        Self { fed: now, risen: now, stage: Stage::Stand, good: 0 }
    }

    /// The check-in that was sent at `sent` has its answer.
    pub fn answered(&mut self, sent: LinkTime) {
        if sent < self.fed {
            return;
        }
        self.fed = sent;
        if sent >= self.risen {
            self.good = self.good.saturating_add(1);
        }
    }

    /// How far it is at `now`.
    pub fn advance(&mut self, now: LinkTime, around: Around) -> Stage {
        let silence = now.since(self.fed);
        let (slow, stand) = around.patience();
        let due = match silence {
            silence if silence >= stand => Stage::Stand,
            silence if silence >= slow => Stage::Slow,
            _ => Stage::Heard,
        };
        if due > self.stage {
            (self.stage, self.risen, self.good) = (due, now, 0);
        } else if due > Stage::Heard {
            self.good = 0;
        } else if self.good >= limits::CHECK_INS_GOOD {
            self.stage = Stage::Heard;
        }
        self.stage
    }

    /// When to look again if nothing is answered before. None: it is as high as it gets.
    pub fn next_at(&self, around: Around) -> Option<LinkTime> {
        let (slow, stand) = around.patience();
        match self.stage {
            Stage::Heard => Some(self.fed + slow),
            Stage::Slow => Some(self.fed + stand),
            Stage::Stand => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn heard(ladder: &mut Ladder, seconds: std::ops::Range<u64>) {
        for s in seconds {
            ladder.answered(LinkTime(s * 1000));
        }
    }

    /// Heard in each second up to and with the third.
    fn at_ease() -> Ladder {
        let mut ladder = Ladder::begin(LinkTime(0));
        heard(&mut ladder, 1..4);
        assert_eq!(ladder.advance(LinkTime(3_000), Around::People), Stage::Heard);
        ladder
    }

    #[test]
    fn a_robot_that_begins_stands_until_it_was_answered_three_times() {
        let mut ladder = Ladder::begin(LinkTime(0));
        heard(&mut ladder, 1..3);
        assert_eq!(ladder.advance(LinkTime(2_500), Around::Robots), Stage::Stand);
        heard(&mut ladder, 3..4);
        assert_eq!(ladder.advance(LinkTime(3_500), Around::Robots), Stage::Heard);
    }

    #[test]
    fn silence_slows_and_then_stands_sooner_among_people() {
        for (around, slow, stand) in [(Around::Robots, 13_000, 33_000), (Around::People, 6_000, 9_000)] {
            let mut ladder = at_ease();
            for (at, stage) in
                [(slow - 1, Stage::Heard), (slow, Stage::Slow), (stand - 1, Stage::Slow), (stand, Stage::Stand)]
            {
                assert_eq!(ladder.advance(LinkTime(at), around), stage, "{around:?} at {at}");
            }
        }
    }

    #[test]
    fn twenty_seconds_of_silence_stand_among_people_and_only_slow_elsewhere() {
        assert_eq!(at_ease().advance(LinkTime(23_000), Around::Robots), Stage::Slow);
        assert_eq!(at_ease().advance(LinkTime(23_000), Around::People), Stage::Stand);
    }

    #[test]
    fn it_ends_after_three_good_check_ins_that_were_sent_since_it_rose() {
        let mut ladder = at_ease();
        assert_eq!(ladder.advance(LinkTime(33_000), Around::Robots), Stage::Stand);
        // Answers that lay in a buffer are to check-ins of before.
        heard(&mut ladder, 4..33);
        assert_eq!(ladder.advance(LinkTime(33_100), Around::Robots), Stage::Stand);
        heard(&mut ladder, 34..36);
        assert_eq!(ladder.advance(LinkTime(35_100), Around::Robots), Stage::Stand);
        heard(&mut ladder, 36..37);
        assert_eq!(ladder.advance(LinkTime(36_100), Around::Robots), Stage::Heard);
    }

    #[test]
    fn an_answer_to_an_older_check_in_feeds_nothing() {
        let mut ladder = at_ease();
        heard(&mut ladder, 1..3);
        assert_eq!(ladder.fed, LinkTime(3_000));
    }

    #[test]
    fn good_check_ins_count_from_new_after_another_silence() {
        let mut ladder = at_ease();
        ladder.advance(LinkTime(33_000), Around::Robots);
        heard(&mut ladder, 34..36);
        ladder.advance(LinkTime(35_000), Around::Robots);
        ladder.advance(LinkTime(46_000), Around::Robots);
        heard(&mut ladder, 46..48);
        assert_eq!(ladder.advance(LinkTime(47_000), Around::Robots), Stage::Stand);
        heard(&mut ladder, 48..49);
        assert_eq!(ladder.advance(LinkTime(48_000), Around::Robots), Stage::Heard);
    }
}
