//! Cancel, resolve, resume: durable, obeyed by fleet, safe to repeat.

use crate::world::{World, reason, submit, transport};
use midshift_core::fleet::rows::HoldToken;
use midshift_core::rows::Record;
use midshift_core::task::{Phase, TaskRequest};
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, CancelTaskRequest, Resolution, ResolveTaskRequest, ResumeHeldRequest};
use midshift_store::{Query, Store};
use tonic::{Code, Status};

fn cancel(task_id: &str) -> CancelTaskRequest {
    CancelTaskRequest { task_id: task_id.into(), reason: "not wanted".into(), ..CancelTaskRequest::default() }
}

async fn call(world: &World, request: CancelTaskRequest) -> Result<v1::CancelTaskResponse, Status> {
    Ok(world.service.cancel_task(local(request)).await?.into_inner())
}

async fn call_while_fleet_works(world: &World, request: CancelTaskRequest) -> v1::CancelTaskResponse {
    let head = world.head();
    tokio::join!(call(world, request), world.fleet_turns_after(head)).0.expect("durable")
}

/// A task that waits for a person, and the etag that the person saw.
async fn stuck(world: &World) -> (String, String) {
    let task_id = submit(&world.service, transport("", "B03")).await.expect("admitted").task_id;
    let (mut task, _) = world.state(&task_id).await;
    task.phase = Phase::NeedsOperator;
    world.fleet_writes(&task, None).await;
    let etag = world.get(&task_id).await.etag;
    (task_id, etag)
}

fn resolve(task_id: &str, etag: &str) -> ResolveTaskRequest {
    ResolveTaskRequest {
        task_id: task_id.into(),
        request_id: "fix-1".into(),
        etag: etag.into(),
        resolution: Resolution::Succeeded.into(),
        reason: "carried by hand".into(),
        validate_only: false,
    }
}

#[tokio::test(start_paused = true)]
async fn a_queued_task_is_canceled_when_its_cancel_answers() {
    let world = World::new().await;
    let task = submit(&world.service, transport("r1", "B03")).await.expect("admitted");
    let answer = call_while_fleet_works(&world, cancel(&task.task_id)).await;
    let canceled = answer.task.expect("always set");
    assert_eq!((canceled.state(), answer.pending), (v1::TaskState::Canceled, false));
    let again = call(&world, cancel(&task.task_id)).await.expect("canceled already");
    assert_eq!((again.task.expect("always set").etag, again.pending), (canceled.etag, false));
}

#[tokio::test(start_paused = true)]
async fn a_task_at_work_answers_stopping_and_so_does_a_second_cancel_that_fleet_has_looked_at() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    world.runs(&task_id, 1).await;
    for _ in 0..2 {
        let answer = call_while_fleet_works(&world, cancel(&task_id)).await;
        assert_eq!((answer.task.expect("always set").state(), answer.pending), (v1::TaskState::Stopping, false));
    }
}

#[tokio::test(start_paused = true)]
async fn a_cancel_that_fleet_has_not_looked_at_stays_pending_whatever_else_changes() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    assert!(call(&world, cancel(&task_id)).await.expect("durable").pending);
    // An older wish stands on the row, and the row moves: neither is an answer to this request.
    let (mut task, _) = world.state(&task_id).await;
    task.cancel_requested = Some(crate::world::NOON);
    let head = world.head();
    let writes = async {
        world.store_moves_after(head).await;
        world.fleet_writes(&task, None).await;
    };
    let (answer, ()) = tokio::join!(call(&world, cancel(&task_id)), writes);
    assert!(answer.expect("durable").pending);
}

#[tokio::test(start_paused = true)]
async fn a_cancel_sent_again_is_the_same_cancel_although_its_etag_is_old_by_then() {
    let world = World::new().await;
    let task = submit(&world.service, transport("r1", "B03")).await.expect("admitted");
    world.runs(&task.task_id, 1).await;
    let etag = world.get(&task.task_id).await.etag;
    let request = CancelTaskRequest { request_id: "c1".into(), etag, ..cancel(&task.task_id) };
    assert!(call(&world, request.clone()).await.expect("durable").pending);
    world.fleet_turns().await;
    let head = world.head();
    let again = call(&world, request.clone()).await.expect("the stored answer");
    assert_eq!((again.task.expect("always set").state(), again.pending), (v1::TaskState::Stopping, false));
    assert_eq!(world.head(), head, "nothing is written twice");
    let other = CancelTaskRequest { force: true, ..request.clone() };
    let refused = call(&world, other).await.expect_err("another body");
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::AlreadyExists, "REQUEST_ID_REUSED"));
    let (mut ended, _) = world.state(&task.task_id).await;
    ended.phase = Phase::Succeeded;
    world.fleet_writes(&ended, None).await;
    let late = call(&world, request).await.expect("a completion won, the repeat is still the same call");
    assert_eq!(late.task.expect("always set").state(), v1::TaskState::Succeeded);
}

