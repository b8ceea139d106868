//! What stops come to for one robot: the level that it obeys, and what a person has to resume before it moves again.
//!
//! Invariant: the level is the most restrictive of all that is known; once it was [`StopLevel::Halt`] or more by a stop, no message but that stop's reset *and* a
//! resume of it, in whatever order they arrive, lets the robot move. A robot that has not been told since it began, stands.
//! Kept by the agent in a file of its own, apart from the ledger of its work.

use super::ladder::{Around, Ladder, Stage};
use super::latch::{Latch, Reset, Stop};
use super::scope::Scope;
use crate::ids::{RobotId, StopId};
use crate::limits;
use crate::robot::{Pose, StopLevel};
use crate::time::{LinkTime, Now, Utc};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// The stops that an agent saves, so that they survive its end.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SavedStops {
    /// Stops and resets it was told of.
    pub latch: Latch,
    /// What stood it and was not resumed: stops, reset or not, and silences among people.
    pub awaiting: BTreeSet<StopId>,
    /// Public key of the stop service's marks, as the service said it. Empty: it has not said it yet.
    #[serde(default)]
    pub key: Vec<u8>,
}

/// What a robot does about stops at one moment.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Obeyed {
    /// The most restrictive of all.
    pub level: StopLevel,
    /// Effective stops that it lies inside of, the most restrictive first: a list that is cut off loses none that matters more than what it keeps.
    pub inside: Vec<StopId>,
    /// How far the silence has come.
    pub stage: Stage,
    /// [`SavedStops`] has changed and must be saved again.
    pub is_changed: bool,
}

/// One robot's stops since it began.
#[derive(Clone, Debug)]
pub struct RobotStop {
    robot_id: RobotId,
    saved: SavedStops,
    ladder: Ladder,
    is_told: bool,
    /// It was answered often enough since it began that a silence is one.
    was_heard: bool,
    silence: Option<StopId>,
}

impl RobotStop {
    /// A robot that begins with its saved stops.
    pub fn begin(robot_id: RobotId, saved: SavedStops, now: LinkTime) -> Self {
        Self { robot_id, saved, ladder: Ladder::begin(now), is_told: false, was_heard: false, silence: None }
    }

    /// The stops that must be saved.
    pub fn saved(&self) -> &SavedStops {
        &self.saved
    }

    /// The stop service has said all that is effective since it began.
    pub fn is_told(&self) -> bool {
        self.is_told
    }

    /// What waits for a person, at most `most`: a list that is cut loses silences before it loses a stop.
    pub fn awaiting(&self, most: usize) -> Vec<StopId> {
        let (silences, stops): (Vec<&StopId>, Vec<&StopId>) = self.saved.awaiting.iter().partition(|id| is_silence(id));
        stops.into_iter().chain(silences).take(most).cloned().collect()
    }

    /// When the silence comes further if nothing is answered before. None: it is as far as it gets.
    pub fn silence_at(&self, around: Around) -> Option<LinkTime> {
        self.ladder.next_at(around)
    }

    /// A stop for a part of the site is effective: driving alone may bring the robot into it.
    pub fn has_parts(&self) -> bool {
        self.saved.latch.effective().any(|stop| matches!(stop.scope, Scope::Zone(_) | Scope::Area(_)))
    }

    /// Merges the whole latch of the stop service. Returns whether anything is new.
    pub fn merge_snapshot(&mut self, all: Latch) -> bool {
        self.is_told = true;
        self.saved.latch.merge(all)
    }

    /// Merges stops and resets that the stop service sent since then. Returns whether anything is new.
    pub fn merge_changes(&mut self, stops: Vec<Stop>, resets: Vec<Reset>) -> bool {
        let engaged = stops.into_iter().fold(false, |new, stop| self.saved.latch.engage(stop) | new);
        // A reset that is saved needs its mark no more.
        let resets = resets.into_iter().map(|reset| Reset { proof: Vec::new(), ..reset });
        resets.fold(engaged, |new, reset| self.saved.latch.reset(reset) | new)
    }

