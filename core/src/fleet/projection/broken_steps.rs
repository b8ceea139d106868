//! Steps that no robot is sent to do at one place, since several failed it there: derived from open incidents, with what only this process
//! remembers of failures and tries.
//!
//! `tasks::place_breaker` opens and closes them; `index` keeps what is derived. Invariant: a step is broken exactly as long as its incident
//! is open, so that every process and every start see the same.

use super::rows::Incident;
use crate::ids::{RobotId, TaskId, WaypointId};
use crate::reason::Code;
use crate::step::{StepKind, WorkStep};
use crate::time::Utc;
use smol_str::SmolStr;
use std::collections::{BTreeMap, VecDeque};

/// Steps at places of which failures are remembered.
const REMEMBERED_MAX: usize = 1_024;

/// A step at the place where it is done.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct StepAt {
    /// Where: the goal of the way before it.
    pub waypoint: WaypointId,
    /// What: `goto`, or the name of the action.
    pub step: SmolStr,
}

impl StepAt {
    /// Steps that may be broken, each with its index. What is done before the first way is done nowhere in particular.
    pub fn of_steps(steps: &[WorkStep]) -> impl Iterator<Item = (u32, Self)> {
        let mut here: Option<&WaypointId> = None;
        steps.iter().zip(0..).filter_map(move |(step, nth)| {
            let name = match &step.kind {
                StepKind::Goto { waypoint } => {
                    here = Some(waypoint);
                    "goto"
                }
                StepKind::Action { name, .. } => name,
                StepKind::Wait { .. } => return None,
            };
            Some((nth, Self { waypoint: here?.clone(), step: name.into() }))
        })
    }

    /// Of an incident that says so.
    fn of_incident(incident: &Incident) -> Option<Self> {
        let told = |name| incident.reason.metadata.get(name);
        let waypoint = WaypointId::parse(told("waypoint")?).ok()?;
        Some(Self { waypoint, step: told("step")?.into() })
    }
}

/// One of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokenStep {
    /// Its incident.
    pub incident_id: String,
    /// UTC, site clock: from then on one task is given, as a try.
    pub again: Utc,
}

/// All of them, by what and where.
#[derive(Clone, Debug, Default)]
pub struct BrokenSteps(BTreeMap<StepAt, BrokenStep>);

impl BrokenSteps {
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
    /// The one of this step; none: it is not broken.
    pub fn get(&self, at: &StepAt) -> Option<&BrokenStep> {
        self.0.get(at)
    }
    /// All of them, in order.
    pub fn iter(&self) -> impl Iterator<Item = (&StepAt, &BrokenStep)> {
        self.0.iter()
    }
    /// An incident changed: which step is broken no more.
    pub(super) fn put_incident(&mut self, old: Option<&Incident>, new: Option<&Incident>) -> Option<StepAt> {
        let broken = |incident: &&Incident| incident.reason.code == Code::PlaceBroken && incident.closed.is_none();
        let (old, new) = (old.filter(broken), new.filter(broken));
        let ended = old.and_then(StepAt::of_incident).filter(|_| new.is_none());
        ended.iter().for_each(|at| drop(self.0.remove(at)));
        if let Some((at, incident)) = new.and_then(|new| Some((StepAt::of_incident(new)?, new))) {
            let told = incident.reason.metadata.get("again_time").and_then(|at| Utc::parse_rfc3339(at));
            let again = told.unwrap_or(incident.opened_unix_ms);
            self.0.insert(at, BrokenStep { incident_id: incident.id.clone(), again });
        }
        ended
    }
}

/// What this process remembers of steps at places. Volatile: a start begins without it.
#[derive(Clone, Debug, Default)]
pub struct StepMemory {
    /// Robots that failed a step, each with when it did last, UTC.
    failed: BTreeMap<StepAt, BTreeMap<RobotId, Utc>>,
    /// Steps in the order in which they were first remembered.
    order: VecDeque<StepAt>,
    /// The task that is let through to try a broken step, and since when it may be given, UTC.
    pub(in crate::fleet) tries: BTreeMap<StepAt, (TaskId, Utc)>,
}

impl StepMemory {
    /// Notes a failure; all robots that failed the step within `window_ms`.
    pub(in crate::fleet) fn note_failure(
        &mut self,
        at: &StepAt,
        robot_id: &RobotId,
        now: Utc,
        window_ms: u64,
    ) -> Vec<RobotId> {
        if !self.failed.contains_key(at) {
            self.order.push_back(at.clone());
        }
        let failed = self.failed.entry(at.clone()).or_default();
        failed.insert(robot_id.clone(), now);
        failed.retain(|_, failed| now.ms_since(*failed) <= window_ms);
        let robots = failed.keys().cloned().collect();
        while self.order.len() > REMEMBERED_MAX {
            let oldest = self.order.pop_front();
            oldest.map(|at| self.failed.remove(&at));
        }
        robots
    }
    /// The step is as good as new.
    pub(in crate::fleet) fn forget(&mut self, at: &StepAt) {
        if self.failed.remove(at).is_some() {
            self.order.retain(|known| known != at);
        }
        self.tries.remove(at);
    }
}
