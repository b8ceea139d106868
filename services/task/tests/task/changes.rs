//! Edits, holds and releases: answered by fleet in the task's row, and told again to whoever repeats the request.

use crate::reach::{anna, asked, drive};
use crate::world::{NOON, World, reason, submit, transport};
use midshift_core::identity::Caller;
use midshift_core::rows::Table;
use midshift_core::task::{Phase, TaskIntake, TaskState};
use midshift_proto::access::local;
use midshift_proto::convert::timestamp;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, HoldTaskRequest, ReleaseTaskRequest, TaskUpdate, UpdateTaskRequest};
use midshift_store::{Query, Store, load};
use prost_types::FieldMask;
use tonic::{Code, Status};

/// An update of these fields.
fn update(task_id: &str, paths: &[&str], update: TaskUpdate) -> UpdateTaskRequest {
    UpdateTaskRequest {
        task_id: task_id.into(),
        update_mask: Some(FieldMask { paths: paths.iter().map(ToString::to_string).collect() }),
        update: Some(update),
        reason: "the customer waits".into(),
        ..UpdateTaskRequest::default()
    }
}

fn urgent(task_id: &str) -> UpdateTaskRequest {
    update(task_id, &["priority"], TaskUpdate { priority: Some(1), ..TaskUpdate::default() })
}

fn hold(task_id: &str) -> HoldTaskRequest {
    HoldTaskRequest { task_id: task_id.into(), reason: "the aisle is wet".into(), ..HoldTaskRequest::default() }
}

fn release(task_id: &str) -> ReleaseTaskRequest {
    ReleaseTaskRequest { task_id: task_id.into(), reason: "it is dry".into(), ..ReleaseTaskRequest::default() }
}

async fn call(world: &World, request: UpdateTaskRequest) -> Result<v1::UpdateTaskResponse, Status> {
    Ok(world.service.update_task(local(request)).await?.into_inner())
}

async fn call_while_fleet_works(world: &World, request: UpdateTaskRequest) -> Result<v1::UpdateTaskResponse, Status> {
    let head = world.head();
    tokio::join!(call(world, request), world.fleet_turns_after(head)).0
}

async fn queued(world: &World) -> String {
    submit(&world.service, transport("", "B03")).await.expect("admitted").task_id
}

fn told(refused: Result<v1::UpdateTaskResponse, Status>) -> (Code, String) {
    let refused = refused.expect_err("it is refused");
    (refused.code(), reason(&refused))
}

fn priority_of(task: &v1::Task) -> Option<i32> {
    task.spec.as_ref().and_then(|spec| spec.priority)
}

#[tokio::test(start_paused = true)]
async fn an_edit_is_shown_wherever_the_task_is_and_what_was_submitted_stays_stored() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let mut watch = world.watch(None, "").await;
    watch.bookmark().await;
    let new = TaskUpdate {
        priority: Some(1),
        robot_id: "r7".into(),
        not_before: Some(timestamp(NOON)),
        deadline: Some(timestamp(NOON.plus_ms(60_000))),
    };
    let all = ["priority", "robot_id", "not_before", "deadline"];
    let answer = call_while_fleet_works(&world, update(&task_id, &all, new.clone())).await.expect("changed");
    assert!(!answer.pending);
    assert_eq!(answer.notes.iter().map(|note| note.code.as_str()).collect::<Vec<_>>(), ["PINNED_ROBOT_UNKNOWN"]);
    let listed = world.service.list_tasks(local(v1::ListTasksRequest::default())).await.expect("a page").into_inner();
    let shown = [answer.task.expect("always set"), world.get(&task_id).await, listed.tasks[0].clone()];
    for task in shown.iter().chain([&watch.changed().await]) {
        let spec = task.spec.as_ref().expect("always set");
        let values = (spec.priority, spec.robot_id.as_str(), spec.not_before, spec.deadline);
        assert_eq!(values, (new.priority, "r7", new.not_before, new.deadline));
        assert_eq!(task.edited_fields, all);
    }
    let (intake, _) = load::<TaskIntake>(world.store.as_ref(), &task_id).await.expect("a store").expect("an intake");
    assert_eq!((intake.spec.priority, intake.spec.robot_id, intake.spec.deadline), (5, None, None));
    let gone = update(&task_id, &all, TaskUpdate::default());
    let spec = call_while_fleet_works(&world, gone).await.expect("changed").task.and_then(|task| task.spec);
    let spec = spec.expect("always set");
    assert_eq!((spec.priority, spec.robot_id.as_str(), spec.not_before, spec.deadline), (Some(5), "", None, None));
}

#[tokio::test(start_paused = true)]
async fn what_the_mask_does_not_name_stays() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let both = TaskUpdate { priority: Some(2), robot_id: "r7".into(), ..TaskUpdate::default() };
    let answer = call_while_fleet_works(&world, update(&task_id, &["priority"], both)).await.expect("changed");
    let task = answer.task.expect("always set");
    assert_eq!((priority_of(&task), task.spec.expect("always set").robot_id.as_str()), (Some(2), ""));
    assert_eq!(task.edited_fields, ["priority"]);
}