#[tokio::test(start_paused = true)]
async fn a_request_id_of_a_submit_is_not_taken_for_a_cancel() {
    let world = World::new().await;
    let task = submit(&world.service, transport("r1", "B03")).await.expect("admitted");
    let request = CancelTaskRequest { request_id: "r1".into(), ..cancel(&task.task_id) };
    assert_eq!(reason(&call(&world, request).await.expect_err("used by the submit")), "REQUEST_ID_REUSED");
}

#[tokio::test(start_paused = true)]
async fn what_has_ended_is_not_canceled_and_what_is_unknown_is_not_found() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    let (mut task, _) = world.state(&task_id).await;
    task.phase = Phase::Failed;
    world.fleet_writes(&task, None).await;
    let ended = call(&world, cancel(&task_id)).await.expect_err("it has ended");
    assert_eq!((ended.code(), reason(&ended).as_str()), (Code::FailedPrecondition, "TASK_ENDED"));
    let unknown = call(&world, cancel("TASK-X")).await.expect_err("no such task");
    assert_eq!((unknown.code(), reason(&unknown).as_str()), (Code::NotFound, "TASK_NOT_FOUND"));
    let long = CancelTaskRequest { reason: "x".repeat(257), ..cancel(&task_id) };
    assert_eq!(call(&world, long).await.expect_err("too long").code(), Code::InvalidArgument);
}

#[tokio::test(start_paused = true)]
async fn a_person_answers_what_the_person_saw_and_only_what_is_allowed() {
    let world = World::new().await;
    let (task_id, etag) = stuck(&world).await;
    let call = async |request| world.service.resolve_task(local(request)).await.map(|a| a.into_inner());
    let blind = call(resolve(&task_id, "")).await.expect_err("no etag");
    assert_eq!(blind.code(), Code::InvalidArgument);
    let late = call(resolve(&task_id, "1")).await.expect_err("an old etag");
    assert_eq!((late.code(), reason(&late).as_str()), (Code::Aborted, "ETAG_MISMATCH"));
    let lost = ResolveTaskRequest { resolution: Resolution::FailedItemLost.into(), ..resolve(&task_id, &etag) };
    let refused = call(lost).await.expect_err("it carries nothing");
    assert_eq!((refused.code(), reason(&refused).as_str()), (Code::FailedPrecondition, "RESOLUTION_NOT_ALLOWED"));
    let head = world.head();
    let (answer, ()) = tokio::join!(call(resolve(&task_id, &etag)), world.fleet_turns_after(head));
    let answer = answer.expect("durable");
    assert_eq!((answer.task.expect("always set").state(), answer.pending), (v1::TaskState::Succeeded, false));
    let again = call(resolve(&task_id, &etag)).await.expect("the stored answer");
    assert_eq!((again.task.expect("always set").state(), again.pending), (v1::TaskState::Succeeded, false));
}

#[tokio::test(start_paused = true)]
async fn a_resume_says_why_and_whom_and_whether_fleet_has_looked_at_it() {
    let world = World::new().await;
    let call = async |request| world.service.resume_held(local(request)).await.map(|a| a.into_inner());
    let refused = call(ResumeHeldRequest::default()).await.expect_err("no reason and nobody named");
    let fields: Vec<_> = midshift_proto::refusal_of(&refused).violations.into_iter().map(|v| v.field).collect();
    assert_eq!(fields, ["reason", "stop_id"]);
    world.copies_stop("s1", true).await;
    let request = ResumeHeldRequest {
        stop_id: "s1".into(),
        request_id: "go-1".into(),
        reason: "looked at".into(),
        ..ResumeHeldRequest::default()
    };
    assert!(call(request.clone()).await.expect("durable").pending, "fleet is down");
    world.fleet_turns().await;
    assert!(!call(request.clone()).await.expect("the same request").pending);
    let other = ResumeHeldRequest { stop_id: "s2".into(), ..request };
    assert_eq!(reason(&call(other).await.expect_err("another body")), "REQUEST_ID_REUSED");
}

fn resume(stop_id: &str) -> ResumeHeldRequest {
    ResumeHeldRequest { stop_id: stop_id.into(), reason: "clear".into(), ..ResumeHeldRequest::default() }
}

