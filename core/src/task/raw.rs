//! A task as a caller sent it, and the one place where its rules are checked: all violations are found at once and nothing is half-taken.
//!
//! Called by the task service on receipt. The .proto comments state the same rules; a table test holds both together.

use super::edit::is_in_order;
use super::spec::{DEFAULT_PRIORITY, LEAST_PRIORITY, Retry, Selector, TaskSpec};
use crate::ids::{RobotId, TaskId, WaypointId};
use crate::limits;
use crate::reason::{Refusal, Violations};
use crate::step::{Effect, StepKind, WorkStep};
use crate::time::Utc;
use std::collections::{BTreeMap, BTreeSet};

/// A task before any rule was checked. Absent means that the caller said nothing.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RawTask {
    /// See `TaskSpec`; the same for all below.
    pub kind: String,
    /// 0..=9; absent: 5.
    pub priority: Option<i64>,
    /// Empty: any.
    pub robot_id: String,
    /// Selector: labels.
    pub selector_labels: BTreeMap<String, String>,
    /// Selector: capabilities.
    pub capabilities: Vec<String>,
    /// Selector: least software version; empty: any.
    pub minimum_software: String,
    /// Selector: grams.
    pub payload_g: u32,
    /// Steps in the order in which they are done.
    pub steps: Vec<RawStep>,
    /// Limit of one attempt, milliseconds of site time; required.
    pub timeout_ms: Option<i64>,
    /// Absent: no limit.
    pub schedule_to_start_ms: Option<i64>,
    /// Absent: 60 s.
    pub stall_ms: Option<i64>,
    /// Absent: at once.
    pub not_before: Option<Utc>,
    /// Absent: never.
    pub deadline: Option<Utc>,
    /// Absent: no retry.
    pub retry: Option<RawRetry>,
    /// Absent: false.
    pub preemptible: bool,
    /// Task ids.
    pub depends_on: Vec<String>,
    /// Id of a task; empty: any robot.
    pub same_robot_as: String,
    /// Empty: it stands for itself.
    pub coalesce_key: String,
    /// Absent: the area's.
    pub speed_limit_mm_s: Option<u32>,
    /// Labels of the task, for people and filters.
    pub labels: BTreeMap<String, String>,
    /// Who asked.
    pub requester: String,
    /// Work order.
    pub external_ref: String,
    /// W3C traceparent.
    pub trace_context: String,
}

/// A step before any rule was checked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RawStep {
    /// What; none is refused.
    pub kind: Option<RawStepKind>,
    /// Absent: by kind. `Some(None)`: the caller said UNSPECIFIED, which is refused.
    pub effect: Option<Option<Effect>>,
    /// Absent: true.
    pub pause_allowed: Option<bool>,
    /// Absent: true.
    pub cancel_allowed: Option<bool>,
    /// Absent: none.
    pub timeout_ms: Option<i64>,
    /// Absent: false. `Some(None)`: UNSPECIFIED, refused.
    pub continue_on_fail: Option<Option<bool>>,
}

/// Kind of a raw step.
#[derive(Clone, Debug, PartialEq)]
pub enum RawStepKind {
    /// Drive to a waypoint.
    Goto(String),
    /// Act where it stands: name of the action, and its parameters.
    Action(String, serde_json::Map<String, serde_json::Value>),
    /// Stand, milliseconds.
    Wait(i64),
}

/// Retry before any rule was checked.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RawRetry {
    /// Attempts after the first.
    pub max_retry_times: i64,
    /// Absent: 5 s.
    pub interval_ms: Option<i64>,
    /// Absent: 2.
    pub factor: Option<f64>,
    /// Absent: 5 min.
    pub max_interval_ms: Option<i64>,
    /// Absent: 0.2.
    pub jitter: Option<f64>,
    /// Absent: false.
    pub exclude_failed_robot: bool,
}

