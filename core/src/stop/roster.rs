//! What people are shown of one stop and one robot: only what the robot itself has said, and for how long it has said nothing.
//!
//! Invariant: STANDSTILL_CONFIRMED needs a report of this robot, heard after it kept this stop, that says it stands and obeys it. Silence never confirms.
//! Called by the stop service.

use super::ladder::{Around, Stage};
use super::latch::Stop;
use super::scope::Scope;
use crate::ids::{RobotId, StopId};
use crate::limits;
use crate::robot::StopLevel;
use crate::time::LinkTime;
use std::collections::BTreeSet;

/// The newest report of one robot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Heard {
    /// When it came, link clock of the stop service.
    pub at: LinkTime,
    /// Newest state of the latch that it has taken over.
    pub generation: u64,
    /// What it took over survives its end.
    pub is_durable: bool,
    /// What it obeys.
    pub level: StopLevel,
    /// It stands and will not move by itself.
    pub is_still: bool,
    /// Stops that it lies inside of.
    pub inside: BTreeSet<StopId>,
    /// How far its silence had come.
    pub stage: Stage,
    /// Whom it has around itself, as far as it knows.
    pub around: Around,
    /// What waits for a person's resume.
    pub awaiting: BTreeSet<StopId>,
}

/// How far one robot is with one stop.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Confirmation {
    /// It was told, and has not said that it knows; or says that it knows and does not take a stop that is meant for it wherever it is for its own.
    Requested,
    /// It knows. If the stop only slows it, it does.
    Acked,
    /// It knows, and does not lie inside.
    Outside,
    /// It stands, and obeys.
    StandstillConfirmed,
    /// It is not heard.
    Unreachable {
        /// Since when; none if it was never heard by this process.
        since: Option<LinkTime>,
        /// When its own silence makes it stand at the latest; none if it was never heard.
        self_stop_by: Option<LinkTime>,
    },
}

impl Confirmation {
    /// Nothing more is to come of it by itself.
    pub const fn is_settled(self, stop: &Stop) -> bool {
        match self {
            Self::StandstillConfirmed | Self::Outside => true,
            Self::Acked => matches!(stop.level, StopLevel::Slow),
            Self::Requested | Self::Unreachable { .. } => false,
        }
    }
}

/// A robot that does not lie inside of this stop is still meant by it: there is no elsewhere for it. One that knows of a reset of it that the service has lost
/// says so, and must not be shown as if nothing were asked of it.
pub fn means_everywhere(stop: &Stop, robot_id: &RobotId) -> bool {
    match &stop.scope {
        Scope::Fleet => true,
        Scope::Robot(id) => id == robot_id,
        Scope::Zone(_) | Scope::Area(_) => false,
    }
}

/// How far `robot_id`, of whom `robot` is the newest report, is with `stop`, which the latch has since `generation`.
pub fn confirmation(
    stop: &Stop,
    generation: u64,
    robot_id: &RobotId,
    robot: Option<&Heard>,
    now: LinkTime,
) -> Confirmation {
    let Some(heard) = robot else { return Confirmation::Unreachable { since: None, self_stop_by: None } };
    if now.since(heard.at) >= limits::CHECK_IN_MISSED {
        let by = heard.at + heard.around.patience().1;
        return Confirmation::Unreachable { since: Some(heard.at), self_stop_by: Some(by) };
    }
    match heard {
        heard if heard.generation < generation => Confirmation::Requested,
        heard if !heard.inside.contains(&stop.stop_id) && means_everywhere(stop, robot_id) => Confirmation::Requested,
        heard if !heard.inside.contains(&stop.stop_id) => Confirmation::Outside,
        heard if heard.is_still && heard.level >= stop.level && stop.level >= StopLevel::Halt => {
            Confirmation::StandstillConfirmed
        }
        _ => Confirmation::Acked,
    }
}

