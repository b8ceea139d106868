//! Tasks: what the rows say becomes a `Task`, and what people change of one is read.

use super::submission::CheckedTask;
use super::{At, WireEnum, duration, id, maybe_id, parse_time, shown, timestamp, to_struct, word};
use crate::task::v1;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::limits;
use midshift_core::reason::Violations;
use midshift_core::rows::Revision;
use midshift_core::step::{StepKind, WorkStep};
use midshift_core::task::edit::is_in_order;
use midshift_core::task::spec::{DEFAULT_PRIORITY, LEAST_PRIORITY, Retry, Selector};
use midshift_core::task::{Attempt, Phase, Resolution, TaskEdit, TaskIntake, TaskSpec, TaskState};
use midshift_core::time::Utc;
use std::collections::{BTreeMap, BTreeSet};

impl From<&WorkStep> for v1::Step {
    fn from(step: &WorkStep) -> Self {
        use v1::step::Kind;
        let kind = match &step.kind {
            StepKind::Goto { waypoint } => Kind::Goto(v1::Goto { waypoint: waypoint.to_string() }),
            StepKind::Action { name, params } => {
                let params = (!params.is_empty()).then(|| to_struct(params));
                Kind::Action(v1::Action { name: name.clone(), params })
            }
            StepKind::Wait { duration_ms } => Kind::Wait(v1::Wait { duration: Some(duration(*duration_ms)) }),
        };
        let on_fail = if step.continue_on_fail { v1::OnFail::Continue } else { v1::OnFail::Stop };
        Self {
            kind: Some(kind),
            effect: Some(super::enums::step_effect(step.effect)),
            pause_allowed: Some(step.pause_allowed),
            cancel_allowed: Some(step.cancel_allowed),
            timeout: step.timeout_ms.map(duration),
            on_fail: Some(on_fail.into()),
        }
    }
}

impl From<&Selector> for v1::RobotSelector {
    fn from(selector: &Selector) -> Self {
        Self {
            labels: selector.labels.clone(),
            capabilities: selector.capabilities.clone(),
            minimum_software: selector.minimum_software.clone().unwrap_or_default(),
            payload_g: selector.payload_g,
        }
    }
}

impl From<&Retry> for v1::RetryPolicy {
    fn from(retry: &Retry) -> Self {
        Self {
            max_retry_times: i32::try_from(retry.max_retry_times).unwrap_or(i32::MAX),
            interval: Some(duration(retry.interval_ms)),
            factor: Some(retry.factor),
            max_interval: Some(duration(retry.max_interval_ms)),
            jitter: Some(retry.jitter),
            exclude_failed_robot: retry.exclude_failed_robot,
        }
    }
}

impl From<&TaskSpec> for v1::TaskSpec {
    fn from(spec: &TaskSpec) -> Self {
        Self {
            r#type: spec.kind.clone(),
            priority: Some(i32::from(spec.priority)),
            robot_id: spec.robot_id.as_ref().map(ToString::to_string).unwrap_or_default(),
            selector: (spec.selector != Selector::default()).then(|| (&spec.selector).into()),
            steps: spec.steps.iter().map(Into::into).collect(),
            timeout: Some(duration(spec.timeout_ms)),
            schedule_to_start_timeout: spec.schedule_to_start_ms.map(duration),
            stall_timeout: Some(duration(spec.stall_ms)),
            not_before: spec.not_before.map(timestamp),
            deadline: spec.deadline.map(timestamp),
            retry: Some((&spec.retry).into()),
            preemptible: spec.preemptible,
            depends_on: spec.depends_on.iter().map(ToString::to_string).collect(),
            coalesce_key: spec.coalesce_key.clone(),
            same_robot_as: spec.same_robot_as.as_ref().map(ToString::to_string).unwrap_or_default(),
            speed_limit_mm_s: spec.speed_limit_mm_s,
            labels: spec.labels.clone(),
            requester: spec.requester.clone(),
            external_ref: spec.external_ref.clone(),
            trace_context: spec.trace_context.clone(),
        }
    }
}

/// The rows behind one `Task`.
#[derive(Clone, Copy, Debug)]
pub struct TaskView<'a> {
    /// What was asked for.
    pub intake: &'a TaskIntake,
    /// Where it is.
    pub state: &'a TaskState,
    /// Of the state: its text is the etag.
    pub revision: Revision,
    /// The live or last attempt.
    pub attempt: Option<&'a Attempt>,
    /// What a person may answer.
    pub allowed: &'a [Resolution],
}