/// Whether this may name a type, a capability, an action or a field: 1-64 of [a-z0-9-_].
pub(super) fn name_ok(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '-' | '_'))
}

fn version_ok(text: &str) -> bool {
    parse_version(text).is_some()
}

/// `major.minor.patch` of a version; what follows `-` or `+` is left out.
pub fn parse_version(text: &str) -> Option<(u64, u64, u64)> {
    let core = text.split(['-', '+']).next()?;
    let mut parts = core.split('.').map(|p| p.parse().ok());
    let version = (parts.next()??, parts.next()??, parts.next()??);
    parts.next().is_none().then_some(version)
}

impl RawTask {
    /// Checks every rule. `knows` answers whether the site has a waypoint. `field` is the path of the task within the request.
    pub fn check(self, field: &str, knows: &dyn Fn(&WaypointId) -> bool) -> Result<TaskSpec, Refusal> {
        let mut bad = Violations::default();
        if !name_ok(&self.kind) {
            bad.add(format!("{field}.type"), "is required, 1-64 of [a-z0-9-_]");
        }
        let priority = self.priority.unwrap_or(i64::from(DEFAULT_PRIORITY));
        if !(0..=i64::from(LEAST_PRIORITY)).contains(&priority) {
            bad.add(format!("{field}.priority"), "must be 0..9, 0 most urgent");
        }
        let robot_id = match self.robot_id.as_str() {
            "" => None,
            text => bad.accept(&format!("{field}.robot_id"), RobotId::parse(text)),
        };
        let timeout_ms = self.check_times(field, &mut bad);
        let selector = self.check_selector(field, &mut bad);
        let steps = check_steps(&self.steps, field, knows, &mut bad);
        let retry = check_retry(self.retry.as_ref(), field, &mut bad);
        let depends_on = self.check_depends(field, &mut bad);
        let same_robot_as = self.check_same_robot(field, &mut bad);
        check_labels(&self.labels, &format!("{field}.labels"), &mut bad);
        if self.speed_limit_mm_s.is_some_and(|v| !(50..=5_000).contains(&v)) {
            bad.add(format!("{field}.speed_limit_mm_s"), "must be 50..5000 mm/s");
        }
        for (name, text) in [
            ("coalesce_key", &self.coalesce_key),
            ("requester", &self.requester),
            ("external_ref", &self.external_ref),
            ("trace_context", &self.trace_context),
        ] {
            if text.len() > 128 {
                bad.add(format!("{field}.{name}"), "must be at most 128 bytes");
            }
        }
        bad.finish()?;
        Ok(TaskSpec {
            kind: self.kind,
            priority: priority as u8,
            robot_id,
            selector,
            steps,
            timeout_ms,
            schedule_to_start_ms: self.schedule_to_start_ms.map(|v| v as u64),
            stall_ms: self.stall_ms.map_or(limits::STALL_DEFAULT.as_ms(), |v| v as u64),
            not_before: self.not_before,
            deadline: self.deadline,
            retry,
            preemptible: self.preemptible,
            depends_on,
            same_robot_as,
            coalesce_key: self.coalesce_key,
            speed_limit_mm_s: self.speed_limit_mm_s,
            labels: self.labels,
            requester: self.requester,
            external_ref: self.external_ref,
            trace_context: self.trace_context,
        })
    }

    fn check_times(&self, field: &str, bad: &mut Violations) -> u64 {
        let in_range = |v: i64| u64::try_from(v).is_ok_and(|v| limits::TASK_TIMEOUT_MS.contains(&v));
        match self.timeout_ms {
            None => bad.add(format!("{field}.timeout"), "is required: how long one attempt may take, 1 s .. 24 h"),
            Some(v) if !in_range(v) => bad.add(format!("{field}.timeout"), "must be 1 s .. 24 h"),
            Some(_) => {}
        }
        for (name, value) in
            [("schedule_to_start_timeout", self.schedule_to_start_ms), ("stall_timeout", self.stall_ms)]
        {
            if value.is_some_and(|v| !in_range(v)) {
                bad.add(format!("{field}.{name}"), "must be 1 s .. 24 h");
            }
        }
        if !is_in_order(self.not_before, self.deadline) {
            bad.add(format!("{field}.deadline"), "must be after not_before");
        }
        self.timeout_ms.unwrap_or(0).max(0) as u64
    }

