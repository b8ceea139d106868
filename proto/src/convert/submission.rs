//! What callers submit: each form of a task becomes a raw task, and is checked by the rules of core under the names that its caller uses.

use super::{At, WireEnum, from_struct, maybe_id, parse_ms, parse_time};
use crate::task::v1;
use midshift_core::ids::{RequestId, TaskId, WaypointId};
use midshift_core::reason::{Refusal, Violations};
use midshift_core::rows::Revision;
use midshift_core::step::Effect;
use midshift_core::task::forms::Transport;
use midshift_core::task::raw::{RawRetry, RawStep, RawStepKind};
use midshift_core::task::types::catalogue::is_built_in;
use midshift_core::task::types::{TypeCatalogue, TypedTask};
use midshift_core::task::{RawTask, TaskSpec};
use prost::Message;

/// The label that keeps a short form's `created_at`.
const CREATED_AT: &str = "created_at";

/// A task that a caller submits, before its rules were checked.
#[derive(Clone, Debug)]
pub struct Submission {
    /// Protection against a double call.
    pub request_id: Option<RequestId>,
    /// Chosen by the caller.
    pub task_id: Option<TaskId>,
    /// Check only.
    pub validate_only: bool,
    /// What is to be done; of a task by type and fields its fields too, and no steps.
    task: TypedTask,
    form: Form,
    bad: Violations,
}

/// A task that broke no rule.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckedTask {
    /// What is wanted.
    pub spec: TaskSpec,
    /// Revision of its type, if that made its steps.
    pub type_revision: Option<Revision>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Form {
    Spec,
    Flat,
    Nested,
    Typed,
    Missing,
}

impl Submission {
    /// Reads a request; what is wrong with it is kept for [`Submission::check`], so that the caller hears everything at once.
    pub fn read(request: v1::SubmitTaskRequest) -> Self {
        use v1::submit_task_request::Body;
        let mut bad = Violations::default();
        let top = At::top("");
        let request_id = maybe_id(&request.request_id, RequestId::parse, top.field("request_id"), &mut bad).flatten();
        let plain = |task: RawTask| TypedTask { task, ..TypedTask::default() };
        let (form, own_id, task) = match request.body {
            Some(Body::Spec(spec)) => (Form::Spec, String::new(), plain(raw_task(spec, At::top("spec"), &mut bad))),
            Some(Body::Flat(flat)) => (Form::Flat, flat.task_id.clone(), plain(raw_flat(flat))),
            Some(Body::Nested(nested)) => (Form::Nested, nested.task_id.clone(), plain(raw_nested(nested))),
            Some(Body::Typed(typed)) => {
                (Form::Typed, typed.task_id.clone(), raw_typed(typed, At::top("typed"), &mut bad))
            }
            None => (Form::Missing, String::new(), TypedTask::default()),
        };
        let (chosen, at) =
            if request.task_id.is_empty() { (&own_id, "body.task_id") } else { (&request.task_id, "task_id") };
        let task_id = maybe_id(chosen, TaskId::parse, At::top(at), &mut bad).flatten();
        if !own_id.is_empty() && !request.task_id.is_empty() && own_id != request.task_id {
            bad.add("task_id", "differs from the task_id of the body");
        }
        Self { request_id, task_id, validate_only: request.validate_only, task, form, bad }
    }

    /// Whether its check reads the types that a site registered: not where it names a built-in one.
    pub fn needs_types(&self) -> bool {
        self.form == Form::Typed || !is_built_in(&self.task.task.kind)
    }

    /// Checks every rule. `knows` answers whether the site has a waypoint, `types` are those that the site knows.
    ///
    /// # Errors
    /// Each broken rule, or the type that it names is of a newer version.
    pub fn check(self, knows: &dyn Fn(&WaypointId) -> bool, types: &TypeCatalogue) -> Result<CheckedTask, Refusal> {
        let Self { task, form, mut bad, .. } = self;
        let (raw, type_revision) = match form {
            Form::Missing => {
                bad.add("body", "is required: one of spec, flat, nested, typed");
                return Err(Refusal::invalid(bad.0));
            }
            Form::Typed => make_typed(task, knows, types, &mut bad)?,
            Form::Spec | Form::Flat | Form::Nested => {
                let name = &task.task.kind;
                // What is no name at all is told below.
                if !name.is_empty() {
                    types.check_label(name, &form.name_of("type", false), &mut bad);
                }
                (task.task, None)
            }
        };
        let (has_from, has_steps, kept) = (raw.steps.len() > 1, !raw.steps.is_empty(), bad.0.len());
        let checked = raw.check("spec", knows);
        if let Err(refusal) = &checked {
            for violation in &refusal.violations {
                let name = violation.field.strip_prefix("spec.").unwrap_or(&violation.field);
                // What its type or its fields would have said, which are told of already.
                let is_of_type =
                    name.starts_with("steps") && !has_steps || name == "timeout" && type_revision.is_none();
                if form == Form::Typed && is_of_type {
                    continue;
                }
                let field = form.name_of(name, has_from);
                // Said once: what cannot be read, and a parameter of both legs of a short form.
                let said = if form == Form::Spec { kept } else { bad.0.len() };
                if !bad.0[..said].iter().any(|v| v.field == field) {
                    bad.add(field, violation.description.clone());
                }
            }
        }
        bad.finish()?;
        checked.map(|spec| CheckedTask { spec, type_revision })
    }
}