/// A task as callers see it.
pub fn encode_task(view: TaskView<'_>) -> v1::Task {
    let TaskView { intake, state, revision, attempt, allowed } = view;
    let id_text = |id: &Option<RobotId>| id.as_ref().map(ToString::to_string).unwrap_or_default();
    v1::Task {
        task_id: intake.task_id.to_string(),
        spec: Some((&state.spec(intake)).into()),
        state: state.phase.to_wire(),
        etag: etag(revision),
        create_time: Some(timestamp(intake.created)),
        update_time: Some(timestamp(state.changed)),
        reason: state.shown_reason().as_ref().map(shown),
        then: state.then.map(WireEnum::to_wire).unwrap_or_default(),
        hold_tokens: state.holds.iter().cloned().collect(),
        allowed_resolutions: allowed.iter().map(|r| r.to_wire()).collect(),
        robot_id: id_text(&state.robot_id),
        opened_robot_id: id_text(&state.opened_robot_id),
        next_step: state.next_step,
        failures: state.failures,
        epoch: state.epoch,
        attempt: attempt.map(Into::into),
        queued_time: Some(timestamp(state.queued_since)),
        ready_time: state.ready_since.map(timestamp),
        retry_time: state.retry_at.map(timestamp),
        cancel_request_time: state.cancel_requested.map(timestamp),
        start_time: state.started.map(timestamp),
        end_time: state.ended.map(timestamp),
        stats: Some((&state.stats).into()),
        failed_robot_ids: state.failed_robots.iter().map(ToString::to_string).collect(),
        actor: intake.actor.clone(),
        number: intake.number,
        edited_fields: state.edit.fields().map(str::to_owned).collect(),
        operator_hold: state.operator_hold.as_ref().map(|hold| v1::OperatorHold {
            actor: hold.actor.clone(),
            reason: hold.reason.clone(),
            since: Some(timestamp(hold.since)),
        }),
        type_etag: intake.type_revision.map(etag).unwrap_or_default(),
    }
}

/// The answer to validate_only: what the task would be, without id, etag and times.
pub fn encode_checked(task: &CheckedTask) -> v1::Task {
    v1::Task {
        spec: Some((&task.spec).into()),
        state: Phase::Queued.to_wire(),
        type_etag: task.type_revision.map(etag).unwrap_or_default(),
        ..v1::Task::default()
    }
}

/// A revision as an etag.
pub fn etag(revision: Revision) -> String {
    revision.0.to_string()
}

/// Paths of a mask that are looked at: more than there are fields.
const PATHS_MAX: usize = 32;
/// Characters of an unknown path that are said.
const PATH_SHOWN: usize = 64;

/// The change that an update asks for.
pub fn read_update(
    mask: Option<&prost_types::FieldMask>,
    update: v1::TaskUpdate,
    bad: &mut Violations,
) -> Option<TaskEdit> {
    let (before, at) = (bad.0.len(), At::top("update"));
    let paths = mask.map_or(&[][..], |mask| &mask.paths);
    if paths.is_empty() {
        bad.add("update_mask", "is required: name the fields that change, of priority, robot_id, not_before, deadline");
    }
    if paths.len() > PATHS_MAX {
        bad.add("update_mask", "must be at most 32 paths");
    }
    let mut edit = TaskEdit::default();
    for (i, path) in paths.iter().take(PATHS_MAX).enumerate() {
        match path.as_str() {
            "priority" => match u8::try_from(update.priority.unwrap_or(i32::from(DEFAULT_PRIORITY))) {
                Ok(priority) if priority <= LEAST_PRIORITY => edit.priority = Some(priority),
                _ => bad.add(at.field("priority").to_string(), "must be 0..9, 0 most urgent"),
            },
            "robot_id" => {
                edit.robot_id = maybe_id(&update.robot_id, RobotId::parse, at.field("robot_id"), bad);
            }
            "not_before" => {
                edit.not_before = Some(parse_time(update.not_before.as_ref(), at.field("not_before"), bad));
            }
            "deadline" => edit.deadline = Some(parse_time(update.deadline.as_ref(), at.field("deadline"), bad)),
            other => {
                let named: String = other.chars().take(PATH_SHOWN).collect();
                let told = format!("{named:?} is none of priority, robot_id, not_before, deadline");
                bad.add(format!("update_mask.paths[{i}]"), told);
            }
        }
    }
    if !is_in_order(edit.not_before.flatten(), edit.deadline.flatten()) {
        bad.add(at.field("deadline").to_string(), "must be after not_before");
    }
    (bad.0.len() == before).then_some(edit)
}

/// An etag as the revision it names. Empty: whatever it is. One that was never given out names no revision and so matches none.
pub fn revision_of(etag: &str) -> Option<Revision> {
    (!etag.is_empty()).then(|| Revision(etag.parse().unwrap_or(0)))
}