    fn check_selector(&self, field: &str, bad: &mut Violations) -> Selector {
        check_labels(&self.selector_labels, &format!("{field}.selector.labels"), bad);
        for (i, capability) in self.capabilities.iter().enumerate() {
            if !name_ok(capability) {
                bad.add(format!("{field}.selector.capabilities[{i}]"), "must be 1-64 of [a-z0-9-_]");
            }
        }
        if self.capabilities.len() > limits::LABELS_MAX {
            bad.add(format!("{field}.selector.capabilities"), "must be at most 32");
        }
        if !self.minimum_software.is_empty() && !version_ok(&self.minimum_software) {
            bad.add(format!("{field}.selector.minimum_software"), "must be a semantic version, e.g. 1.4.0");
        }
        Selector {
            labels: self.selector_labels.clone(),
            capabilities: self.capabilities.clone(),
            minimum_software: Some(self.minimum_software.clone()).filter(|v| !v.is_empty()),
            payload_g: self.payload_g,
        }
    }

    fn check_depends(&self, field: &str, bad: &mut Violations) -> Vec<TaskId> {
        if self.depends_on.len() > limits::DEPENDS_ON_MAX {
            bad.add(format!("{field}.depends_on"), "must be at most 32");
        }
        let mut seen = BTreeSet::new();
        let mut ids = Vec::new();
        for (i, text) in self.depends_on.iter().enumerate() {
            let at = format!("{field}.depends_on[{i}]");
            if let Some(id) = bad.accept(&at, TaskId::parse(text)) {
                if !seen.insert(id.clone()) {
                    bad.add(at, "stands there twice");
                }
                ids.push(id);
            }
        }
        ids
    }

    fn check_same_robot(&self, field: &str, bad: &mut Violations) -> Option<TaskId> {
        if self.same_robot_as.is_empty() {
            return None;
        }
        let at = format!("{field}.same_robot_as");
        if !self.robot_id.is_empty() {
            bad.add(&at, "must not be with robot_id: name the robot, or the task whose robot it is");
        }
        bad.accept(&at, TaskId::parse(&self.same_robot_as))
    }
}

/// Notes every rule that labels break, under `field`.
pub fn check_labels(labels: &BTreeMap<String, String>, field: &str, bad: &mut Violations) {
    if labels.len() > limits::LABELS_MAX {
        bad.add(field, "must be at most 32 entries");
    }
    for (key, value) in labels {
        if !(1..=63).contains(&key.len()) || !(1..=63).contains(&value.len()) {
            bad.add(format!("{field}[{key}]"), "key and value must be 1-63 bytes");
        }
    }
}

/// Lists and objects within each other.
fn depth(value: &serde_json::Value) -> usize {
    match value {
        serde_json::Value::Array(items) => 1 + items.iter().map(depth).max().unwrap_or(0),
        serde_json::Value::Object(fields) => 1 + fields.values().map(depth).max().unwrap_or(0),
        _ => 0,
    }
}

/// Size of parameters as JSON.
fn json_bytes(params: &serde_json::Map<String, serde_json::Value>) -> usize {
    serde_json::to_string(params).map_or(usize::MAX, |json| json.len())
}

