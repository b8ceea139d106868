//! The latch: named stops and named resets. What is engaged and not reset, is effective.
//!
//! Invariant: two latches have one join, whatever the order and however often ([`Latch::merge`]), and the join of two never has less effective
//! than both know of. A reset names its stop, so a late one cannot take a newer stop away, and one that comes before its stop still counts.
//! Kept in a file by the stop service and by each robot.

use super::region::Region;
use super::scope::Scope;
use crate::identity::TokenId;
use crate::ids::{RobotId, StopId};
use crate::limits;
use crate::robot::{Pose, StopLevel};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One stop, as it was engaged.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Stop {
    /// Its name. Never used again.
    pub stop_id: StopId,
    /// Whom it is for.
    pub scope: Scope,
    /// What they do. Never [`StopLevel::None`].
    pub level: StopLevel,
    /// When, UTC of the stop service's wall. For people, and for how long names are remembered.
    pub engaged_unix_ms: Utc,
    /// The actor that engaged it, by name.
    pub actor: String,
    /// Why, in a person's words, at most [`limits::REASON_BYTES_MAX`] bytes. Empty: none was given.
    pub reason: String,
    /// Where, if it is for a part of the site. None: it could not be told, and everybody lies inside.
    pub region: Option<Region>,
    /// The stop service's own mark on it, so that it knows a stop of its own again that a robot brings back. Robots keep it and do not read it.
    #[serde(default)]
    pub proof: Vec<u8>,
    /// The token that was shown for it, which stands in the audit; none: none was, or it came over the wire.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub token_id: Option<TokenId>,
}

impl Stop {
    /// One of which nothing more is known: nobody has signed it, given a reason, or said where it is.
    pub fn new(stop_id: StopId, scope: Scope, level: StopLevel, engaged_unix_ms: Utc) -> Self {
        Self {
            stop_id,
            scope,
            level,
            engaged_unix_ms,
            actor: String::new(),
            reason: String::new(),
            region: None,
            proof: Vec::new(),
            token_id: None,
        }
    }

    /// Whether a robot lies inside. One that does not know where it is, lies inside.
    pub fn includes(&self, robot_id: &RobotId, pose: Option<&Pose>) -> bool {
        match &self.scope {
            Scope::Robot(id) => id == robot_id,
            Scope::Fleet => true,
            Scope::Zone(_) | Scope::Area(_) => self.region.as_ref().is_none_or(|region| region.includes(pose)),
        }
    }

    /// Of two tellings of one stop the one that stops more: wider, more restrictive, and anywhere if one does not say where.
    fn join(self, other: Self) -> Self {
        let region = match self.scope.cmp(&other.scope) {
            std::cmp::Ordering::Less => other.region,
            std::cmp::Ordering::Greater => self.region,
            std::cmp::Ordering::Equal if self.region == other.region => self.region,
            std::cmp::Ordering::Equal => None,
        };
        Self {
            region,
            scope: self.scope.max(other.scope),
            level: self.level.max(other.level),
            engaged_unix_ms: self.engaged_unix_ms.max(other.engaged_unix_ms),
            actor: self.actor.max(other.actor),
            reason: self.reason.max(other.reason),
            proof: self.proof.max(other.proof),
            token_id: self.token_id.max(other.token_id),
            stop_id: self.stop_id,
        }
    }
}

/// One reset.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Reset {
    /// Which stop.
    pub stop_id: StopId,
    /// When, UTC of the stop service's wall.
    pub reset_unix_ms: Utc,
    /// The actor that reset it, by name.
    pub actor: String,
    /// Why, in a person's words.
    pub reason: String,
    /// The stop service's own mark on it, by which a robot believes it when it comes by another way than from the service itself. Empty: it counts there alone.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub proof: Vec<u8>,
    /// The token that was shown for it, which stands in the audit; none: none was, or it came over the wire.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub token_id: Option<TokenId>,
}

impl Reset {
    /// One of which nothing more is known: nobody has signed it or given a reason.
    pub fn new(stop_id: StopId, reset_unix_ms: Utc) -> Self {
        Self { stop_id, reset_unix_ms, actor: String::new(), reason: String::new(), proof: Vec::new(), token_id: None }
    }
}