    /// Sets the key of the stop service's marks; empty: the key stays. Returns whether it is another one.
    pub fn set_mark_key(&mut self, key: Vec<u8>) -> bool {
        let is_new = !key.is_empty() && key != self.saved.key;
        if is_new {
            self.saved.key = key;
        }
        is_new
    }

    /// Merges stops and resets that another sender than the stop service relayed. Returns whether anything is new.
    /// 1. Every stop counts.
    /// 2. A reset counts if `is_marked` confirms the stop service's mark and it is not older than its stop.
    /// 3. Absence proves nothing: a missing stop is not over, and `is_told` stays as it was.
    pub fn merge_relayed(&mut self, stops: Vec<Stop>, resets: Vec<Reset>, is_marked: impl Fn(&Reset) -> bool) -> bool {
        let engaged = self.merge_changes(stops, Vec::new());
        let latch = &self.saved.latch;
        let is_older =
            |reset: &Reset| latch.stop(&reset.stop_id).is_some_and(|stop| reset.reset_unix_ms < stop.engaged_unix_ms);
        let counts = |reset: &Reset| latch.reset_of(&reset.stop_id).is_none() && !is_older(reset) && is_marked(reset);
        let resets: Vec<Reset> = resets.into_iter().filter(counts).collect();
        self.merge_changes(Vec::new(), resets) || engaged
    }

    /// The check-in that was sent at `sent` has its answer.
    pub fn answered(&mut self, sent: LinkTime) {
        self.ladder.answered(sent);
    }

    /// People resumed these. One whose stop is still effective here waits for its reset. Whether anything changed.
    pub fn resumed(&mut self, stop_ids: &BTreeSet<StopId>) -> bool {
        let SavedStops { latch, awaiting, .. } = &mut self.saved;
        let before = awaiting.len();
        awaiting.retain(|id| !stop_ids.contains(id) || latch.is_effective(id));
        awaiting.len() < before
    }

    /// What to do at `now`, standing or driving at `pose`.
    pub fn advance(&mut self, now: &Now, pose: Option<&Pose>, around: Around) -> Obeyed {
        let mut is_changed = self.saved.latch.forget(now.wall, limits::RESETS_MAX);
        let stage = self.ladder.advance(now.link, around);
        self.was_heard |= stage < Stage::Stand;
        let mut over: Vec<(StopId, StopLevel)> =
            self.saved.latch.over(&self.robot_id, pose).map(|stop| (stop.stop_id.clone(), stop.level)).collect();
        over.sort_by_key(|(_, level)| std::cmp::Reverse(*level));
        for (stop_id, _) in over.iter().filter(|(_, level)| *level >= StopLevel::Halt) {
            is_changed |= self.saved.awaiting.insert(stop_id.clone());
        }
        is_changed |= self.silent(stage, around, now.wall);
        let stops = over.iter().map(|(_, level)| *level).max().unwrap_or_default();
        let held = if self.saved.awaiting.is_empty() { StopLevel::None } else { StopLevel::Halt };
        let silence = match stage {
            Stage::Heard => StopLevel::None,
            Stage::Slow => StopLevel::Slow,
            Stage::Stand if !self.is_told || !self.was_heard => StopLevel::Halt,
            Stage::Stand => StopLevel::ControlledStopPosture,
        };
        let untold = if self.is_told { StopLevel::None } else { StopLevel::Halt };
        let level = [stops, held, silence, untold].into_iter().max().unwrap_or_default();
        Obeyed { level, inside: over.into_iter().map(|(id, _)| id).collect(), stage, is_changed }
    }

    /// A silence that stood it among people is a person's to end; at its beginning nobody was heard yet, and it did not stand for people. While one waits for that,
    /// further ones add no name: a silence that is resumed while another goes on gives that one its name.
    fn silent(&mut self, stage: Stage, around: Around, wall: Utc) -> bool {
        if stage != Stage::Stand {
            self.silence = None;
            return false;
        }
        let has_name = self.silence.is_some() || self.saved.awaiting.iter().any(is_silence);
        if !self.is_told || !self.was_heard || around == Around::Robots || has_name {
            return false;
        }
        let named = format!("{SILENCE}{}-{}", self.robot_id, wall.0);
        self.silence = StopId::parse(&named).ok();
        self.silence.clone().is_some_and(|id| self.saved.awaiting.insert(id))
    }
}