fn check_steps(
    raw: &[RawStep],
    field: &str,
    knows: &dyn Fn(&WaypointId) -> bool,
    bad: &mut Violations,
) -> Vec<WorkStep> {
    if !(1..=limits::STEPS_MAX).contains(&raw.len()) {
        bad.add(format!("{field}.steps"), "must be 1..64 steps");
    }
    let params = raw.iter().map(|step| match &step.kind {
        Some(RawStepKind::Action(_, params)) if !params.is_empty() => json_bytes(params),
        _ => 0,
    });
    if params.fold(0, usize::saturating_add) > limits::PARAMS_OF_TASK_BYTES_MAX {
        bad.add(format!("{field}.steps"), "must have parameters of at most 32 KiB in all, as JSON");
    }
    raw.iter()
        .enumerate()
        .filter_map(|(i, step)| check_step(step, &format!("{field}.steps[{i}]"), knows, bad))
        .collect()
}

fn check_step(step: &RawStep, at: &str, knows: &dyn Fn(&WaypointId) -> bool, bad: &mut Violations) -> Option<WorkStep> {
    if step.effect == Some(None) {
        bad.add(format!("{at}.effect"), "UNSPECIFIED is not a value; leave it out for the default");
    }
    if step.continue_on_fail == Some(None) {
        bad.add(format!("{at}.on_fail"), "UNSPECIFIED is not a value; leave it out for the default");
    }
    if step.timeout_ms.is_some_and(|v| !u64::try_from(v).is_ok_and(|v| limits::TASK_TIMEOUT_MS.contains(&v))) {
        bad.add(format!("{at}.timeout"), "must be 1 s .. 24 h");
    }
    let (kind, default_effect) = match &step.kind {
        None => {
            bad.add(at, "must be one of goto, action, wait");
            return None;
        }
        Some(RawStepKind::Goto(name)) => {
            let waypoint = bad.accept(&format!("{at}.goto.waypoint"), WaypointId::parse(name))?;
            if !knows(&waypoint) {
                bad.add(format!("{at}.goto.waypoint"), format!("the site has no waypoint {waypoint}"));
            }
            (StepKind::Goto { waypoint }, Effect::Repeatable)
        }
        Some(RawStepKind::Action(name, params)) => {
            if !name_ok(name) {
                bad.add(format!("{at}.action.name"), "is required, 1-64 of [a-z0-9-_]");
            }
            if json_bytes(params) > limits::PARAMS_BYTES_MAX {
                bad.add(format!("{at}.action.params"), "must be at most 8 KiB");
            }
            if params.values().map(depth).max().unwrap_or(0) > limits::PARAMS_DEPTH_MAX {
                bad.add(format!("{at}.action.params"), "must have at most 16 lists and objects within each other");
            }
            let effect =
                if matches!(name.as_str(), "pick" | "place") { Effect::AtMostOnce } else { Effect::CheckFirst };
            (StepKind::Action { name: name.clone(), params: params.clone() }, effect)
        }
        Some(RawStepKind::Wait(ms)) => {
            if *ms <= 0 || *ms > 86_400_000 {
                bad.add(format!("{at}.wait.duration"), "must be above 0 and at most 24 h");
            }
            (StepKind::Wait { duration_ms: (*ms).max(0) as u64 }, Effect::Repeatable)
        }
    };
    Some(WorkStep {
        kind,
        effect: step.effect.flatten().unwrap_or(default_effect),
        pause_allowed: step.pause_allowed.unwrap_or(true),
        cancel_allowed: step.cancel_allowed.unwrap_or(true),
        timeout_ms: step.timeout_ms.map(|v| v.max(0) as u64),
        continue_on_fail: step.continue_on_fail.flatten().unwrap_or(false),
    })
}

