//! Tasks there and back, and what makes two requests the same.

use midshift_core::ids::TaskId;
use midshift_core::reason::{Code, Reason};
use midshift_core::rows::Revision;
use midshift_core::task::types::TypeCatalogue;
use midshift_core::task::{Phase, Resolution, TaskIntake, TaskSpec, TaskState};
use midshift_core::time::Utc;
use midshift_proto::convert::submission::{Submission, canonical};
use midshift_proto::convert::task::{TaskFilter, TaskView, encode_task, revision_of};
use midshift_proto::json::from_json;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_request::Body};
use serde_json::json;

fn full_spec() -> serde_json::Value {
    json!({
        "type": "transport", "priority": 0, "robotId": "rbt-01",
        "selector": {"labels": {"floor": "1"}, "capabilities": ["lift"], "minimumSoftware": "1.4.0", "payloadG": 800},
        "steps": [
            {"goto": {"waypoint": "A01"}, "effect": "STEP_EFFECT_REPEATABLE"},
            {"action": {"name": "pick", "params": {"item": "SKU-1", "n": 2, "f": 1.5}}, "pauseAllowed": false, "timeout": "30s", "onFail": "ON_FAIL_CONTINUE"},
            {"wait": {"duration": "2.500s"}, "cancelAllowed": false}
        ],
        "timeout": "300s", "scheduleToStartTimeout": "60s", "stallTimeout": "20s",
        "notBefore": "2026-06-01T08:00:00Z", "deadline": "2026-06-01T09:00:00.250Z",
        "retry": {"maxRetryTimes": 3, "interval": "10s", "factor": 1.5, "maxInterval": "60s", "jitter": 0.1, "excludeFailedRobot": true},
        "preemptible": true, "dependsOn": ["TASK-1"], "speedLimitMmS": 900, "labels": {"shift": "late"},
        "requester": "wms", "externalRef": "WO-7", "traceContext": "00-ab-cd-01"
    })
}

fn spec_of(value: serde_json::Value) -> TaskSpec {
    let request: SubmitTaskRequest = from_json(json!({ "spec": value })).expect("json");
    Submission::read(request).check(&|_| true, &TypeCatalogue::default()).expect("valid").spec
}

#[test]
fn a_spec_comes_back_as_it_was_understood() {
    let spec = spec_of(full_spec());
    let body = Some(Body::Spec(v1::TaskSpec::from(&spec)));
    let again = Submission::read(SubmitTaskRequest { body, ..SubmitTaskRequest::default() });
    let again = again.check(&|_| true, &TypeCatalogue::default()).expect("valid").spec;
    assert_eq!(again, spec);
    assert_eq!(
        (spec.steps[2].effect, spec.steps[1].timeout_ms, spec.not_before),
        (midshift_core::step::Effect::Repeatable, Some(30_000), Some(Utc(1_780_300_800_000)))
    );
}

#[test]
fn an_enum_said_as_unspecified_is_a_violation_and_not_the_default() {
    let mut value = full_spec();
    value["steps"][0]["effect"] = json!("STEP_EFFECT_UNSPECIFIED");
    value["steps"][1]["onFail"] = json!(0);
    let request: SubmitTaskRequest = from_json(json!({ "spec": value })).expect("json");
    let refusal = Submission::read(request).check(&|_| true, &TypeCatalogue::default()).expect_err("invalid");
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["spec.steps[0].effect", "spec.steps[1].on_fail"]);
}

#[test]
fn ids_and_rules_are_refused_in_one_answer() {
    let request = from_json(json!({"request_id": "with space", "task_id": "§", "spec": {"type": "x"}})).expect("json");
    let refusal = Submission::read(request).check(&|_| true, &TypeCatalogue::default()).expect_err("invalid");
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["request_id", "task_id", "spec.timeout", "spec.steps"]);
    let refusal = Submission::read(SubmitTaskRequest::default())
        .check(&|_| true, &TypeCatalogue::default())
        .expect_err("invalid");
    assert_eq!(refusal.violations[0].field, "body");
}

#[test]
fn a_parameter_that_json_cannot_say_is_refused_by_its_path() {
    let mut request: SubmitTaskRequest = from_json(json!({ "spec": full_spec() })).expect("json");
    let Some(Body::Spec(spec)) = &mut request.body else { panic!("a spec") };
    let Some(v1::step::Kind::Action(action)) = &mut spec.steps[1].kind else { panic!("an action") };
    let number = Some(prost_types::value::Kind::NumberValue(f64::NAN));
    action.params.get_or_insert_default().fields.insert("f".to_owned(), prost_types::Value { kind: number });
    let refusal = Submission::read(request).check(&|_| true, &TypeCatalogue::default()).expect_err("invalid");
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["spec.steps[1].action.params.f"]);
}