/// How the names of silences begin; no stop that somebody engaged is named so.
const SILENCE: &str = "SILENCE-";

/// It names a silence that stood a robot, and no stop that somebody engaged.
pub fn is_silence(stop_id: &StopId) -> bool {
    stop_id.as_str().starts_with(SILENCE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::SiteTime;
    use std::collections::VecDeque;

    fn id(n: u8) -> StopId {
        StopId::parse(&format!("STOP-{n}")).expect("an id")
    }

    fn robot() -> RobotId {
        RobotId::parse("r1").expect("an id")
    }

    fn stop(n: u8, level: StopLevel) -> Stop {
        Stop::new(id(n), Scope::Fleet, level, Utc(1))
    }

    fn reset(n: u8) -> Reset {
        Reset::new(id(n), Utc(2))
    }

    fn at(ms: u64) -> Now {
        Now { site: SiteTime(ms), link: LinkTime(ms), utc: Utc(ms as i64), wall: Utc(ms as i64), jump: None }
    }

    /// Told of nothing, and answered in each second up to and with the third.
    fn free() -> RobotStop {
        let mut robot = RobotStop::begin(robot(), SavedStops::default(), LinkTime(0));
        robot.merge_snapshot(Latch::default());
        (1..4).for_each(|s| robot.answered(LinkTime(s * 1000)));
        assert_eq!(robot.advance(&at(3_000), None, Around::People).level, StopLevel::None);
        robot
    }

    #[test]
    fn a_robot_begins_stopped_until_it_was_told_and_answered() {
        let mut robot = RobotStop::begin(robot(), SavedStops::default(), LinkTime(0));
        assert_eq!(robot.advance(&at(0), None, Around::Robots).level, StopLevel::Halt);
        (1..4).for_each(|s| robot.answered(LinkTime(s * 1000)));
        assert_eq!(robot.advance(&at(3_000), None, Around::Robots).level, StopLevel::Halt, "answered, and not told");
        robot.merge_snapshot(Latch::default());
        assert_eq!(robot.advance(&at(3_000), None, Around::Robots).level, StopLevel::None);
        assert!(robot.saved().awaiting.is_empty(), "a start is no stop");
    }

    #[test]
    fn a_start_among_people_is_no_silence_however_long_it_takes_to_be_answered() {
        let mut robot = RobotStop::begin(robot(), SavedStops::default(), LinkTime(0));
        robot.merge_snapshot(Latch::default());
        for ms in [0, 5_000, 60_000] {
            assert_eq!(robot.advance(&at(ms), None, Around::People).level, StopLevel::Halt);
        }
        (60..63).for_each(|s| robot.answered(LinkTime(s * 1000)));
        assert_eq!(robot.advance(&at(62_500), None, Around::People).level, StopLevel::None);
        assert!(robot.saved().awaiting.is_empty());
    }

    #[test]
    fn what_another_than_the_stop_service_says_stops_and_frees_nothing_without_a_mark() {
        let mut robot = free();
        assert!(robot.merge_relayed(vec![stop(1, StopLevel::Halt)], vec![], |_| true));
        assert!(!robot.merge_relayed(vec![stop(1, StopLevel::Halt)], vec![], |_| true), "twice is once");
        assert_eq!(robot.advance(&at(3_100), None, Around::Robots).level, StopLevel::Halt);
        let older = Reset { reset_unix_ms: Utc(0), ..reset(1) };
        assert!(!robot.merge_relayed(vec![], vec![reset(1)], |_| false), "not marked");
        assert!(!robot.merge_relayed(vec![], vec![older], |_| true), "older than its stop");
        assert!(!robot.merge_relayed(vec![], vec![], |_| true), "absence");
        assert!(robot.saved().latch.is_effective(&id(1)));
        assert!(robot.merge_relayed(vec![], vec![Reset { proof: vec![1], ..reset(1) }], |_| true));
        assert_eq!(robot.saved().latch.reset_of(&id(1)), Some(&reset(1)), "its mark is not kept");
        assert_eq!(robot.advance(&at(3_200), None, Around::Robots).level, StopLevel::Halt, "it waits for a person");
    }

    #[test]
    fn of_more_stops_than_it_can_name_it_names_the_most_restrictive() {
        let mut robot = free();
        let slow = (0..limits::STOPS_MAX).map(|n| Stop {
            stop_id: StopId::parse(&format!("STOP-A{n}")).expect("an id"),
            ..stop(0, StopLevel::Slow)
        });
        let (last, posture) = (StopId::parse("STOP-Z").expect("an id"), StopLevel::ControlledStopPosture);
        let halts = [stop(9, StopLevel::Halt), Stop { stop_id: last.clone(), ..stop(0, posture) }];
        robot.merge_changes(slow.chain(halts).collect(), vec![]);
        let obeyed = robot.advance(&at(3_100), None, Around::Robots);
        assert_eq!((obeyed.level, obeyed.inside.len()), (posture, limits::STOPS_MAX + 2));
        assert_eq!(obeyed.inside[..2], [last, id(9)]);
    }

    #[test]
    fn slow_ends_with_its_reset_and_asks_for_no_resume() {
        let mut robot = free();
        robot.merge_changes(vec![stop(1, StopLevel::Slow)], vec![]);
        assert_eq!(robot.advance(&at(3_100), None, Around::Robots).level, StopLevel::Slow);
        robot.merge_changes(vec![], vec![reset(1)]);
        assert_eq!(robot.advance(&at(3_200), None, Around::Robots).level, StopLevel::None);
    }

    #[test]
    fn a_silence_among_people_waits_for_a_resume_and_elsewhere_it_does_not() {
        for (around, level) in [(Around::People, StopLevel::Halt), (Around::Robots, StopLevel::None)] {
            let mut robot = free();
            assert_eq!(robot.advance(&at(60_000), None, around).level, StopLevel::ControlledStopPosture);
            (60..63).for_each(|s| robot.answered(LinkTime(s * 1000)));
            assert_eq!(robot.advance(&at(62_000), None, around).level, level, "{around:?}");
            let silences = robot.saved().awaiting.clone();
            assert_eq!(silences.len(), usize::from(around == Around::People));
            assert!(silences.iter().all(is_silence) && !is_silence(&id(1)));
            robot.resumed(&silences);
            assert_eq!(robot.advance(&at(62_100), None, around).level, StopLevel::None);
        }
    }

    /// It is silent for so long, and answered again.
    fn silence(robot: &mut RobotStop, at_s: u64) {
        robot.advance(&at(at_s * 1_000), None, Around::People);
        (at_s..at_s + 3).for_each(|s| robot.answered(LinkTime(s * 1_000)));
        robot.advance(&at(at_s * 1_000 + 2_500), None, Around::People);
    }

    #[test]
    fn while_one_silence_waits_for_a_resume_further_ones_add_no_name_and_the_next_has_a_new_one() {
        let mut robot = free();
        silence(&mut robot, 60);
        let first = robot.saved().awaiting.clone();
        (2..20).for_each(|n| silence(&mut robot, n * 60));
        assert_eq!((first.len(), &robot.saved().awaiting), (1, &first));
        robot.resumed(&first);
        assert_eq!(robot.advance(&at(1_200_000 - 57_000), None, Around::People).level, StopLevel::None);
        silence(&mut robot, 1_200);
        let second = robot.saved().awaiting.clone();
        assert!(second.len() == 1 && second.is_disjoint(&first), "{second:?}");
        // The first is resumed while the next one goes on: nobody has seen that one.
        let mut robot = free();
        silence(&mut robot, 60);
        robot.advance(&at(120_000), None, Around::People);
        robot.resumed(&first);
        robot.advance(&at(120_100), None, Around::People);
        let next = robot.saved().awaiting.clone();
        assert!(next.len() == 1 && next.is_disjoint(&first), "{next:?}");
        robot.resumed(&next);
        robot.advance(&at(120_200), None, Around::People);
        assert!(robot.saved().awaiting.is_empty(), "a person saw that one");
    }

    #[test]
    fn a_latch_full_of_silences_or_stops_takes_a_stop_and_names_it_before_every_silence() {
        let silences = (0..2 * limits::STOPS_MAX).map(|n| StopId::parse(&format!("{SILENCE}r1-{n}")).expect("an id"));
        let saved = SavedStops { awaiting: silences.collect(), ..SavedStops::default() };
        let mut full_of_silences = RobotStop::begin(robot(), saved, LinkTime(0));
        full_of_silences.merge_changes(vec![stop(1, StopLevel::Halt)], vec![]);
        let obeyed = full_of_silences.advance(&at(100), None, Around::Robots);
        assert_eq!((obeyed.inside, full_of_silences.awaiting(limits::STOPS_MAX)[0].clone()), (vec![id(1)], id(1)));
        let mut full_of_stops = free();
        let named = |n: usize| StopId::parse(&format!("STOP-A{n}")).expect("an id");
        let many = (0..2 * limits::STOPS_MAX).map(|n| Stop { stop_id: named(n), ..stop(0, StopLevel::Halt) });
        full_of_stops.merge_changes(many.collect(), vec![]);
        full_of_stops.advance(&at(3_100), None, Around::Robots);
        full_of_stops.merge_changes(vec![stop(2, StopLevel::ControlledStopPosture)], vec![]);
        let obeyed = full_of_stops.advance(&at(3_200), None, Around::Robots);
        assert_eq!((obeyed.level, &obeyed.inside[0]), (StopLevel::ControlledStopPosture, &id(2)));
        assert!(full_of_stops.saved().awaiting.contains(&id(2)));
    }

    #[test]
    fn a_resume_that_overtakes_the_reset_waits_for_it() {
        let mut robot = free();
        robot.merge_changes(vec![stop(1, StopLevel::Halt)], vec![]);
        robot.advance(&at(3_100), None, Around::Robots);
        assert!(!robot.resumed(&[id(1)].into()));
        robot.merge_changes(vec![], vec![reset(1)]);
        assert_eq!(robot.advance(&at(3_200), None, Around::Robots).level, StopLevel::Halt);
        assert!(robot.resumed(&[id(1)].into()));
        assert_eq!(robot.advance(&at(3_300), None, Around::Robots).level, StopLevel::None);
    }

    /// What may happen to a robot, at any time and in any order.
    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    enum Happens {
        Engaged(u8),
        Reset(u8),
        Resumed(u8),
        /// People resume the silences that it waits for.
        SilencesResumed,
        ToldAll,
        Answered,
        /// Nobody answers for a minute.
        Silence,
        /// It comes to people, or leaves them.
        Walked,
        /// What was reset is forgotten by its age.
        Forgot,
        Began,
    }

    /// Of one stop: it stood the robot, it was reset, and resumed after that.
    type Facts = [(bool, bool, bool); 2];

    #[derive(Clone)]
    struct Walk {
        robot: RobotStop,
        facts: Facts,
        around: Around,
        link_ms: u64,
        level: StopLevel,
        stage: Stage,
    }

    impl Walk {
        fn after(&self, happens: Happens) -> Self {
            let mut next = self.clone();
            let mut wall = Utc(3);
            match happens {
                Happens::Engaged(n) => {
                    // A name that was forgotten here is a new stop.
                    let latch = &next.robot.saved.latch;
                    if latch.stop(&id(n)).is_none() && latch.reset_of(&id(n)).is_none() {
                        next.facts[usize::from(n) - 1] = Default::default();
                    }
                    next.robot.merge_changes(vec![stop(n, StopLevel::Halt)], vec![]);
                }
                Happens::Reset(n) => {
                    next.robot.merge_changes(vec![], vec![reset(n)]);
                    next.facts[usize::from(n) - 1].1 = true;
                }
                Happens::Resumed(n) => {
                    next.robot.resumed(&[id(n)].into());
                    let fact = &mut next.facts[usize::from(n) - 1];
                    fact.2 |= fact.1;
                }
                Happens::SilencesResumed => {
                    let silences = next.silences();
                    next.robot.resumed(&silences);
                }
                Happens::ToldAll => {
                    next.robot.merge_snapshot(Latch::default());
                }
                Happens::Answered => {
                    (1..4).for_each(|s| next.robot.answered(LinkTime(self.link_ms + s * 1_000)));
                    next.link_ms += 3_000;
                }
                Happens::Silence => next.link_ms += 60_000,
                Happens::Walked => {
                    next.around = if self.around == Around::People { Around::Robots } else { Around::People };
                }
                Happens::Forgot => wall = wall.plus_ms(2 * limits::RESETS_KEPT.as_ms()),
                Happens::Began => {
                    let saved = next.robot.saved().clone();
                    next.robot = RobotStop::begin(robot(), saved, LinkTime(self.link_ms));
                }
            }
            let obeyed = next.robot.advance(&Now { wall, ..at(next.link_ms) }, None, next.around);
            (next.level, next.stage) = (obeyed.level, obeyed.stage);
            for (n, fact) in [1, 2].into_iter().zip(&mut next.facts) {
                fact.0 |= next.robot.saved().awaiting.contains(&id(n));
            }
            next
        }

        fn silences(&self) -> BTreeSet<StopId> {
            self.robot.saved().awaiting.iter().filter(|id| is_silence(id)).cloned().collect()
        }

        fn is_free(&self) -> bool {
            self.level < StopLevel::Halt
        }

        /// All of it but the moment.
        fn key(&self) -> impl Ord + use<> {
            let RobotStop { saved, is_told, was_heard, silence, .. } = &self.robot;
            let of = |n| (saved.latch.stop(&id(n)).is_some(), saved.latch.reset_of(&id(n)).is_some());
            let around = (self.around, self.stage, silence.is_some());
            ([of(1), of(2)], saved.awaiting.clone(), *is_told, *was_heard, around, self.facts)
        }
    }

    /// Walks every state that two stops, their resets and resumes, silences with and without people, what is forgotten, restarts and answers lead to.
    #[test]
    fn no_way_leads_from_standing_to_moving_without_a_reset_and_a_resume_of_each_stop() {
        let all = [1, 2].into_iter().flat_map(|n| [Happens::Engaged(n), Happens::Reset(n), Happens::Resumed(n)]);
        let others = [Happens::ToldAll, Happens::Answered, Happens::Began, Happens::Silence, Happens::Walked];
        let all: Vec<Happens> = all.chain(others).chain([Happens::Forgot, Happens::SilencesResumed]).collect();
        let first = Walk {
            robot: RobotStop::begin(robot(), SavedStops::default(), LinkTime(0)),
            facts: Facts::default(),
            around: Around::Robots,
            link_ms: 0,
            level: StopLevel::Halt,
            stage: Stage::Stand,
        };
        let (mut seen, mut todo) = (BTreeSet::from([first.key()]), VecDeque::from([first]));
        let (mut stood_and_moved, mut let_go_of_silence) = (0, 0);
        while let Some(before) = todo.pop_front() {
            for happens in &all {
                let after = before.after(*happens);
                let silences = after.silences();
                if after.is_free() {
                    let facts = after.facts.iter();
                    assert!(
                        facts.clone().all(|(stood, was_reset, was_resumed)| !stood || *was_reset && *was_resumed),
                        "{happens:?} freed {:?}",
                        after.robot
                    );
                    assert!(silences.is_empty(), "{happens:?} freed it from a silence: {:?}", after.robot);
                    stood_and_moved += facts.filter(|fact| fact.0).count();
                }
                // Only people end what a silence among people began, and every such silence that stood a moving robot begins it.
                let is_resumed = *happens == Happens::SilencesResumed;
                assert!(is_resumed || silences.is_superset(&before.silences()), "{happens:?}: {:?}", after.robot);
                let was_among = before.is_free() && before.around == Around::People;
                assert!(!was_among || *happens != Happens::Silence || !silences.is_empty(), "{:?}", after.robot);
                let_go_of_silence += usize::from(is_resumed && after.is_free() != before.is_free());
                if seen.insert(after.key()) {
                    todo.push_back(after);
                }
            }
        }
        assert!(seen.len() > 1_000 && stood_and_moved > 0 && let_go_of_silence > 0, "{} states", seen.len());
    }
}
