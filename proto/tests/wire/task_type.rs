//! Task types there and back, and tasks by type and fields.

use midshift_core::reason::Violations;
use midshift_core::rows::{Index, Record, Revision, Row};
use midshift_core::task::types::{TaskType, TaskTypeRow, TypeCatalogue};
use midshift_proto::convert::At;
use midshift_proto::convert::submission::Submission;
use midshift_proto::convert::task_type::{encode_catalogue, encode_task_type, parse_task_type};
use midshift_proto::json::from_json;
use midshift_proto::task::v1;
use serde_json::json;

/// A type as JSON, with a field of each kind.
fn scan() -> serde_json::Value {
    json!({
        "name": "scan", "description": "Reads a shelf.", "timeout": "60s",
        "fields": [
            {"name": "shelf", "description": "Which.", "waypoint": {}},
            {"name": "height", "description": "Of it.", "integer": {"least": "-5", "most": "2000", "unit": "mm"}, "default": 7},
            {"name": "zoom", "description": "Of it.", "number": {"least": 0.5, "most": 4, "unit": "x"}, "default": 1.5},
            {"name": "side", "description": "Of it.", "choice": {"choices": ["left", "right"]}, "default": "left"},
            {"name": "note", "description": "For people.", "text": {"maxBytes": 9}, "default": ""},
            {"name": "pause", "description": "Before.", "integer": {"least": "1", "most": "9", "unit": "s"}},
        ],
        "steps": [
            {"goto": {"field": "shelf"}},
            {"wait": {"field": "pause"}},
            {"action": {"name": "scan", "params": {"h": "height", "z": "zoom", "s": "side", "n": "note"}},
             "effect": "STEP_EFFECT_AT_MOST_ONCE"},
        ],
    })
}

fn parse(wire: v1::TaskType) -> Result<TaskType, Vec<String>> {
    let mut bad = Violations::default();
    let read = parse_task_type(wire, At::top("type"), &|_| true, &mut bad);
    let fields: Vec<String> = bad.0.into_iter().map(|v| v.field).collect();
    assert_eq!(read.is_none(), !fields.is_empty());
    read.ok_or(fields)
}

fn row(of: &TaskType, revision: u64) -> Row {
    let of = TaskTypeRow::Type(of.clone());
    Row { key: of.key(), revision: Revision(revision), index: Index::default(), body: of.body() }
}

#[test]
fn a_type_comes_back_as_it_was_put_over_the_wire_and_through_its_row() {
    let wire: v1::TaskType = from_json(scan()).expect("json");
    let of = parse(wire.clone()).expect("a good type");
    let shown = encode_task_type(&of, Some(Revision(3)));
    assert_eq!(shown, v1::TaskType { etag: "3".into(), ..wire });
    let types = TypeCatalogue::from_rows(&[row(&of, 3)]).expect("a good row");
    let list = encode_catalogue(&types);
    assert_eq!(list.types, [shown]);
    assert!(list.built_in.iter().any(|of| of.name == "transport") && !list.rules.expect("always set").known_only);
}

#[test]
fn a_number_that_json_cannot_say_is_no_default_and_no_bound() {
    let mut wire: v1::TaskType = from_json(scan()).expect("json");
    let nan = prost_types::value::Kind::NumberValue(f64::NAN);
    wire.fields[1].default = Some(prost_types::Value { kind: Some(nan) });
    assert_eq!(parse(wire.clone()), Err(vec!["type.fields[1].default".to_owned()]));
    wire.fields[1].default = Some(prost_types::Value { kind: None });
    assert_eq!(parse(wire.clone()), Err(vec!["type.fields[1].default".to_owned()]));
    wire.fields[1].default = None;
    let Some(v1::task_type_field::Kind::Number(number)) = &mut wire.fields[2].kind else { panic!("a number") };
    number.most = f64::INFINITY;
    assert_eq!(parse(wire), Err(vec!["type.fields[2].number".to_owned()]));
}

#[test]
fn what_steps_of_good_fields_break_together_is_told_of_the_fields() {
    let field = |n: usize| json!({"name": format!("f{n}"), "description": "Text.", "text": {"maxBytes": 1024}});
    let fields: Vec<_> = (0..9).map(field).collect();
    let params: serde_json::Map<_, _> = (0..9).map(|n| (format!("p{n}"), json!(format!("f{n}")))).collect();
    let wire = json!({
        "name": "notes", "description": "Carries notes.", "fields": fields,
        "steps": [{"action": {"name": "note", "params": params}}],
    });
    let of = parse(from_json(wire).expect("json")).expect("a good type");
    let types = TypeCatalogue::from_rows(&[row(&of, 1)]).expect("a good row");
    let long: serde_json::Map<_, _> = (0..9).map(|n| (format!("f{n}"), json!("x".repeat(1_024)))).collect();
    let request = from_json(json!({"typed": {"type": "notes", "fields": long}})).expect("json");
    let refusal = Submission::read(request).check(&|_| true, &types).expect_err("9 KiB in one action");
    let told: Vec<_> = refusal.violations.iter().map(|v| (v.field.as_str(), v.description.as_str())).collect();
    let timeout = "is required: how long one attempt may take, 1 s .. 24 h";
    assert_eq!(told, [("typed.timeout_seconds", timeout), ("typed.fields", "must be at most 8 KiB")]);
}
