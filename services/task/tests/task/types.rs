//! Task types of a site: put, listed, deleted; tasks that are made of them, and types that a task may not name.

use crate::reach::{anna, asked};
use crate::world::{World, count, reason, submit, transport};
use midshift_core::rows::Table;
use midshift_core::task::TaskIntake;
use midshift_proto::access::local;
use midshift_proto::json::from_json;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_request::Body, submit_task_result::Outcome};
use midshift_store::{Query, Store, load};
use midshift_task::TaskService;
use serde_json::{Value, json};
use tonic::{Code, Status};

/// Drives to a shelf and reads it.
fn shelf_scan() -> v1::TaskType {
    let of = json!({
        "name": "shelf-scan", "description": "Reads the labels of a shelf.", "timeout": "300s",
        "fields": [
            {"name": "shelf", "description": "Which shelf.", "waypoint": {}},
            {"name": "height_mm", "description": "Of the reader.", "integer": {"most": 2000, "unit": "mm"}, "default": 1200},
            {"name": "settle_s", "description": "Before it reads.", "integer": {"least": 1, "most": 60, "unit": "s"}, "default": 2},
        ],
        "steps": [
            {"goto": {"field": "shelf"}},
            {"wait": {"field": "settle_s"}},
            {"action": {"name": "scan", "params": {"height_mm": "height_mm"}}, "effect": "STEP_EFFECT_REPEATABLE"},
        ],
    });
    from_json(of).expect("a type")
}