impl From<&Attempt> for v1::Attempt {
    fn from(attempt: &Attempt) -> Self {
        let uncertain = attempt
            .uncertain
            .as_ref()
            .map(|u| v1::AttemptUncertain { since: Some(timestamp(u.since)), cause: Some(shown(&u.cause)) });
        Self {
            epoch: attempt.attempt.epoch,
            robot_id: attempt.robot_id.to_string(),
            state: attempt.phase.to_wire(),
            uncertain,
            step_index: attempt.step_index,
            opened: attempt.is_opened,
            offer_time: Some(timestamp(attempt.offered)),
            accept_time: attempt.accepted.map(timestamp),
            end_time: attempt.ended.map(timestamp),
            fault: attempt.fault.as_ref().map(Into::into),
            refusal: attempt.refusal.as_ref().map(shown),
            stats: Some((&attempt.stats).into()),
            software: attempt.software.clone(),
        }
    }
}

/// Which tasks a list or a watch is about. All must hold.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TaskFilter {
    /// Any of these; empty: all.
    pub phases: BTreeSet<Phase>,
    /// Any of these; empty: all.
    pub robot_ids: BTreeSet<RobotId>,
    /// Any of these; empty: all.
    pub kinds: BTreeSet<String>,
    /// All must match.
    pub labels: BTreeMap<String, String>,
    /// Exact; empty: all.
    pub external_ref: String,
    /// At or after.
    pub created_after: Option<Utc>,
    /// Before this moment, UTC.
    pub created_before: Option<Utc>,
    /// Any of these; empty: all.
    pub task_ids: BTreeSet<TaskId>,
    /// Beginning of the id; empty: all.
    pub task_id_prefix: String,
}

impl TaskFilter {
    /// Whether a task is meant.
    pub fn admits(&self, intake: &TaskIntake, state: &TaskState) -> bool {
        (self.phases.is_empty() || self.phases.contains(&state.phase))
            && (self.robot_ids.is_empty() || state.robot_id.as_ref().is_some_and(|r| self.robot_ids.contains(r)))
            && self.admits_intake(intake)
    }

    /// Whether what was asked for is meant, wherever its task is.
    pub fn admits_intake(&self, intake: &TaskIntake) -> bool {
        let spec = &intake.spec;
        (self.kinds.is_empty() || self.kinds.contains(&spec.kind))
            && self.labels.iter().all(|(k, v)| spec.labels.get(k) == Some(v))
            && (self.external_ref.is_empty() || self.external_ref == spec.external_ref)
            && self.created_after.is_none_or(|t| intake.created >= t)
            && self.created_before.is_none_or(|t| intake.created < t)
            && (self.task_ids.is_empty() || self.task_ids.contains(&intake.task_id))
            && intake.task_id.as_str().starts_with(&self.task_id_prefix)
    }

    /// Whether it asks for anything of an intake but its id.
    pub fn has_intake_conditions(&self) -> bool {
        !(self.kinds.is_empty() && self.labels.is_empty() && self.external_ref.is_empty())
            || self.created_after.is_some()
            || self.created_before.is_some()
    }
}

impl super::Parse<TaskFilter> for v1::TaskFilter {
    fn parse_at(self, at: At<'_>, bad: &mut Violations) -> Option<TaskFilter> {
        let before = bad.0.len();
        for (name, length) in
            [("robot_ids", self.robot_ids.len()), ("types", self.types.len()), ("task_ids", self.task_ids.len())]
        {
            if length > limits::PAGE_MAX {
                bad.add(at.field(name).to_string(), "must be at most 1000");
            }
        }
        let states = self.states.iter().enumerate();
        let phases = states.filter_map(|(i, s)| word(*s, at.field("states").index(i), bad)).collect();
        let robots = self.robot_ids.iter().enumerate();
        let robot_ids =
            robots.filter_map(|(i, r)| id(r, RobotId::parse, at.field("robot_ids").index(i), bad)).collect();
        let tasks = self.task_ids.iter().enumerate();
        let task_ids = tasks.filter_map(|(i, t)| id(t, TaskId::parse, at.field("task_ids").index(i), bad)).collect();
        let created_after = parse_time(self.created_after.as_ref(), at.field("created_after"), bad);
        let created_before = parse_time(self.created_before.as_ref(), at.field("created_before"), bad);
        (bad.0.len() == before).then_some(TaskFilter {
            phases,
            robot_ids,
            kinds: self.types.into_iter().collect(),
            labels: self.labels,
            external_ref: self.external_ref,
            created_after,
            created_before,
            task_ids,
            task_id_prefix: self.task_id_prefix,
        })
    }
}