#[tokio::test(start_paused = true)]
async fn each_broken_rule_of_an_update_is_named_and_an_empty_mask_means_nothing() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let head = world.head();
    let bad = TaskUpdate {
        priority: Some(10),
        robot_id: "Not An Id".into(),
        not_before: Some(timestamp(NOON)),
        deadline: Some(timestamp(NOON)),
    };
    let paths = ["spec.priority", "priority", "robot_id", "*", "not_before", "deadline"];
    let request = UpdateTaskRequest { reason: String::new(), ..update(&task_id, &paths, bad) };
    let refused = call(&world, request).await.expect_err("many rules");
    let fields: Vec<_> = midshift_proto::refusal_of(&refused).violations.into_iter().map(|v| v.field).collect();
    let expected = [
        "reason",
        "update_mask.paths[0]",
        "update.priority",
        "update.robot_id",
        "update_mask.paths[3]",
        "update.deadline",
    ];
    assert_eq!((refused.code(), fields.as_slice()), (Code::InvalidArgument, &expected.map(str::to_owned)[..]));
    for mask in [None, Some(FieldMask::default())] {
        let empty = UpdateTaskRequest { update_mask: mask, ..urgent(&task_id) };
        let refused = midshift_proto::refusal_of(&call(&world, empty).await.expect_err("nothing is named"));
        assert_eq!(refused.violations.len(), 1);
        assert_eq!(refused.violations[0].field, "update_mask");
    }
    let many = update(&task_id, &["priority"; 33], TaskUpdate::default());
    assert_eq!(call(&world, many).await.expect_err("too many").code(), Code::InvalidArgument);
    assert_eq!(world.head(), head, "nothing was stored");
}

#[tokio::test(start_paused = true)]
async fn an_update_of_what_its_caller_did_not_see_is_refused() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let seen = world.get(&task_id).await.etag;
    let over = |etag: &str| UpdateTaskRequest { etag: etag.into(), ..urgent(&task_id) };
    call_while_fleet_works(&world, over(&seen)).await.expect("as it was seen");
    assert_eq!(told(call(&world, over(&seen)).await), (Code::Aborted, "ETAG_MISMATCH".to_owned()));
}

#[tokio::test(start_paused = true)]
async fn an_edit_that_loses_to_an_assignment_is_refused_and_so_is_its_repeat() {
    for etag in [true, false] {
        let world = World::new().await;
        let task_id = queued(&world).await;
        let etag = if etag { world.get(&task_id).await.etag } else { String::new() };
        let expected = if etag.is_empty() { "TASK_NOT_EDITABLE" } else { "ETAG_MISMATCH" };
        let request = UpdateTaskRequest { request_id: "e1".into(), etag, ..urgent(&task_id) };
        let head = world.head();
        let fleet = async {
            world.store_moves_after(head).await;
            world.runs(&task_id, 1).await;
            world.fleet_turns().await;
        };
        let (answer, ()) = tokio::join!(call(&world, request.clone()), fleet);
        assert_eq!(told(answer).1, expected);
        let task = world.get(&task_id).await;
        assert_eq!((task.state(), priority_of(&task)), (v1::TaskState::Running, Some(5)));
        let head = world.head();
        assert_eq!(told(call(&world, request).await).1, expected);
        assert_eq!(world.head(), head, "nothing is written twice");
    }
}

#[tokio::test(start_paused = true)]
async fn an_edit_that_fleet_has_not_looked_at_is_pending_and_its_repeat_hears_what_became_of_it() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let request = UpdateTaskRequest { request_id: "e1".into(), ..urgent(&task_id) };
    let answer = call(&world, request.clone()).await.expect("durable");
    assert_eq!((answer.pending, answer.task.as_ref().and_then(priority_of)), (true, Some(5)));
    world.fleet_turns().await;
    let head = world.head();
    for _ in 0..2 {
        let answer = call(&world, request.clone()).await.expect("the stored answer");
        assert_eq!((answer.pending, answer.task.as_ref().and_then(priority_of)), (false, Some(1)));
    }
    assert_eq!(world.head(), head, "nothing is written twice");
    let other = UpdateTaskRequest { reason: "for another reason".into(), ..request };
    assert_eq!(told(call(&world, other).await), (Code::AlreadyExists, "REQUEST_ID_REUSED".to_owned()));
}