/// Whether nobody waits for more of a robot that is not heard: it said last that it knows this stop and does not lie inside, so that it obeys it wherever it
/// drives, and its own silence has not stood it yet.
pub fn is_elsewhere(stop: &Stop, generation: u64, robot_id: &RobotId, robot: Option<&Heard>, now: LinkTime) -> bool {
    robot.is_some_and(|heard| {
        now.since(heard.at) >= limits::CHECK_IN_MISSED
            && now < heard.at + heard.around.patience().1
            && confirmation(stop, generation, robot_id, robot, heard.at) == Confirmation::Outside
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::AreaId;
    use crate::time::Utc;

    fn stop(level: StopLevel) -> Stop {
        Stop::new(StopId::parse("STOP-1").expect("an id"), Scope::Fleet, level, Utc(0))
    }

    fn standing() -> Heard {
        Heard {
            at: LinkTime(10_000),
            generation: 7,
            is_durable: true,
            level: StopLevel::Halt,
            is_still: true,
            inside: [StopId::parse("STOP-1").expect("an id")].into(),
            stage: Stage::Heard,
            around: Around::People,
            awaiting: BTreeSet::new(),
        }
    }

    fn robot(id: &str) -> RobotId {
        RobotId::parse(id).expect("an id")
    }

    fn confirm_heard(level: StopLevel, heard: Heard) -> Confirmation {
        confirmation(&stop(level), 7, &robot("r1"), Some(&heard), LinkTime(10_500))
    }

    #[test]
    fn only_a_robot_that_says_it_stands_and_obeys_is_shown_as_standing() {
        let halt = StopLevel::Halt;
        assert_eq!(confirm_heard(halt, standing()), Confirmation::StandstillConfirmed);
        assert_eq!(confirm_heard(halt, Heard { is_still: false, ..standing() }), Confirmation::Acked);
        assert_eq!(
            confirm_heard(StopLevel::ControlledStopPosture, standing()),
            Confirmation::Acked,
            "not yet in its posture"
        );
        assert_eq!(confirm_heard(halt, Heard { level: StopLevel::Slow, ..standing() }), Confirmation::Acked);
        assert_eq!(confirm_heard(halt, Heard { generation: 6, ..standing() }), Confirmation::Requested);
        assert_eq!(
            confirm_heard(StopLevel::Slow, standing()),
            Confirmation::Acked,
            "standing is not what was asked for"
        );
    }

    #[test]
    fn a_robot_is_elsewhere_only_for_a_stop_that_has_an_elsewhere() {
        let heard = Heard { inside: BTreeSet::new(), ..standing() };
        let with = |scope: Scope| {
            let stop = Stop { scope, ..stop(StopLevel::Halt) };
            confirmation(&stop, 7, &robot("r1"), Some(&heard), LinkTime(10_500))
        };
        assert_eq!(with(Scope::Fleet), Confirmation::Requested, "it knows of a reset that the service has lost");
        assert_eq!(with(Scope::Robot(robot("r1"))), Confirmation::Requested);
        assert_eq!(with(Scope::Robot(robot("r2"))), Confirmation::Outside);
        assert_eq!(with(Scope::Area(AreaId::parse("hall").expect("an id"))), Confirmation::Outside);
    }

    #[test]
    fn nobody_waits_for_one_that_said_it_lies_elsewhere_until_its_silence_has_stood_it() {
        let area = Stop { scope: Scope::Area(AreaId::parse("hall").expect("an id")), ..stop(StopLevel::Halt) };
        let there = Heard { inside: BTreeSet::new(), ..standing() };
        let waits_not = |stop: &Stop, heard: &Heard, ms: u64| {
            is_elsewhere(stop, 7, &robot("r1"), Some(heard), LinkTime(10_000 + ms))
        };
        assert_eq!([2_999, 3_000, 5_999, 6_000].map(|ms| waits_not(&area, &there, ms)), [false, true, true, false]);
        assert!(!waits_not(&area, &standing(), 3_000), "it lies inside");
        assert!(!waits_not(&area, &Heard { generation: 6, ..there.clone() }, 3_000), "it does not know the stop");
        assert!(!waits_not(&stop(StopLevel::Halt), &there, 3_000), "there is no elsewhere");
        assert!(!is_elsewhere(&area, 7, &robot("r1"), None, LinkTime(13_000)), "nobody knows where it is");
    }

    #[test]
    fn silence_says_since_when_and_until_when_and_confirms_nothing() {
        let silent = confirmation(&stop(StopLevel::Halt), 7, &robot("r1"), Some(&standing()), LinkTime(13_000));
        let (since, self_stop_by) = (Some(LinkTime(10_000)), Some(LinkTime(16_000)));
        assert_eq!(silent, Confirmation::Unreachable { since, self_stop_by });
        let never = Confirmation::Unreachable { since: None, self_stop_by: None };
        assert_eq!(confirmation(&stop(StopLevel::Halt), 7, &robot("r1"), None, LinkTime(0)), never);
        assert!(!silent.is_settled(&stop(StopLevel::Halt)) && !never.is_settled(&stop(StopLevel::Halt)));
    }
}