fn check_retry(raw: Option<&RawRetry>, field: &str, bad: &mut Violations) -> Retry {
    let Some(raw) = raw else { return Retry::default() };
    let default = Retry::default();
    let at = format!("{field}.retry");
    if !(0..=i64::from(limits::RETRY_TIMES_MAX)).contains(&raw.max_retry_times) {
        bad.add(format!("{at}.max_retry_times"), "must be 0..100");
    }
    for (name, value) in [("interval", raw.interval_ms), ("max_interval", raw.max_interval_ms)] {
        if value.is_some_and(|v| !(0..=86_400_000).contains(&v)) {
            bad.add(format!("{at}.{name}"), "must be 0 .. 24 h");
        }
    }
    if raw.factor.is_some_and(|f| !(1.0..=10.0).contains(&f)) {
        bad.add(format!("{at}.factor"), "must be 1..10");
    }
    if raw.jitter.is_some_and(|j| !(0.0..=1.0).contains(&j)) {
        bad.add(format!("{at}.jitter"), "must be 0..1");
    }
    let interval_ms = raw.interval_ms.map_or(default.interval_ms, |v| v.max(0) as u64);
    Retry {
        max_retry_times: raw.max_retry_times.clamp(0, i64::from(limits::RETRY_TIMES_MAX)) as u32,
        interval_ms,
        factor: raw.factor.unwrap_or(default.factor),
        max_interval_ms: raw.max_interval_ms.map_or(default.max_interval_ms.max(interval_ms), |v| v.max(0) as u64),
        jitter: raw.jitter.unwrap_or(default.jitter),
        exclude_failed_robot: raw.exclude_failed_robot,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn transport() -> RawTask {
        super::super::forms::Transport {
            kind: "transport".into(),
            from_waypoint: "A01".into(),
            to_waypoint: "B03".into(),
            item_sku: "SKU-1".into(),
            timeout_ms: Some(300_000),
            ..super::super::forms::Transport::default()
        }
        .into_raw()
    }

    #[test]
    fn a_good_transport_becomes_goto_pick_goto_place() {
        let spec = transport().check("flat", &|_| true).expect("valid");
        let effects: Vec<_> = spec.steps.iter().map(|s| s.effect).collect();
        assert_eq!(effects, [Effect::Repeatable, Effect::AtMostOnce, Effect::Repeatable, Effect::AtMostOnce]);
        assert_eq!(spec.goals(0).map(ToString::to_string).collect::<Vec<_>>(), ["A01", "B03"]);
    }

    #[test]
    fn every_violation_is_listed_at_once() {
        let raw = RawTask {
            kind: "Bad Kind".into(),
            priority: Some(10),
            timeout_ms: None,
            coalesce_key: "k".repeat(129),
            robot_id: "r1".into(),
            same_robot_as: "no id".into(),
            steps: vec![
                RawStep::default(),
                RawStep { kind: Some(RawStepKind::Goto("nowhere".into())), effect: Some(None), ..RawStep::default() },
            ],
            retry: Some(RawRetry { max_retry_times: 101, jitter: Some(2.0), ..RawRetry::default() }),
            ..RawTask::default()
        };
        let refusal = raw.check("spec", &|_| false).expect_err("invalid");
        let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
        assert_eq!(
            fields,
            [
                "spec.type",
                "spec.priority",
                "spec.timeout",
                "spec.steps[0]",
                "spec.steps[1].effect",
                "spec.steps[1].goto.waypoint",
                "spec.retry.max_retry_times",
                "spec.retry.jitter",
                "spec.same_robot_as",
                "spec.same_robot_as",
                "spec.coalesce_key"
            ]
        );
    }

    #[test]
    fn parameters_that_lie_too_deep_for_readers_are_refused() {
        let nested = |levels| (0..levels).fold(serde_json::Value::Null, |inner, _| serde_json::json!([inner]));
        let check = |levels| {
            let params = serde_json::Map::from_iter([("p".to_owned(), nested(levels))]);
            let step = RawStep { kind: Some(RawStepKind::Action("inspect".into(), params)), ..RawStep::default() };
            RawTask { steps: vec![step], ..transport() }.check("spec", &|_| true)
        };
        assert!(check(limits::PARAMS_DEPTH_MAX).is_ok());
        let refusal = check(limits::PARAMS_DEPTH_MAX + 1).expect_err("too deep");
        let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
        assert_eq!(fields, ["spec.steps[0].action.params"]);
    }
}