#[test]
fn times_that_are_none_are_each_refused_once_by_their_field() {
    let mut request: SubmitTaskRequest = from_json(json!({ "spec": full_spec() })).expect("json");
    let Some(Body::Spec(spec)) = &mut request.body else { panic!("a spec") };
    // Each would be within its bounds if its nanos were counted, or if it were cut off.
    let span = Some(prost_types::Duration { seconds: 1, nanos: 2_000_000_000 });
    let time = Some(prost_types::Timestamp { seconds: 1_780_300_800, nanos: -1 });
    (spec.timeout, spec.schedule_to_start_timeout, spec.stall_timeout) = (span, span, span);
    (spec.not_before, spec.deadline) = (time, time);
    let retry = spec.retry.get_or_insert_default();
    (retry.interval, retry.max_interval) = (span, span);
    spec.steps[1].timeout = span;
    spec.steps[2].kind = Some(v1::step::Kind::Wait(v1::Wait { duration: span }));
    let refusal = Submission::read(request).check(&|_| true, &TypeCatalogue::default()).expect_err("invalid");
    let mut fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    fields.sort_unstable();
    let names = [
        "deadline",
        "not_before",
        "retry.interval",
        "retry.max_interval",
        "schedule_to_start_timeout",
        "stall_timeout",
        "steps[1].timeout",
        "steps[2].wait.duration",
        "timeout",
    ];
    assert_eq!(fields, names.map(|name| format!("spec.{name}")));
}

#[test]
fn requests_are_the_same_whatever_their_request_id_and_differ_with_their_body() {
    let request = |id: &str, kind: &str| -> SubmitTaskRequest {
        from_json(json!({"request_id": id, "spec": {"type": kind, "labels": {"b": "2", "a": "1"}}})).expect("json")
    };
    assert_eq!(canonical(&request("r1", "patrol")), canonical(&request("r2", "patrol")));
    assert_ne!(canonical(&request("r1", "patrol")), canonical(&request("r1", "pick")));
}

fn rows() -> (TaskIntake, TaskState) {
    let intake = TaskIntake {
        task_id: TaskId::parse("TASK-20260601-AAAAAAAAAA").expect("id"),
        spec: spec_of(full_spec()),
        actor: "wms".into(),
        request_id: "r1".into(),
        payload_hash: String::new(),
        created: Utc(1_780_300_000_000),
        number: 42,
        type_revision: None,
    };
    let state = TaskState::born(&intake);
    (intake, state)
}

#[test]
fn a_task_shows_its_state_its_reason_in_words_and_its_revision_as_etag() {
    let (intake, mut state) = rows();
    state.phase = Phase::NeedsOperator;
    state.reason = Some(Reason::from(Code::AttemptsSpent));
    state.holds.insert("resume:s1".into());
    let allowed = [Resolution::Requeue, Resolution::Canceled];
    let task = encode_task(TaskView {
        intake: &intake,
        state: &state,
        revision: Revision(9),
        attempt: None,
        allowed: &allowed,
    });
    assert_eq!(task.state(), v1::TaskState::NeedsOperator);
    assert_eq!(task.reason.expect("reason").message, Code::AttemptsSpent.help());
    assert_eq!(revision_of(&task.etag), Some(Revision(9)));
    assert_eq!((task.hold_tokens, task.number), (vec!["resume:s1".to_owned()], 42));
    assert_eq!(task.allowed_resolutions, [v1::Resolution::Requeue as i32, v1::Resolution::Canceled as i32]);
    assert_eq!((revision_of(""), revision_of("made-up")), (None, Some(Revision(0))));
}

#[test]
fn a_filter_admits_only_what_meets_all_its_fields() {
    let (intake, state) = rows();
    let filter = |value: serde_json::Value| -> TaskFilter {
        midshift_proto::parse(from_json::<v1::TaskFilter>(value).expect("json")).expect("valid")
    };
    let cases = [
        (json!({}), true),
        (
            json!({"states": ["TASK_STATE_QUEUED", "TASK_STATE_RUNNING"], "types": ["transport"], "labels": {"shift": "late"}}),
            true,
        ),
        (json!({"states": ["TASK_STATE_RUNNING"]}), false),
        (json!({"robotIds": ["rbt-01"]}), false),
        (json!({"externalRef": "WO-7", "taskIdPrefix": "TASK-2026"}), true),
        (json!({"taskIdPrefix": "TASK-2027"}), false),
        (json!({"createdAfter": "2026-06-01T08:00:00Z"}), false),
        (json!({"createdBefore": "2026-06-01T08:00:00Z"}), true),
        (json!({"labels": {"shift": "early"}}), false),
    ];
    for (value, wanted) in cases {
        assert_eq!(filter(value.clone()).admits(&intake, &state), wanted, "{value}");
    }
    let mut wire = from_json::<v1::TaskFilter>(json!({"states": [0]})).expect("json");
    let time = Some(prost_types::Timestamp { seconds: 0, nanos: 1_000_000_000 });
    (wire.created_after, wire.created_before) = (time, time);
    let refusal = midshift_proto::parse::<TaskFilter, _>(wire).expect_err("invalid");
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["states[0]", "created_after", "created_before"]);
}