/// The steps that its type makes of a task's fields, with the revision of the type. Without steps where a rule is broken.
fn make_typed(
    task: TypedTask,
    knows: &dyn Fn(&WaypointId) -> bool,
    types: &TypeCatalogue,
    bad: &mut Violations,
) -> Result<(RawTask, Option<Revision>), Refusal> {
    match types.find_for(&task.task.kind, "typed.type", bad)? {
        Some((of, revision)) => Ok((task.into_raw(of, "typed.fields", knows, bad), Some(*revision))),
        None => Ok((task.task, None)),
    }
}

impl Form {
    /// What the caller calls the field that the full form calls `field`.
    fn name_of(self, field: &str, has_from: bool) -> String {
        let nested = self == Self::Nested;
        let name = match field {
            _ if self == Self::Spec => return format!("spec.{field}"),
            _ if self == Self::Typed && field.starts_with("steps") => return "typed.fields".to_owned(),
            "type" if self == Self::Typed => "type",
            "type" if !nested => "task_type",
            "timeout" => "timeout_seconds",
            "schedule_to_start_timeout" => "schedule_to_start_seconds",
            "retry.max_retry_times" if nested => "retry_strategy.max_retry_times",
            "retry.max_retry_times" => "max_retry_times",
            "retry.interval" if nested => "retry_strategy.retry_interval_seconds",
            "retry.interval" => "retry_interval_seconds",
            "steps[0].goto.waypoint" if has_from && nested => "content.from_waypoint",
            "steps[0].goto.waypoint" if has_from => "from_waypoint",
            "steps[0].goto.waypoint" | "steps[2].goto.waypoint" if nested => "content.to_waypoint",
            "steps[0].goto.waypoint" | "steps[2].goto.waypoint" => "to_waypoint",
            "steps[1].action.params" | "steps[3].action.params" if nested => "content.item_sku",
            "steps[1].action.params" | "steps[3].action.params" => "item_sku",
            "labels[created_at]" => CREATED_AT,
            other => other,
        };
        let form = match self {
            Self::Nested => "nested",
            Self::Typed => "typed",
            Self::Spec | Self::Flat | Self::Missing => "flat",
        };
        format!("{form}.{name}")
    }
}

/// The bytes that make two requests the same: all of it but what does not change what is asked for.
pub fn canonical(request: &v1::SubmitTaskRequest) -> Vec<u8> {
    v1::SubmitTaskRequest { request_id: String::new(), validate_only: false, ..request.clone() }.encode_to_vec()
}

/// A spec as it was sent. What cannot be read is a violation, and absent.
fn raw_task(spec: v1::TaskSpec, at: At<'_>, bad: &mut Violations) -> RawTask {
    let selector = spec.selector.unwrap_or_default();
    let steps = spec.steps.into_iter().enumerate();
    RawTask {
        kind: spec.r#type,
        priority: spec.priority.map(i64::from),
        robot_id: spec.robot_id,
        selector_labels: selector.labels,
        capabilities: selector.capabilities,
        minimum_software: selector.minimum_software,
        payload_g: selector.payload_g,
        steps: steps.map(|(i, step)| raw_step(step, at.field("steps").index(i), bad)).collect(),
        timeout_ms: parse_ms(spec.timeout.as_ref(), at.field("timeout"), bad),
        schedule_to_start_ms: parse_ms(
            spec.schedule_to_start_timeout.as_ref(),
            at.field("schedule_to_start_timeout"),
            bad,
        ),
        stall_ms: parse_ms(spec.stall_timeout.as_ref(), at.field("stall_timeout"), bad),
        not_before: parse_time(spec.not_before.as_ref(), at.field("not_before"), bad),
        deadline: parse_time(spec.deadline.as_ref(), at.field("deadline"), bad),
        retry: spec.retry.map(|retry| raw_retry(retry, at.field("retry"), bad)),
        preemptible: spec.preemptible,
        depends_on: spec.depends_on,
        coalesce_key: spec.coalesce_key,
        same_robot_as: spec.same_robot_as,
        speed_limit_mm_s: spec.speed_limit_mm_s,
        labels: spec.labels,
        requester: spec.requester,
        external_ref: spec.external_ref,
        trace_context: spec.trace_context,
    }
}