/// Named stops minus named resets.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Latch {
    stops: BTreeMap<StopId, Stop>,
    resets: BTreeMap<StopId, Reset>,
    /// When the newest of those was engaged that were forgotten with their reset; 0: none was.
    #[serde(rename = "forgotten_unix_ms", default, skip_serializing_if = "is_never")]
    forgotten: Utc,
}

fn is_never(at: &Utc) -> bool {
    *at == Utc(0)
}

impl Latch {
    /// Adds a stop. Whether anything is new.
    pub fn engage(&mut self, stop: Stop) -> bool {
        let known = self.stops.get(&stop.stop_id);
        let mut joined = known.map_or_else(|| stop.clone(), |known| known.clone().join(stop.clone()));
        if self.resets.contains_key(&joined.stop_id) {
            joined.region = None;
        }
        let is_new = known != Some(&joined);
        if is_new {
            self.stops.insert(joined.stop_id.clone(), joined);
        }
        is_new
    }

    /// Adds a reset, also of a stop that is not known here. Whether anything is new.
    pub fn reset(&mut self, reset: Reset) -> bool {
        let newer = self.resets.get(&reset.stop_id).is_none_or(|known| *known < reset);
        if newer {
            // Where a stop was matters to nobody any more, and is most of what it takes to keep one.
            if let Some(stop) = self.stops.get_mut(&reset.stop_id) {
                stop.region = None;
            }
            self.resets.insert(reset.stop_id.clone(), reset);
        }
        newer
    }

    /// Adds all that another knows. Whether anything is new.
    pub fn merge(&mut self, other: Self) -> bool {
        self.forgotten = self.forgotten.max(other.forgotten);
        let stops = other.stops.into_values().fold(false, |new, stop| self.engage(stop) | new);
        other.resets.into_values().fold(stops, |new, reset| self.reset(reset) | new)
    }

    /// Stops that are engaged and not reset, by name.
    pub fn effective(&self) -> impl Iterator<Item = &Stop> {
        self.stops.values().filter(|stop| !self.resets.contains_key(&stop.stop_id))
    }

    /// Whether this stop is engaged and not reset.
    pub fn is_effective(&self, stop_id: &StopId) -> bool {
        self.stops.contains_key(stop_id) && !self.resets.contains_key(stop_id)
    }

    /// One stop, reset or not.
    pub fn stop(&self, stop_id: &StopId) -> Option<&Stop> {
        self.stops.get(stop_id)
    }

    /// Every stop, reset or not, by name.
    pub fn stops(&self) -> impl Iterator<Item = &Stop> {
        self.stops.values()
    }

    /// The reset of one stop.
    pub fn reset_of(&self, stop_id: &StopId) -> Option<&Reset> {
        self.resets.get(stop_id)
    }

    /// Every reset, by the name of its stop.
    pub fn resets(&self) -> impl Iterator<Item = &Reset> {
        self.resets.values()
    }

    /// Up to when stops were engaged of which this may have forgotten a reset. One that is not known and not newer may have been reset.
    pub const fn forgotten(&self) -> Utc {
        self.forgotten
    }

    /// Effective stops that a robot lies inside of.
    pub fn over(&self, robot_id: &RobotId, pose: Option<&Pose>) -> impl Iterator<Item = &Stop> {
        self.effective().filter(move |stop| stop.includes(robot_id, pose))
    }

    /// What it comes to for a robot: the most restrictive of them.
    pub fn level(&self, robot_id: &RobotId, pose: Option<&Pose>) -> StopLevel {
        self.over(robot_id, pose).map(|stop| stop.level).max().unwrap_or_default()
    }

    /// Forgets resets that are older than [`limits::RESETS_KEPT`], with their stops; and of the rest as many of the oldest as there are more than
    /// `resets_max`. Never a stop that is not reset. [`Latch::forgotten`] says up to where. Whether anything was forgotten.
    pub fn forget(&mut self, now: Utc, resets_max: usize) -> bool {
        let old = self.resets.values().filter(|reset| is_past(reset.reset_unix_ms, now)).count();
        let surplus = self.resets.len().saturating_sub(resets_max).max(old);
        if surplus == 0 {
            return false;
        }
        let mut by_age: Vec<_> =
            self.resets.values().map(|reset| (reset.reset_unix_ms, reset.stop_id.clone())).collect();
        by_age.sort_unstable();
        for (reset, stop_id) in by_age.into_iter().take(surplus) {
            self.resets.remove(&stop_id);
            // Of a stop that was never known all that is sure is that it came before its reset.
            let engaged = self.stops.remove(&stop_id).map_or(reset, |stop| stop.engaged_unix_ms);
            self.forgotten = self.forgotten.max(engaged);
        }
        true
    }
}

