//! Task intake over the in-memory store: every violation at once, idempotency, batches, pages, cancels, watches that resume.

use crate::world::{World, count, submit, transport};
use midshift_core::task::bugs::{Bugs, SeededBug};
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::watch_tasks_response::Item;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_request::Body};
use tokio_stream::StreamExt;
use tonic::Code;

#[tokio::test]
async fn every_violation_is_heard_at_once_and_nothing_is_stored() {
    let service = World::new().await.service;
    let flat = v1::FlatTask {
        task_type: "Bad".into(),
        priority: Some(11),
        to_waypoint: "nowhere".into(),
        ..v1::FlatTask::default()
    };
    let request = SubmitTaskRequest { body: Some(Body::Flat(flat)), ..SubmitTaskRequest::default() };
    let status = submit(&service, request).await.expect_err("four rules are broken");
    assert_eq!(status.code(), Code::InvalidArgument);
    let fields: Vec<String> = midshift_proto::refusal_of(&status).violations.into_iter().map(|v| v.field).collect();
    assert_eq!(fields, ["flat.task_type", "flat.priority", "flat.timeout_seconds", "flat.to_waypoint"]);
    assert_eq!(count(&service).await, 0);
}

#[tokio::test]
async fn the_same_request_is_one_task_and_another_body_is_refused() {
    let service = World::new().await.service;
    let first = submit(&service, transport("r1", "B03")).await.expect("admitted");
    let again = submit(&service, transport("r1", "B03")).await.expect("answered again");
    assert_eq!(first.task_id, again.task_id);
    let other = submit(&service, transport("r1", "B01")).await.expect_err("another body");
    assert_eq!(other.code(), Code::AlreadyExists);
    assert_eq!(midshift_proto::refusal_of(&other).reason, "REQUEST_ID_REUSED");
    let chosen = SubmitTaskRequest { task_id: first.task_id.clone(), ..transport("r2", "B01") };
    let taken = submit(&service, chosen).await.expect_err("the id is taken");
    assert_eq!(midshift_proto::refusal_of(&taken).reason, "TASK_ID_TAKEN");
    assert_eq!(count(&service).await, 1);
}

/// Tasks that one request is after it was sent twice.
async fn sent_twice(bugs: Bugs) -> usize {
    let world = World::new().await;
    let service = World::with(world.store, world.site, bugs).await.service;
    for _ in 0..2 {
        submit(&service, transport("r1", "B03")).await.expect("admitted");
    }
    count(&service).await
}

#[tokio::test]
async fn a_request_that_is_sent_again_is_the_same_task_and_without_its_key_it_is_another_one() {
    assert_eq!(sent_twice(Bugs::default()).await, 1);
    assert_eq!(sent_twice(Bugs::seeded(&[SeededBug::ForgetsRequests])).await, 2);
}

#[tokio::test]
async fn a_drawn_id_carries_the_day_and_a_dry_run_stores_nothing() {
    let service = World::new().await.service;
    let dry = SubmitTaskRequest { validate_only: true, ..transport("", "B03") };
    assert!(submit(&service, dry).await.expect("valid").task_id.is_empty());
    assert_eq!(count(&service).await, 0);
    let task = submit(&service, transport("", "B03")).await.expect("admitted");
    assert!(task.task_id.starts_with("TASK-20270115-") && task.task_id.len() == 24, "{}", task.task_id);
}

#[tokio::test]
async fn a_task_that_depends_on_nothing_known_is_refused() {
    let service = World::new().await.service;
    let step =
        v1::Step { kind: Some(v1::step::Kind::Goto(v1::Goto { waypoint: "A01".into() })), ..v1::Step::default() };
    let spec = v1::TaskSpec {
        r#type: "patrol".into(),
        steps: vec![step],
        timeout: Some(prost_types::Duration { seconds: 60, nanos: 0 }),
        depends_on: vec!["TASK-UNKNOWN".into()],
        same_robot_as: "TASK-UNKNOWN-TOO".into(),
        ..v1::TaskSpec::default()
    };
    let request = SubmitTaskRequest { body: Some(Body::Spec(spec)), ..SubmitTaskRequest::default() };
    let status = submit(&service, request).await.expect_err("it depends on nothing");
    let refusal = midshift_proto::refusal_of(&status);
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["spec.depends_on[0]", "spec.same_robot_as"]);
}