#[tokio::test(start_paused = true)]
async fn an_edit_whose_task_ended_first_is_refused_and_one_that_is_forgotten_is_not_called_done() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let request = UpdateTaskRequest { request_id: "e1".into(), ..urgent(&task_id) };
    assert!(call(&world, request.clone()).await.expect("durable").pending);
    let ended = TaskState { phase: Phase::Failed, ..world.state(&task_id).await.0 };
    world.fleet_writes(&ended, None).await;
    world.fleet_turns().await;
    assert_eq!(told(call(&world, request).await), (Code::FailedPrecondition, "TASK_ENDED".to_owned()));

    let task_id = queued(&world).await;
    let first = UpdateTaskRequest { request_id: "f".into(), ..urgent(&task_id) };
    call_while_fleet_works(&world, first.clone()).await.expect("changed");
    for _ in 0..midshift_core::limits::ANSWERS_OF_TASK {
        call_while_fleet_works(&world, urgent(&task_id)).await.expect("changed");
    }
    assert_eq!(told(call(&world, first).await), (Code::Aborted, "ANSWER_UNKNOWN".to_owned()));
}

#[tokio::test(start_paused = true)]
async fn a_task_that_a_person_holds_says_who_and_why_and_goes_on_when_it_is_released() {
    let world = World::new().await;
    for (at_work, held, free) in
        [(false, v1::TaskState::Queued, v1::TaskState::Queued), (true, v1::TaskState::Held, v1::TaskState::Running)]
    {
        let task_id = queued(&world).await;
        if at_work {
            world.runs(&task_id, 1).await;
        }
        let head = world.head();
        let call = async { world.service.hold_task(local(hold(&task_id))).await.expect("held").into_inner() };
        let (answer, ()) = tokio::join!(call, world.fleet_turns_after(head));
        let task = answer.task.expect("always set");
        assert_eq!(
            (answer.pending, task.state(), task.hold_tokens.as_slice()),
            (false, held, &["operator".into()][..])
        );
        let hold = task.operator_hold.expect("a person holds it");
        assert_eq!((hold.actor.as_str(), hold.reason.as_str()), ("anonymous", "the aisle is wet"));
        assert_eq!(task.reason.expect("a reason").code, "HOLD_BY_PERSON");
        let head = world.head();
        let call = async { world.service.release_task(local(release(&task_id))).await.expect("free").into_inner() };
        let (answer, ()) = tokio::join!(call, world.fleet_turns_after(head));
        let task = answer.task.expect("always set");
        assert_eq!((answer.pending, task.state(), task.hold_tokens.len()), (false, free, 0));
        assert_eq!((task.operator_hold, task.reason), (None, None));
    }
}

#[tokio::test(start_paused = true)]
async fn what_has_ended_is_neither_held_nor_released_and_a_dry_run_asks_for_nothing() {
    let world = World::new().await;
    let task_id = queued(&world).await;
    let head = world.head();
    let dry = UpdateTaskRequest { validate_only: true, request_id: "e1".into(), ..urgent(&task_id) };
    call(&world, dry).await.expect("it could be changed");
    let dry = HoldTaskRequest { validate_only: true, ..hold(&task_id) };
    world.service.hold_task(local(dry)).await.expect("it could be held");
    assert_eq!(world.head(), head);
    let ended = TaskState { phase: Phase::Failed, ..world.state(&task_id).await.0 };
    world.fleet_writes(&ended, None).await;
    let held = world.service.hold_task(local(hold(&task_id))).await.expect_err("it has ended");
    let released = world.service.release_task(local(release(&task_id))).await.expect_err("it has ended");
    assert_eq!([reason(&held), reason(&released)], ["TASK_ENDED", "TASK_ENDED"]);
    assert_eq!(world.store.list(Query::all(Table::TaskRequest)).await.expect("rows").len(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_person_changes_and_holds_tasks_of_its_own_areas_alone() {
    let world = World::new().await;
    for request in [drive("in-hall", "A01", &[]), drive("in-quality", "Q01", &[])] {
        submit(&world.service, request).await.expect("admitted");
    }
    let dispatcher = anna(&["dispatcher@hall", "viewer@quality"]);
    let operator = anna(&["operator@hall", "viewer@quality"]);
    let blind = anna(&["operator@hall"]);
    let code = |result: Result<_, Status>| result.map_or_else(|refused| refused.code(), |()| Code::Ok);
    let change = async |by: &Caller, id: &str| code(world.service.update_task(asked(by, urgent(id))).await.map(drop));
    let stand = async |by: &Caller, id: &str| {
        let held = code(world.service.hold_task(asked(by, hold(id))).await.map(drop));
        let released = code(world.service.release_task(asked(by, release(id))).await.map(drop));
        assert_eq!(held, released);
        held
    };
    assert_eq!(change(&dispatcher, "in-hall").await, Code::Ok);
    assert_eq!(change(&dispatcher, "in-quality").await, Code::PermissionDenied);
    assert_eq!(change(&blind, "in-quality").await, Code::NotFound);
    assert_eq!(stand(&dispatcher, "in-hall").await, Code::PermissionDenied, "who brings work does not stop robots");
    assert_eq!(stand(&operator, "in-hall").await, Code::Ok);
    assert_eq!(stand(&operator, "in-quality").await, Code::PermissionDenied);
    assert_eq!(stand(&blind, "in-quality").await, Code::NotFound);
}