async fn put(service: &TaskService, of: v1::TaskType) -> Result<v1::TaskType, Status> {
    let request = v1::PutTaskTypeRequest { r#type: Some(of), validate_only: false };
    Ok(service.put_task_type(local(request)).await?.into_inner().r#type.expect("always set"))
}

async fn delete(service: &TaskService, name: &str, etag: &str) -> Result<(), Status> {
    let request = v1::DeleteTaskTypeRequest { name: name.into(), etag: etag.into(), validate_only: false };
    service.delete_task_type(local(request)).await.map(drop)
}

async fn accept_known_only(service: &TaskService, known_only: bool) {
    let rules = Some(v1::TaskTypeRules { known_only, ..v1::TaskTypeRules::default() });
    let request = v1::PutTaskTypeRulesRequest { rules, validate_only: false };
    service.put_task_type_rules(local(request)).await.expect("rules");
}

async fn list(service: &TaskService) -> v1::ListTaskTypesResponse {
    service.list_task_types(local(v1::ListTaskTypesRequest {})).await.expect("a list").into_inner()
}

fn typed(request_id: &str, fields: Value) -> SubmitTaskRequest {
    let typed = json!({"request_id": request_id, "typed": {"type": "shelf-scan", "fields": fields, "priority": 3}});
    from_json(typed).expect("a request")
}

fn labelled(name: &str) -> SubmitTaskRequest {
    let mut request = transport("", "B03");
    let Some(Body::Flat(flat)) = &mut request.body else { panic!("a flat task") };
    flat.task_type = name.into();
    request
}

fn told(status: &Status) -> Vec<(String, String)> {
    midshift_proto::refusal_of(status).violations.into_iter().map(|v| (v.field, v.description)).collect()
}

#[tokio::test]
async fn a_task_is_made_of_its_type_once_and_stays_as_it_was_made() {
    let World { service, store, .. } = World::new().await;
    let first = put(&service, shelf_scan()).await.expect("registered");
    let dry = SubmitTaskRequest { validate_only: true, ..typed("", json!({"shelf": "A01"})) };
    assert_eq!(submit(&service, dry).await.expect("valid").type_etag, first.etag);
    let task = submit(&service, typed("r1", json!({"shelf": "A01", "height_mm": "900"}))).await.expect("admitted");
    let spec = task.spec.as_ref().expect("always set");
    assert_eq!((spec.r#type.as_str(), spec.priority, &task.type_etag), ("shelf-scan", Some(3), &first.etag));
    let steps = json!(spec.steps.iter().map(|s| midshift_proto::json::to_json(s).expect("json")).collect::<Vec<_>>());
    assert_eq!(steps[0]["goto"], json!({"waypoint": "A01"}));
    assert_eq!(steps[1]["wait"], json!({"duration": "2s"}));
    assert_eq!(steps[2]["action"], json!({"name": "scan", "params": {"height_mm": 900.0}}));
    assert_eq!(steps[2]["effect"], "STEP_EFFECT_REPEATABLE");
    let mut other = shelf_scan();
    other.steps.truncate(1);
    other.fields.truncate(1);
    let second = put(&service, other).await.expect("replaced");
    assert_ne!(second.etag, first.etag);
    delete(&service, "shelf-scan", &second.etag).await.expect("deleted");
    let again = submit(&service, typed("r1", json!({"shelf": "A01", "height_mm": "900"}))).await.expect("the same");
    assert_eq!(again, task, "its steps are those of its admission, and a repeat is answered without its type");
    let (intake, _) = load::<TaskIntake>(store.as_ref(), &task.task_id).await.expect("a store").expect("an intake");
    assert_eq!(intake.type_revision.map(|revision| revision.0.to_string()), Some(first.etag));
    assert_eq!(submit(&service, transport("r2", "B03")).await.expect("admitted").type_etag, "");
}

#[tokio::test]
async fn every_field_that_breaks_its_rule_is_told_at_once_beside_the_rest() {
    let service = World::new().await.service;
    put(&service, shelf_scan()).await.expect("registered");
    let fields = json!({"shelf": "A99", "hieght_mm": 5, "height_mm": 2001, "settle_s": "soon"});
    let mut request = typed("r1", fields);
    let Some(Body::Typed(typed)) = &mut request.body else { panic!("a typed task") };
    (typed.priority, typed.timeout_seconds) = (Some(10), Some(0));
    let status = submit(&service, request).await.expect_err("six rules are broken");
    let wanted = [
        ("fields.hieght_mm", "shelf-scan has no such field; did you mean height_mm?"),
        ("fields.shelf", "the site has no waypoint A99"),
        ("fields.height_mm", "must be a whole number, 0..2000 mm"),
        ("fields.settle_s", "must be a whole number, 1..60 s"),
        ("priority", "must be 0..9, 0 most urgent"),
        ("timeout_seconds", "must be 1 s .. 24 h"),
    ];
    assert_eq!(told(&status), wanted.map(|(field, text)| (format!("typed.{field}"), text.to_owned())));
    assert_eq!(count(&service).await, 0);
}

#[tokio::test]
async fn a_slip_of_a_known_type_is_refused_with_what_was_meant_until_a_site_calls_a_type_so() {
    let service = World::new().await.service;
    let status = submit(&service, labelled("transpot")).await.expect_err("a slip");
    let text = "\"transpot\" is no known type; did you mean transport?".to_owned();
    assert_eq!(told(&status), [("flat.task_type".to_owned(), text)]);
    submit(&service, labelled("replenish")).await.expect("a label of its own, as ever");
    put(&service, v1::TaskType { name: "transpot".into(), ..shelf_scan() }).await.expect("registered");
    submit(&service, labelled("transpot")).await.expect("it is known now");
    let status = submit(&service, labelled("shelf-scan")).await.map(|task| task.task_id);
    assert!(status.is_ok(), "near to nothing: {status:?}");
}

#[tokio::test]
async fn a_site_that_takes_known_types_alone_refuses_every_other_and_of_a_batch_only_that() {
    let world = World::new().await;
    let service = world.service.clone();
    put(&service, shelf_scan()).await.expect("registered");
    accept_known_only(&service, true).await;
    assert!(list(&service).await.rules.expect("always set").known_only);
    let requests = [labelled("replenish"), labelled("transport"), typed("", json!({"shelf": "A01"}))];
    let item = |(n, request)| SubmitTaskRequest { request_id: format!("r{n}"), ..request };
    let items = requests.into_iter().enumerate().map(item);
    let items = items.map(|item| v1::SubmitTasksRequest { item: Some(item) });
    let stream = local(tokio_stream::iter(items));
    let results = world.client().submit_tasks(stream).await.expect("a batch").into_inner().results;
    let taken: Vec<bool> = results.iter().map(|r| matches!(r.outcome, Some(Outcome::TaskId(_)))).collect();
    assert_eq!(taken, [false, true, true]);
    accept_known_only(&service, false).await;
    submit(&service, labelled("replenish")).await.expect("taken again");
}

#[tokio::test]
async fn a_type_changes_over_the_etag_that_was_seen_and_a_deleted_name_never_repeats_one() {
    let World { service, store, .. } = World::new().await;
    let first = put(&service, shelf_scan()).await.expect("registered");
    assert_eq!(put(&service, shelf_scan()).await.expect("the same").etag, first.etag, "nothing changed");
    assert_eq!(list(&service).await.types, std::slice::from_ref(&first));
    let changed = v1::TaskType { description: "Reads it.".into(), ..first.clone() };
    let second = put(&service, changed).await.expect("changed");
    let stale = v1::TaskType { description: "Looks at it.".into(), ..first.clone() };
    assert_eq!(reason(&put(&service, stale).await.expect_err("an old etag")), "ETAG_MISMATCH");
    assert_eq!(reason(&delete(&service, "shelf-scan", &first.etag).await.expect_err("too")), "ETAG_MISMATCH");
    delete(&service, "shelf-scan", &second.etag).await.expect("deleted");
    delete(&service, "shelf-scan", "").await.expect("it is so already");
    assert!(list(&service).await.types.is_empty());
    let unknown = submit(&service, typed("r1", json!({}))).await.expect_err("no type");
    let none = "the site has no type registered; `midshift task type put FILE` registers one";
    assert_eq!(told(&unknown), [("typed.type".to_owned(), none.to_owned())], "and nothing of what it would have said");
    let again = put(&service, shelf_scan()).await.expect("registered anew");
    let number = |etag: &str| etag.parse::<u64>().expect("a number");
    assert!(number(&again.etag) > number(&second.etag), "revisions of a name go on");
    let missing = delete(&service, "shelf-scna", "").await.expect_err("never there");
    assert_eq!((missing.code(), reason(&missing).as_str()), (Code::NotFound, "TASK_TYPE_NOT_FOUND"));
    let audit = store.list(Query::all(Table::TaskAudit)).await.expect("rows");
    let actions: Vec<String> = audit
        .iter()
        .map(|row| serde_json::from_str::<Value>(&row.body).expect("json"))
        .map(|row| format!("{} {}", row["action"].as_str().expect("text"), row["outcome"].as_str().expect("text")))
        .collect();
    let wanted = ["put DONE", "put DONE", "put ETAG_MISMATCH", "delete ETAG_MISMATCH", "delete DONE", "put DONE"];
    assert_eq!(actions, wanted.map(|action| format!("task_type.{action}")));
}

#[tokio::test]
async fn types_are_changed_by_those_who_operate_the_site_and_seen_by_all() {
    let service = World::new().await.service;
    let (site, area) = (anna(&["operator"]), anna(&["operator@hall", "dispatcher"]));
    let request = || v1::PutTaskTypeRequest { r#type: Some(shelf_scan()), validate_only: false };
    let denied = service.put_task_type(asked(&area, request())).await.expect_err("one area is not enough");
    assert_eq!(reason(&denied), "NOT_PERMITTED");
    service.put_task_type(asked(&site, request())).await.expect("permitted");
    let seen = service.list_task_types(asked(&area, v1::ListTaskTypesRequest {})).await.expect("a list");
    assert_eq!(seen.into_inner().types.len(), 1);
}

#[tokio::test]
async fn a_type_that_breaks_rules_hears_them_all_and_a_check_stores_nothing() {
    let service = World::new().await.service;
    let dry = v1::PutTaskTypeRequest { r#type: Some(shelf_scan()), validate_only: true };
    service.put_task_type(local(dry)).await.expect("valid");
    assert!(list(&service).await.types.is_empty());
    let mut broken = shelf_scan();
    broken.name = "Shelf".into();
    let over = prost_types::value::Kind::NumberValue(2_001.0);
    broken.fields[1].default = Some(prost_types::Value { kind: Some(over) });
    broken.steps.remove(1);
    let status = put(&service, broken).await.expect_err("three rules are broken");
    let fields: Vec<String> = told(&status).into_iter().map(|(field, _)| field).collect();
    assert_eq!(fields, ["type.name", "type.fields[1].default", "type.fields[2]"]);
    let mut kindless = shelf_scan();
    (kindless.fields[0].kind, kindless.steps[0].kind) = (None, None);
    kindless.steps[2].effect = Some(0);
    let status = put(&service, kindless).await.expect_err("three more");
    let fields: Vec<String> = told(&status).into_iter().map(|(field, _)| field).collect();
    assert_eq!(fields, ["type.fields[0]", "type.steps[0]", "type.steps[2].effect"]);
}
