//! Actions that no robot is sent to do at one place, since several robots failed them there: derived from open incidents, with what only
//! this process remembers of failures and probes.
//!
//! `tasks::place_breaker` opens and closes them; `index` keeps what is derived. Invariant: a step is broken exactly as long as its incident
//! is open, so that every process and every start see the same.

use super::rows::Incident;
use crate::ids::{RobotId, TaskId, WaypointId};
use crate::reason::Code;
use crate::step::{StepKind, WorkStep};
use crate::task::{TaskIntake, TaskState};
use crate::time::Utc;
use smol_str::SmolStr;
use std::collections::{BTreeMap, VecDeque};

/// Steps at places of which failures are remembered.
const REMEMBERED_MAX: usize = 1_024;

/// An action at the place where it is done.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct StepAt {
    /// The goal of the way before it.
    pub waypoint: WaypointId,
    /// Name of the action.
    pub action: SmolStr,
}

impl StepAt {
    /// Actions of a task that may be broken, each with the index of its step. Left out is what is done before the first way, where nobody
    /// knows the place, and what may fail without harm.
    pub fn of_steps(steps: &[WorkStep]) -> impl Iterator<Item = (u32, Self)> {
        let mut here: Option<&WaypointId> = None;
        steps.iter().zip(0..).filter_map(move |(step, nth)| match &step.kind {
            StepKind::Goto { waypoint } => {
                here = Some(waypoint);
                None
            }
            StepKind::Action { name, .. } if !step.continue_on_fail => {
                Some((nth, Self { waypoint: here?.clone(), action: name.into() }))
            }
            StepKind::Action { .. } | StepKind::Wait { .. } => None,
        })
    }

    /// The step that an incident says is broken.
    fn of_incident(incident: &Incident) -> Option<Self> {
        let told = |name| incident.reason.metadata.get(name).filter(|_| incident.reason.code == Code::PlaceBroken);
        let waypoint = WaypointId::parse(told("waypoint")?).ok()?;
        Some(Self { waypoint, action: told("action")?.into() })
    }
}

/// A step that is broken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BrokenStep {
    /// The incident that says so.
    pub incident_id: String,
    /// UTC, site clock: from then on one task is let through as a probe.
    pub again: Utc,
}

/// What the change of an incident did to a step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StepChange {
    /// It is broken now.
    Broke(StepAt),
    /// It is broken no more; with when a person, or the planner, closed its incident.
    Mended(StepAt, Option<Utc>),
}

/// All steps that are broken.
#[derive(Clone, Debug, Default)]
pub struct BrokenSteps(BTreeMap<StepAt, BrokenStep>);

impl BrokenSteps {
    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
    /// What is known of a step; none: it is not broken.
    pub fn get(&self, at: &StepAt) -> Option<&BrokenStep> {
        self.0.get(at)
    }
    /// All of them, in order.
    pub fn iter(&self) -> impl Iterator<Item = (&StepAt, &BrokenStep)> {
        self.0.iter()
    }
    /// The first broken step of what is left of a task that is not the probe for it. What is opened goes on: its robot carries the item.
    pub fn bars(&self, task: &TaskState, intake: &TaskIntake, memory: &StepMemory) -> Option<StepAt> {
        if self.is_empty() || task.opened_robot_id.is_some() {
            return None;
        }
        let mut left = StepAt::of_steps(&intake.spec.steps).filter(|(nth, _)| *nth >= task.next_step).map(|(_, at)| at);
        left.find(|at| self.0.contains_key(at) && !memory.is_probe(at, &task.task_id))
    }
    /// An incident changed.
    pub(super) fn put_incident(&mut self, old: Option<&Incident>, new: Option<&Incident>) -> Option<StepChange> {
        let at = new.or(old).and_then(StepAt::of_incident)?;
        let Some(incident) = new.filter(|incident| incident.closed.is_none()) else {
            self.0.remove(&at);
            return Some(StepChange::Mended(at, new.and_then(|new| Some(new.closed.as_ref()?.at))));
        };
        let told = incident.reason.metadata.get("again_time").and_then(|at| Utc::parse_rfc3339(at));
        let again = told.unwrap_or(incident.opened_unix_ms);
        let known = self.0.insert(at.clone(), BrokenStep { incident_id: incident.id.clone(), again });
        known.is_none().then_some(StepChange::Broke(at))
    }
}

/// What this process remembers of steps at places. Volatile: a start begins without it.
#[derive(Clone, Debug, Default)]
pub struct StepMemory {
    /// Robots that failed a step, each with when it did last, UTC.
    failed: BTreeMap<StepAt, BTreeMap<RobotId, Utc>>,
    /// Steps in the order in which they were first remembered.
    order: VecDeque<StepAt>,
    /// The task that is let through to a broken step, and since when, UTC.
    pub(in crate::fleet) probes: BTreeMap<StepAt, (TaskId, Utc)>,
}

impl StepMemory {
    /// Whether nobody failed anything lately.
    pub(in crate::fleet) fn is_empty(&self) -> bool {
        self.failed.is_empty()
    }
    /// Notes a failure. Gives back all robots that failed the step within `window_ms`.
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
        if self.order.len() > REMEMBERED_MAX
            && let Some(oldest) = self.order.front().cloned()
        {
            self.forget_failures(&oldest, now);
        }
        robots
    }
    /// Failures up to this moment count no more.
    pub(in crate::fleet) fn forget_failures(&mut self, at: &StepAt, until: Utc) {
        let Some(failed) = self.failed.get_mut(at) else { return };
        failed.retain(|_, failed| *failed > until);
        if failed.is_empty() {
            self.failed.remove(at);
            self.order.retain(|known| known != at);
        }
    }
    /// The task that is let through to a broken step.
    pub fn probe_of(&self, at: &StepAt) -> Option<&TaskId> {
        self.probes.get(at).map(|(task_id, _)| task_id)
    }
    fn is_probe(&self, at: &StepAt, task_id: &TaskId) -> bool {
        self.probe_of(at) == Some(task_id)
    }
}