#[tokio::test(start_paused = true)]
async fn a_resume_before_the_reset_is_refused_and_is_not_kept_for_later() {
    let world = World::new().await;
    let call = async |request| world.service.resume_held(local(request)).await.map(|a| a.into_inner());
    let unknown = call(resume("STOP-9")).await.expect_err("nobody knows of it");
    assert_eq!((unknown.code(), reason(&unknown).as_str()), (Code::NotFound, "STOP_NOT_FOUND"));
    let beside = ResumeHeldRequest { task_ids: vec!["T1".into()], ..resume("STOP-9") };
    let unknown = call(beside).await.expect_err("nor beside a task");
    assert_eq!((unknown.code(), reason(&unknown).as_str()), (Code::NotFound, "STOP_NOT_FOUND"));
    world.copies_stop("STOP-1", false).await;
    world.fleet_holds(None, "stop:STOP-1").await;
    for validate_only in [false, true] {
        let early = call(ResumeHeldRequest { validate_only, ..resume("STOP-1") }).await.expect_err("it is engaged");
        assert_eq!((early.code(), reason(&early).as_str()), (Code::FailedPrecondition, "STOP_ENGAGED"));
    }
    let asked = world.store.list(Query::all(TaskRequest::TABLE)).await.expect("a store that answers");
    assert!(asked.is_empty(), "nothing is kept for later");
}

#[tokio::test(start_paused = true)]
async fn a_resume_of_a_robot_that_nobody_knows_is_refused_and_is_not_kept_for_later() {
    let world = World::new().await;
    world.enrols(&["r1"]).await;
    let request = |ids: &[&str]| ResumeHeldRequest {
        robot_ids: ids.iter().map(|id| (*id).to_owned()).collect(),
        reason: "clear".into(),
        ..ResumeHeldRequest::default()
    };
    for (ids, validate_only) in [(["r1", "r9"], false), (["r9", "r1"], true)] {
        let refused = world.service.resume_held(local(ResumeHeldRequest { validate_only, ..request(&ids) })).await;
        let refused = refused.expect_err("nobody knows r9");
        assert_eq!((refused.code(), reason(&refused).as_str()), (Code::NotFound, "ROBOT_NOT_FOUND"));
    }
    let asked = world.store.list(Query::all(TaskRequest::TABLE)).await.expect("a store that answers");
    assert!(asked.is_empty(), "nothing is kept for later");
    world.service.resume_held(local(request(&["r1"]))).await.expect("it has never connected and is enrolled");
}

#[tokio::test(start_paused = true)]
async fn a_resume_right_after_the_reset_waits_until_fleet_has_seen_it() {
    let world = World::new().await;
    world.copies_stop("STOP-1", true).await;
    world.fleet_holds(None, "stop:STOP-1").await;
    let fleet_sees = async {
        world.fleet_holds(Some("stop:STOP-1"), "resume:STOP-1").await;
        let head = world.head();
        world.fleet_turns_after(head).await;
    };
    let (answer, ()) = tokio::join!(world.service.resume_held(local(resume("STOP-1"))), fleet_sees);
    let answer = answer.expect("durable").into_inner();
    assert_eq!((answer.robots, answer.pending, answer.still_stopped.len()), (Some(1), false, 0));
    let left = world.store.list(Query::all(HoldToken::TABLE)).await.expect("a store that answers");
    assert!(left.is_empty(), "the robot may go on");
}

#[tokio::test(start_paused = true)]
async fn a_resume_names_the_robots_that_it_does_not_let_go() {
    let world = World::new().await;
    world.copies_stop("STOP-1", true).await;
    world.fleet_holds(None, "stop:STOP-1").await;
    let answer = world.service.resume_held(local(resume("STOP-1"))).await.expect("durable").into_inner();
    assert_eq!((answer.robots, answer.still_stopped), (Some(0), vec!["r1".to_owned()]));
    world.enrols(&["r2"]).await;
    let others = ResumeHeldRequest { robot_ids: vec!["r2".into()], ..resume("STOP-1") };
    let answer = world.service.resume_held(local(others)).await.expect("durable").into_inner();
    assert_eq!((answer.robots, answer.still_stopped.len()), (Some(0), 0), "of those that it names");
}

#[tokio::test(start_paused = true)]
async fn a_dry_run_asks_for_nothing() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    let head = world.head();
    let dry = CancelTaskRequest { validate_only: true, request_id: "c1".into(), ..cancel(&task_id) };
    call(&world, dry).await.expect("it could be canceled");
    assert_eq!(world.head(), head);
}