fn raw_step(step: v1::Step, at: At<'_>, bad: &mut Violations) -> RawStep {
    use v1::step::Kind;
    let kind = step.kind.map(|kind| match kind {
        Kind::Goto(goto) => RawStepKind::Goto(goto.waypoint),
        Kind::Action(action) => {
            let params = from_struct(action.params, at.field("action").field("params"), bad);
            RawStepKind::Action(action.name, params.unwrap_or_default())
        }
        Kind::Wait(wait) => {
            let ms = parse_ms(wait.duration.as_ref(), at.field("wait").field("duration"), bad);
            RawStepKind::Wait(ms.unwrap_or(0))
        }
    });
    let on_fail = |number| match v1::OnFail::try_from(number) {
        Ok(v1::OnFail::Stop) => Some(false),
        Ok(v1::OnFail::Continue) => Some(true),
        Ok(v1::OnFail::Unspecified) | Err(_) => None,
    };
    RawStep {
        kind,
        effect: step.effect.map(Effect::from_wire),
        pause_allowed: step.pause_allowed,
        cancel_allowed: step.cancel_allowed,
        timeout_ms: parse_ms(step.timeout.as_ref(), at.field("timeout"), bad),
        continue_on_fail: step.on_fail.map(on_fail),
    }
}

fn raw_retry(retry: v1::RetryPolicy, at: At<'_>, bad: &mut Violations) -> RawRetry {
    RawRetry {
        max_retry_times: i64::from(retry.max_retry_times),
        interval_ms: parse_ms(retry.interval.as_ref(), at.field("interval"), bad),
        factor: retry.factor,
        max_interval_ms: parse_ms(retry.max_interval.as_ref(), at.field("max_interval"), bad),
        jitter: retry.jitter,
        exclude_failed_robot: retry.exclude_failed_robot,
    }
}

fn seconds(value: Option<i32>) -> Option<i64> {
    value.map(|s| i64::from(s) * 1000)
}

fn with_created_at(mut raw: RawTask, created_at: String) -> RawTask {
    if !created_at.is_empty() {
        raw.labels.insert(CREATED_AT.to_owned(), created_at);
    }
    raw
}

/// A flat task as it was sent.
fn raw_flat(flat: v1::FlatTask) -> RawTask {
    let transport = Transport {
        kind: flat.task_type,
        priority: flat.priority.map(i64::from),
        robot_id: flat.robot_id,
        from_waypoint: flat.from_waypoint,
        to_waypoint: flat.to_waypoint,
        item_sku: flat.item_sku,
        timeout_ms: seconds(flat.timeout_seconds),
        max_retry_times: flat.max_retry_times.map(i64::from),
        retry_interval_ms: seconds(flat.retry_interval_seconds),
        schedule_to_start_ms: seconds(flat.schedule_to_start_seconds),
        same_robot_as: flat.same_robot_as,
        coalesce_key: flat.coalesce_key,
    };
    with_created_at(transport.into_raw(), flat.created_at)
}

/// A nested task as it was sent.
fn raw_nested(nested: v1::NestedTask) -> RawTask {
    let content = nested.content.unwrap_or_default();
    let retry = nested.retry_strategy.unwrap_or_default();
    let transport = Transport {
        kind: nested.r#type,
        priority: nested.priority.map(i64::from),
        robot_id: nested.robot_id,
        from_waypoint: content.from_waypoint,
        to_waypoint: content.to_waypoint,
        item_sku: content.item_sku,
        timeout_ms: seconds(nested.timeout_seconds),
        max_retry_times: retry.max_retry_times.map(i64::from),
        retry_interval_ms: seconds(retry.retry_interval_seconds),
        schedule_to_start_ms: seconds(nested.schedule_to_start_seconds),
        same_robot_as: nested.same_robot_as,
        coalesce_key: nested.coalesce_key,
    };
    with_created_at(transport.into_raw(), nested.created_at)
}

/// A task by type and fields as it was sent. What cannot be read is a violation, and absent.
fn raw_typed(typed: v1::TypedTask, at: At<'_>, bad: &mut Violations) -> TypedTask {
    let fields = from_struct(typed.fields, at.field("fields"), bad).unwrap_or_default();
    let retry = (typed.max_retry_times.is_some() || typed.retry_interval_seconds.is_some()).then(|| RawRetry {
        max_retry_times: typed.max_retry_times.map_or(0, i64::from),
        interval_ms: seconds(typed.retry_interval_seconds),
        ..RawRetry::default()
    });
    let task = RawTask {
        kind: typed.r#type,
        priority: typed.priority.map(i64::from),
        robot_id: typed.robot_id,
        timeout_ms: seconds(typed.timeout_seconds),
        schedule_to_start_ms: seconds(typed.schedule_to_start_seconds),
        not_before: parse_time(typed.not_before.as_ref(), at.field("not_before"), bad),
        deadline: parse_time(typed.deadline.as_ref(), at.field("deadline"), bad),
        retry,
        preemptible: typed.preemptible,
        depends_on: typed.depends_on,
        same_robot_as: typed.same_robot_as,
        coalesce_key: typed.coalesce_key,
        labels: typed.labels,
        external_ref: typed.external_ref,
        ..RawTask::default()
    };
    TypedTask { task: with_created_at(task, typed.created_at), fields }
}