#[tokio::test]
async fn pages_are_newest_first_and_a_token_is_bound_to_its_filter() {
    let service = World::new().await.service;
    let (mut admitted, mut numbers) = (Vec::new(), Vec::new());
    for i in 0..5 {
        admitted.push(submit(&service, transport(&format!("r{i}"), "B03")).await.expect("admitted").number);
    }
    let mut page_token = String::new();
    loop {
        let request = v1::ListTasksRequest { filter: None, page_size: 2, page_token };
        let page = service.list_tasks(local(request)).await.expect("a page").into_inner();
        numbers.extend(page.tasks.iter().map(|t| t.number));
        page_token = page.next_page_token;
        if page_token.is_empty() {
            break;
        }
        let filter = Some(v1::TaskFilter { types: vec!["patrol".into()], ..v1::TaskFilter::default() });
        let other = v1::ListTasksRequest { filter, page_size: 2, page_token: page_token.clone() };
        assert_eq!(service.list_tasks(local(other)).await.expect_err("another filter").code(), Code::InvalidArgument);
    }
    admitted.reverse();
    assert_eq!(numbers, admitted);
}

#[tokio::test(start_paused = true)]
async fn a_cancel_is_durable_and_says_so_while_fleet_is_down() {
    let service = World::new().await.service;
    let task = submit(&service, transport("r1", "B03")).await.expect("admitted");
    let request = v1::CancelTaskRequest {
        task_id: task.task_id.clone(),
        reason: "not wanted".into(),
        ..v1::CancelTaskRequest::default()
    };
    let answer = service.cancel_task(local(request.clone())).await.expect("durable").into_inner();
    assert!(answer.pending);
    let stale = v1::CancelTaskRequest { etag: "77".into(), ..request.clone() };
    assert_eq!(service.cancel_task(local(stale)).await.expect_err("an old etag").code(), Code::Aborted);
    let silent = v1::CancelTaskRequest { reason: String::new(), ..request };
    assert_eq!(service.cancel_task(local(silent)).await.expect_err("no reason").code(), Code::InvalidArgument);
}

#[tokio::test(start_paused = true)]
async fn a_watch_shows_what_is_there_and_resumes_behind_its_cursor_without_loss() {
    let service = World::new().await.service;
    let first = submit(&service, transport("r1", "B03")).await.expect("admitted");
    let mut watch = service.watch_tasks(local(v1::WatchTasksRequest::default())).await.expect("a watch").into_inner();
    let existing = watch.next().await.expect("a message").expect("no refusal");
    assert!(matches!(&existing.item, Some(Item::Existing(task)) if task.task_id == first.task_id));
    let bookmark = watch.next().await.expect("a message").expect("no refusal");
    assert!(matches!(bookmark.item, Some(Item::Bookmark(_))));
    drop(watch);
    let second = submit(&service, transport("r2", "B01")).await.expect("admitted");
    let request = v1::WatchTasksRequest { filter: None, cursor: bookmark.cursor.clone() };
    let mut watch = service.watch_tasks(local(request)).await.expect("a watch").into_inner();
    let change = watch.next().await.expect("a message").expect("no refusal");
    assert!(
        matches!(&change.item, Some(Item::Change(c)) if c.task.as_ref().is_some_and(|t| t.task_id == second.task_id))
    );
    let foreign = v1::WatchTasksRequest { filter: None, cursor: "store-2:1".into() };
    let refused = service.watch_tasks(local(foreign)).await.expect_err("another store");
    assert_eq!(midshift_proto::refusal_of(&refused).reason, "CURSOR_OF_OTHER_STORE");
}
