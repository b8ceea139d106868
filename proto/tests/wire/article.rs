//! Both JSON forms of the source article, as they stand.

use midshift_core::step::{Effect, StepKind};
use midshift_core::task::TaskSpec;
use midshift_core::task::types::TypeCatalogue;
use midshift_proto::convert::submission::Submission;
use midshift_proto::json::from_json;
use midshift_proto::task::v1::SubmitTaskRequest;
use serde_json::{Value, json};

fn golden(name: &str) -> Value {
    let path = format!("{}/golden/{name}.json", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(path).expect("golden file")).expect("json")
}

fn submitted(form: &str) -> (Submission, TaskSpec) {
    let request = json!({ form: golden(&format!("article_{form}")) });
    let read = || Submission::read(from_json::<SubmitTaskRequest>(request.clone()).expect("the form as it stands"));
    (read(), read().check(&|w| ["A01", "B03"].contains(&w.as_str()), &TypeCatalogue::default()).expect("valid").spec)
}

#[test]
fn both_forms_of_the_article_are_one_task_of_goto_pick_goto_place() {
    let (flat, flat_spec) = submitted("flat");
    let (nested, nested_spec) = submitted("nested");
    assert_eq!(flat_spec, nested_spec);
    assert_eq!(flat.task_id.as_ref().map(ToString::to_string).as_deref(), Some("TASK-20260601-001"));
    assert_eq!(flat.task_id, nested.task_id);
    let steps: Vec<_> = flat_spec
        .steps
        .iter()
        .map(|s| match &s.kind {
            StepKind::Goto { waypoint } => (format!("goto {waypoint}"), s.effect),
            StepKind::Action { name, params } => (format!("{name} {}", params["item"]), s.effect),
            StepKind::Wait { duration_ms } => (format!("wait {duration_ms}"), s.effect),
        })
        .collect();
    let (go, act) = (Effect::Repeatable, Effect::AtMostOnce);
    let wanted = [("goto A01", go), ("pick \"SKU-88231\"", act), ("goto B03", go), ("place \"SKU-88231\"", act)];
    assert_eq!(steps, wanted.map(|(text, effect)| (text.to_owned(), effect)));
    assert_eq!(
        (flat_spec.timeout_ms, flat_spec.retry.max_retry_times, flat_spec.retry.interval_ms),
        (300_000, 3, 10_000)
    );
    assert_eq!((flat_spec.priority, flat_spec.kind.as_str()), (2, "transport"));
    assert_eq!(flat_spec.robot_id.as_ref().map(ToString::to_string).as_deref(), Some("rbt-01"));
    assert_eq!(flat_spec.labels.get("created_at").map(String::as_str), Some("2026-06-01T08:00:00Z"));
}

#[test]
fn a_short_form_hears_its_violations_by_its_own_names() {
    let cases = [
        (
            json!({"flat": {"task_type": "No", "from_waypoint": "X", "to_waypoint": "", "max_retry_times": -1}}),
            [
                "flat.from_waypoint",
                "flat.max_retry_times",
                "flat.task_type",
                "flat.timeout_seconds",
                "flat.to_waypoint",
            ],
        ),
        (
            json!({"nested": {"type": "No", "content": {"from_waypoint": "X"}, "retry_strategy": {"max_retry_times": 101}}}),
            [
                "nested.content.from_waypoint",
                "nested.content.to_waypoint",
                "nested.retry_strategy.max_retry_times",
                "nested.timeout_seconds",
                "nested.type",
            ],
        ),
    ];
    for (request, wanted) in cases {
        let submission = Submission::read(from_json(request).expect("json"));
        let refusal = submission.check(&|_| false, &TypeCatalogue::default()).expect_err("invalid");
        let mut fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
        fields.sort_unstable();
        assert_eq!(fields, wanted);
    }
}

#[test]
fn two_different_task_ids_in_one_request_are_refused() {
    let mut body = golden("article_flat");
    body["task_id"] = json!("TASK-A");
    let submission = Submission::read(from_json(json!({"task_id": "TASK-B", "flat": body})).expect("json"));
    let refusal = submission.check(&|_| true, &TypeCatalogue::default()).expect_err("invalid");
    assert_eq!(refusal.violations[0].field, "task_id");
}
