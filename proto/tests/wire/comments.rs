//! The .proto files say what they mean: every field, every enum value, and the same rules as core.

use midshift_core::task::RawTask;
use midshift_core::task::raw::{RawRetry, RawStep, RawStepKind};
use midshift_core::time::Utc;
use midshift_proto::FILE_DESCRIPTOR_SET;
use midshift_proto::json::pool;
use prost::Message;
use prost_types::FileDescriptorSet;
use std::collections::BTreeMap;

fn ours() -> FileDescriptorSet {
    let mut set = FileDescriptorSet::decode(FILE_DESCRIPTOR_SET).expect("descriptors");
    set.file.retain(|f| f.package().starts_with("midshift."));
    set
}

/// Comment by path, for one file.
fn comments(file: &prost_types::FileDescriptorProto) -> BTreeMap<Vec<i32>, String> {
    let locations = file.source_code_info.as_ref().expect("source info").location.iter();
    locations.map(|l| (l.path.clone(), l.leading_comments().trim().to_owned())).collect()
}

#[test]
fn every_message_field_enum_value_and_call_has_a_comment() {
    let mut silent = Vec::new();
    let mut said = 0;
    for file in &ours().file {
        let comments = comments(file);
        let mut look = |path: Vec<i32>, name: String| match comments.get(&path) {
            Some(text) if text.ends_with('.') => said += 1,
            _ => silent.push(name),
        };
        for (m, message) in file.message_type.iter().enumerate() {
            look(vec![4, m as i32], message.name().to_owned());
            for (f, field) in message.field.iter().enumerate() {
                look(vec![4, m as i32, 2, f as i32], format!("{}.{}", message.name(), field.name()));
            }
        }
        for (e, kind) in file.enum_type.iter().enumerate() {
            look(vec![5, e as i32], kind.name().to_owned());
            for (v, value) in kind.value.iter().enumerate() {
                look(vec![5, e as i32, 2, v as i32], value.name().to_owned());
            }
        }
        for (s, service) in file.service.iter().enumerate() {
            for (m, method) in service.method.iter().enumerate() {
                look(vec![6, s as i32, 2, m as i32], method.name().to_owned());
            }
        }
    }
    assert!(silent.is_empty(), "no whole sentence about {silent:?}");
    assert!(said > 500, "only {said} were looked at");
}

#[test]
fn every_file_says_how_to_try_it() {
    for file in &ours().file {
        let path = format!("{}/{}", env!("CARGO_MANIFEST_DIR"), file.name());
        let text = std::fs::read_to_string(&path).expect("the file");
        let header: Vec<_> = text.lines().take_while(|l| l.starts_with("//")).collect();
        let tries =
            |l: &&str| ["-plaintext", "-cacert"].iter().any(|way| l.starts_with(&format!("// Try: grpcurl {way}")));
        assert!(header.iter().any(tries), "{path}");
    }
}

/// The comment of a field, by message and field name.
fn comment(message: &str, field: &str) -> String {
    for file in &ours().file {
        for (m, descriptor) in file.message_type.iter().enumerate() {
            let Some(f) = descriptor.field.iter().position(|f| f.name() == field) else { continue };
            if descriptor.name() == message {
                return comments(file)[&vec![4, m as i32, 2, f as i32]].replace('\n', " ").replace("  ", " ");
            }
        }
    }
    panic!("no field {message}.{field}");
}

/// A task that breaks every rule that core knows of one.
fn broken() -> RawTask {
    let long = "x".repeat(129);
    let goto = |name: &str| RawStep { kind: Some(RawStepKind::Goto(name.into())), ..RawStep::default() };
    let params = serde_json::json!({ "big": "x".repeat(9_000) });
    let big = params.as_object().expect("object").clone();
    let bad_labels: BTreeMap<String, String> = (0..33).map(|i| (format!("k{i}"), String::new())).collect();
    RawTask {
        kind: "No".into(),
        priority: Some(10),
        robot_id: "No".into(),
        selector_labels: bad_labels.clone(),
        capabilities: vec!["No".into(); 33],
        minimum_software: "new".into(),
        steps: vec![
            RawStep::default(),
            RawStep { effect: Some(None), continue_on_fail: Some(None), timeout_ms: Some(0), ..goto("no way") },
            RawStep { kind: Some(RawStepKind::Action("No".into(), big)), ..RawStep::default() },
            RawStep { kind: Some(RawStepKind::Wait(0)), ..RawStep::default() },
        ],
        timeout_ms: Some(0),
        schedule_to_start_ms: Some(0),
        stall_ms: Some(0),
        not_before: Some(Utc(1)),
        deadline: Some(Utc(1)),
        retry: Some(RawRetry {
            max_retry_times: -1,
            interval_ms: Some(-1),
            factor: Some(0.0),
            max_interval_ms: Some(-1),
            jitter: Some(2.0),
            ..RawRetry::default()
        }),
        depends_on: vec!["TASK-1".into(); 33],
        same_robot_as: "TASK-1".into(),
        coalesce_key: long.clone(),
        speed_limit_mm_s: Some(1),
        labels: bad_labels,
        requester: long.clone(),
        external_ref: long.clone(),
        trace_context: long,
        ..RawTask::default()
    }
}

