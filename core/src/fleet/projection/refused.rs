//! Decisions that the store refused for good, and which of them are aside.
//!
//! A decision is the same if its kind and its rows are. Invariant: at most [`limits::REFUSED_REMEMBERED`] are remembered.

use crate::ids::{PlaceId, RobotId};
use crate::limits;
use crate::projection::DecisionKey;
use crate::reason::{Code, Reason};
use crate::rows::{Key, Table};
use std::collections::{BTreeMap, BTreeSet};

/// What is known of one refused decision.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Known {
    /// How often it was refused.
    times: u32,
    /// It is not tried any more.
    is_aside: bool,
    /// It was put aside and no person was told yet.
    is_untold: bool,
    /// Robots that it is about.
    robots: BTreeSet<RobotId>,
}

/// Decisions that the store refused for good.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Refused {
    known: BTreeMap<DecisionKey, Known>,
    /// Robots of decisions that are tried again.
    again: BTreeSet<RobotId>,
}

impl Refused {
    /// Whether any decision is aside.
    pub fn keeps_any(&self) -> bool {
        self.known.values().any(|known| known.is_aside)
    }
    /// Whether this one is aside.
    pub fn is_aside(&self, decision_key: &DecisionKey) -> bool {
        self.known.get(decision_key).is_some_and(|known| known.is_aside)
    }
    /// Checks that no decision aside is about a robot.
    ///
    /// # Errors
    /// If there is one; the reason names it.
    pub fn check_robot(&self, robot_id: &RobotId) -> Result<(), Reason> {
        match self.aside().find(|(_, known)| known.robots.contains(robot_id)) {
            Some((decision_key, _)) => Err(reason(decision_key)),
            None => Ok(()),
        }
    }
    /// Whether a decision aside is about the place.
    pub fn is_place_aside(&self, place_id: &PlaceId) -> bool {
        let is_it = |key: &Key| key.table == Table::PlaceGrant && *key.id == *place_id.as_str();
        self.aside().any(|(decision_key, _)| decision_key.keys.iter().any(is_it))
    }
    /// A row changed: what is about it is tried again. Of the robots' rows a session counts too.
    pub fn row_changed(&mut self, key: &Key) {
        self.try_those(|decision_key, known| {
            let is_session = || key.table == Table::Session && known.robots.iter().any(|r| r.as_str() == &*key.id);
            decision_key.keys.contains(key) || is_session()
        });
    }
    /// A person closed an incident: the decision that it was about is tried again.
    pub fn incident_closed(&mut self, told: &Reason) {
        self.try_those(|decision_key, _| reason(decision_key) == *told);
    }
    fn try_those(&mut self, are_meant: impl Fn(&DecisionKey, &Known) -> bool) {
        for (decision_key, known) in self.known.iter_mut().filter(|(_, known)| known.is_aside) {
            if are_meant(decision_key, known) {
                known.is_aside = false;
                self.again.extend(known.robots.iter().cloned());
            }
        }
    }
    /// Notes that a decision about these robots was refused; the second time puts it aside.
    pub fn note(&mut self, decision_key: DecisionKey, robots: BTreeSet<RobotId>) {
        let all = &mut self.known;
        if all.len() >= limits::REFUSED_REMEMBERED && !all.contains_key(&decision_key) {
            all.pop_first();
        }
        let known = all.entry(decision_key).or_default();
        known.times = known.times.saturating_add(1);
        known.robots = robots;
        if known.times >= limits::REFUSALS_UNTIL_ASIDE && !known.is_aside {
            (known.is_aside, known.is_untold) = (true, true);
        }
    }
    /// How many decisions are remembered.
    pub fn count(&self) -> usize {
        self.known.len()
    }
    /// Robots of decisions that are looked at again.
    pub fn look_again(&mut self, robots: BTreeSet<RobotId>) {
        self.again.extend(robots);
    }
    /// Those robots, once.
    pub fn take_again(&mut self) -> BTreeSet<RobotId> {
        std::mem::take(&mut self.again)
    }
    /// Decisions that were put aside since: why, and a robot that each is about.
    pub fn take_untold(&mut self) -> Vec<(Reason, Option<RobotId>)> {
        let untold = |known: &mut Known| std::mem::take(&mut known.is_untold);
        let known = self.known.iter_mut();
        known.filter_map(|(o, k)| untold(k).then(|| (reason(o), k.robots.first().cloned()))).collect()
    }
    fn aside(&self) -> impl Iterator<Item = (&DecisionKey, &Known)> {
        self.known.iter().filter(|(_, known)| known.is_aside)
    }
}

/// Why a robot gets no work, and what the incident says: the same for the same decision.
fn reason(decision_key: &DecisionKey) -> Reason {
    let first = decision_key.keys.first().map(|key| format!("{}/{}", key.table.name(), key.id)).unwrap_or_default();
    Reason::from(Code::DecisionPutAside)
        .with("decision", decision_key.kind)
        .with("first_row", first)
        .with("rows", decision_key.keys.len())
}