/// How the names of stops begin by which the stop service itself stops the fleet when it begins without its memory.
pub const MEMORY_LOST: &str = "STOP-LOST-";

/// Whether the stop service engaged this stop by itself, because it began without its memory.
pub fn is_memory_lost(stop_id: &StopId) -> bool {
    stop_id.as_str().starts_with(MEMORY_LOST)
}

/// Whether something is so old that its name may have been forgotten by others.
pub fn is_past(at: Utc, now: Utc) -> bool {
    now.ms_since(at) > limits::RESETS_KEPT.as_ms()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::AreaId;
    use proptest::prelude::*;

    fn id(n: u8) -> StopId {
        StopId::parse(&format!("STOP-{n}")).expect("an id")
    }

    fn stop(n: u8) -> Stop {
        Stop::new(id(n), Scope::Fleet, StopLevel::Halt, Utc(i64::from(n)))
    }

    fn reset(n: u8) -> Reset {
        Reset::new(id(n), Utc(100 + i64::from(n)))
    }

    #[derive(Clone, Debug)]
    enum Fact {
        Engaged(Stop),
        Reset(Reset),
    }

    fn any_stop() -> impl Strategy<Value = Stop> {
        let scopes = prop_oneof![
            Just(Scope::Fleet),
            Just(Scope::Robot(RobotId::parse("r1").expect("an id"))),
            Just(Scope::Area(AreaId::parse("hall").expect("an id"))),
        ];
        let levels = prop_oneof![Just(StopLevel::Slow), Just(StopLevel::Halt), Just(StopLevel::ControlledStopPosture)];
        let regions = proptest::option::of((0..3_i32).prop_map(|x| Region::of_box(x, 0, x + 1, 1)));
        // Few names, so that tellings of one stop differ.
        (0..4_u8, scopes, levels, regions, 0..3_i64, "[ab]").prop_map(|(n, scope, level, region, engaged, actor)| {
            Stop { scope, level, region, engaged_unix_ms: Utc(engaged), actor, ..stop(n) }
        })
    }

    fn any_fact() -> impl Strategy<Value = Fact> {
        let resets =
            (0..4_u8, 0..3_i64, "[ab]").prop_map(|(n, at, actor)| Reset { reset_unix_ms: Utc(at), actor, ..reset(n) });
        prop_oneof![any_stop().prop_map(Fact::Engaged), resets.prop_map(Fact::Reset)]
    }

    fn twice_in_another_order() -> impl Strategy<Value = (Vec<Fact>, Vec<Fact>)> {
        let facts = proptest::collection::vec(any_fact(), 0..12);
        facts.prop_flat_map(|facts| (Just(facts.clone()), Just([facts.clone(), facts].concat()).prop_shuffle()))
    }

    fn latch(facts: &[Fact]) -> Latch {
        let mut latch = Latch::default();
        for fact in facts {
            match fact.clone() {
                Fact::Engaged(stop) => latch.engage(stop),
                Fact::Reset(reset) => latch.reset(reset),
            };
        }
        latch
    }

    fn merged(a: &Latch, b: &Latch) -> Latch {
        let mut joined = a.clone();
        joined.merge(b.clone());
        joined
    }

    proptest! {
        #[test]
        fn order_and_repetition_of_facts_change_nothing((facts, other) in twice_in_another_order()) {
            prop_assert_eq!(latch(&facts), latch(&other));
        }

        #[test]
        fn what_several_know_is_one_whatever_the_way(facts in proptest::collection::vec(any_fact(), 3..12)) {
            let (a, rest) = facts.split_at(facts.len() / 3);
            let (b, c) = rest.split_at(rest.len() / 2);
            let (a, b, c) = (latch(a), latch(b), latch(c));
            prop_assert_eq!(merged(&a, &b), merged(&b, &a));
            prop_assert_eq!(merged(&merged(&a, &b), &c), merged(&a, &merged(&b, &c)));
            prop_assert_eq!(merged(&a, &a), a);
        }

        #[test]
        fn a_join_stops_at_least_whom_either_stops_unless_the_other_knows_of_a_reset(facts in proptest::collection::vec(any_fact(), 2..12)) {
            let (a, b) = facts.split_at(facts.len() / 2);
            let (a, b) = (latch(a), latch(b));
            let joined = merged(&a, &b);
            let robot = RobotId::parse("r1").expect("an id");
            for stop in a.effective().chain(b.effective()).filter(|s| joined.reset_of(&s.stop_id).is_none()) {
                let inside = stop.includes(&robot, None);
                let now = joined.stop(&stop.stop_id).expect("it is known");
                prop_assert!(!inside || now.includes(&robot, None) && now.level >= stop.level);
            }
        }
    }

    #[test]
    fn a_late_reset_takes_its_own_stop_away_and_no_newer_one() {
        let mut latch = Latch::default();
        assert!(latch.engage(stop(1)) && latch.engage(stop(2)));
        assert!(latch.reset(reset(1)));
        assert_eq!(latch.effective().map(|s| s.stop_id.clone()).collect::<Vec<_>>(), [id(2)]);
        assert!(!latch.reset(reset(1)), "twice is once");
        assert!(!latch.engage(stop(1)), "and engaged again by an old message it stays reset");
        assert!(!latch.is_effective(&id(1)));
    }

    #[test]
    fn the_most_restrictive_stop_over_a_robot_wins() {
        let mut latch = Latch::default();
        let (r1, r2) = (RobotId::parse("r1").expect("an id"), RobotId::parse("r2").expect("an id"));
        latch.engage(Stop { level: StopLevel::Slow, ..stop(1) });
        latch.engage(Stop { scope: Scope::Robot(r1.clone()), level: StopLevel::ControlledStopPosture, ..stop(2) });
        assert_eq!(latch.level(&r1, None), StopLevel::ControlledStopPosture);
        assert_eq!(latch.level(&r2, None), StopLevel::Slow);
    }

    #[test]
    fn only_what_was_reset_long_ago_is_forgotten() {
        let mut latch = Latch::default();
        latch.engage(stop(1));
        latch.engage(stop(2));
        latch.reset(reset(2));
        let day = 24 * 3_600_000;
        assert!(!latch.forget(Utc(100).plus_ms(89 * day), 10));
        assert!(latch.forget(Utc(200).plus_ms(90 * day), 10));
        assert_eq!((latch.stops().count(), latch.resets().count()), (1, 0));
        assert!(latch.is_effective(&id(1)), "an engaged stop has no age");
        latch.reset(reset(1));
        latch.reset(reset(3));
        assert!(latch.forget(Utc(0), 1), "the oldest go when there are too many");
        assert!(latch.reset_of(&id(1)).is_none() && latch.reset_of(&id(3)).is_some());
    }

    #[test]
    fn what_is_forgotten_leaves_a_mark_that_only_rises() {
        let mut latch = Latch::default();
        latch.engage(stop(5));
        latch.reset(reset(5));
        assert_eq!(latch.forgotten(), Utc(0), "nothing is forgotten yet");
        assert!(latch.forget(Utc(0), 0));
        assert_eq!(latch.forgotten(), Utc(5), "when it was engaged");
        latch.engage(stop(2));
        latch.reset(reset(2));
        assert!(latch.forget(Utc(0), 0));
        assert_eq!(latch.forgotten(), Utc(5));
        latch.reset(reset(7));
        assert!(latch.forget(Utc(0), 0));
        assert_eq!(latch.forgotten(), Utc(107), "of a stop that was never known: when it was reset");
        let text = serde_json::to_string(&latch).expect("a latch");
        assert_eq!(serde_json::from_str::<Latch>(&text).expect("a latch"), latch);
        let older: Latch = serde_json::from_str(r#"{"stops":{},"resets":{}}"#).expect("of an older version");
        assert_eq!(merged(&older, &latch).forgotten(), Utc(107));
    }
}