/// Message and field that a violation's path ends in.
fn owner(path: &str) -> (&'static str, String) {
    let plain: String =
        path.split('.').map(|part| part.split('[').next().unwrap_or(part)).collect::<Vec<_>>().join(".");
    let last = plain.rsplit('.').next().unwrap_or_default().to_owned();
    let message = match plain.as_str() {
        p if p.starts_with("spec.selector.") => "RobotSelector",
        p if p.starts_with("spec.retry.") => "RetryPolicy",
        p if p.ends_with(".goto.waypoint") => "Goto",
        p if p.contains(".action.") => "Action",
        p if p.contains(".wait.") => "Wait",
        p if p.starts_with("spec.steps.") => "Step",
        _ => "TaskSpec",
    };
    (message, last)
}

#[test]
fn every_rule_that_core_checks_stands_in_the_comment_of_its_field() {
    let broken =
        [broken(), RawTask::default()].map(|raw| raw.check("spec", &|_| false).expect_err("invalid").violations);
    let mut checked = 0;
    for violation in broken.iter().flatten() {
        let (message, field) = owner(&violation.field);
        // A step without a kind and a list that is too short are said by the message and by the list.
        if field == "steps" && violation.field.ends_with(']') {
            continue;
        }
        let said = comment(message, &field);
        let rule = violation.description.rsplit("must be ").next().unwrap_or_default();
        let same = said.contains(rule)
            || (rule == "stands there twice" && said.contains("each once"))
            || (rule.starts_with("is required:") && said.contains("Required: none is refused"));
        assert!(
            same,
            "{}: core says {:?}, the comment of {message}.{field} says {said:?}",
            violation.field, violation.description
        );
        checked += 1;
    }
    assert!(checked >= 25, "only {checked} rules were looked at");
}

#[test]
fn every_service_is_in_the_descriptor_set() {
    let mut services: Vec<_> = pool().services().map(|s| s.full_name().to_owned()).collect();
    services.sort();
    let wanted = [
        "fleet.v1.FleetService",
        "identity.v1.AuditService",
        "identity.v1.EnrolmentService",
        "identity.v1.IdentityService",
        "link.v1.LinkService",
        "link.v1.ReplayService",
        "ota.v1.BundleService",
        "ota.v1.ChunkService",
        "ota.v1.RolloutService",
        "sim.v1.SimService",
        "stop.v1.StopLinkService",
        "stop.v1.StopService",
        "task.v1.TaskService",
        "telemetry.v1.TelemetryService",
    ];
    assert_eq!(services, wanted.map(|s| format!("midshift.{s}")));
}

#[test]
fn calls_that_clients_try_again_exist_and_none_streams() {
    let text = include_str!("../../service_config.json");
    let config: serde_json::Value = serde_json::from_str(text).expect("JSON");
    let names = config["methodConfig"][0]["name"].as_array().expect("names");
    assert!(names.len() > 20, "only {}", names.len());
    for name in names {
        let (service, method) = (name["service"].as_str().expect("a service"), name["method"].as_str());
        let service = pool().get_service_by_name(service).unwrap_or_else(|| panic!("no {service}"));
        let found = service.methods().find(|m| Some(m.name()) == method);
        let found = found.unwrap_or_else(|| panic!("{} has no {method:?}", service.full_name()));
        assert!(!found.is_client_streaming() && !found.is_server_streaming(), "{} streams", found.full_name());
    }
}
