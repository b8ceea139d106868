//! Cancel and resolve for every task that a filter means, and what a caller is told of a task that was admitted all the same.

use crate::reach::{anna, asked, drive};
use crate::world::{NOON, World, submit, transport};
use midshift_core::identity::RobotIdentity;
use midshift_core::ids::RobotId;
use midshift_core::item::Item;
use midshift_core::rows::Writer;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, TaskState, submit_task_request::Body};
use midshift_store::Store;

fn cancel(states: &[TaskState], validate_only: bool) -> v1::CancelTasksRequest {
    let all = states.is_empty();
    let states = states.iter().map(|state| *state as i32).collect();
    let filter = Some(v1::TaskFilter { states, ..v1::TaskFilter::default() });
    let (request_id, reason) = ("all-1".to_owned(), "shift is over".to_owned());
    v1::CancelTasksRequest { filter, request_id, reason, validate_only, all, ..Default::default() }
}

async fn outcome(world: &World, request: v1::CancelTasksRequest) -> v1::BulkOutcome {
    let answer = world.service.cancel_tasks(local(request)).await.expect("durable").into_inner();
    answer.outcome.expect("always set")
}

#[tokio::test(start_paused = true)]
async fn a_cancel_of_many_asks_for_each_task_that_is_meant_and_a_check_only_counts() {
    let world = World::new().await;
    let mut ids = Vec::new();
    for n in 0..4 {
        ids.push(submit(&world.service, transport(&format!("r{n}"), "B03")).await.expect("admitted").task_id);
    }
    world.runs(&ids[3], 1).await;
    let head = world.head();
    let checked = outcome(&world, cancel(&[TaskState::Queued], true)).await;
    assert_eq!((checked.matched, checked.asked, world.head()), (3, 3, head), "nothing is written");
    let (done, ()) = tokio::join!(outcome(&world, cancel(&[TaskState::Queued], false)), async {
        world.fleet_turns_after(head).await;
    });
    assert_eq!((done.matched, done.asked, done.pending), (3, 3, false));
    for (id, phase) in ids.iter().zip([Phase::Canceled, Phase::Canceled, Phase::Canceled, Phase::Running]) {
        assert_eq!(world.state(id).await.0.phase, phase);
    }
    assert_eq!(outcome(&world, cancel(&[TaskState::Queued], false)).await.matched, 0, "those have ended");
}

#[tokio::test(start_paused = true)]
async fn a_resolve_of_many_answers_only_those_that_wait_for_a_person() {
    let world = World::new().await;
    let stuck = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    let queued = submit(&world.service, transport("r2", "B03")).await.expect("admitted").task_id;
    let (mut task, _) = world.state(&stuck).await;
    task.phase = Phase::NeedsOperator;
    world.fleet_writes(&task, None).await;
    let request = v1::ResolveTasksRequest {
        resolution: v1::Resolution::Requeue.into(),
        reason: "looked at".into(),
        all: true,
        ..v1::ResolveTasksRequest::default()
    };
    let head = world.head();
    let (answer, ()) = tokio::join!(world.service.resolve_tasks(local(request)), async {
        world.fleet_turns_after(head).await;
    });
    let done = answer.expect("durable").into_inner().outcome.expect("always set");
    assert_eq!((done.matched, done.asked, done.refused.len()), (1, 1, 0));
    for id in [&stuck, &queued] {
        assert_eq!(world.state(id).await.0.phase, Phase::Queued);
    }
}

#[tokio::test(start_paused = true)]
async fn a_filter_that_says_nothing_does_not_mean_every_task() {
    let world = World::new().await;
    submit(&world.service, transport("r1", "B03")).await.expect("admitted");
    let head = world.head();
    for filter in [None, Some(v1::TaskFilter::default())] {
        let request = v1::CancelTasksRequest { filter: filter.clone(), all: false, ..cancel(&[], false) };
        let refused = world.service.cancel_tasks(local(request)).await.expect_err("nobody is named");
        assert!(refused.message().contains("set all"), "{refused}");
        let reason = "looked at".to_owned();
        let resolution = v1::Resolution::Requeue.into();
        let request = v1::ResolveTasksRequest { filter, resolution, reason, ..Default::default() };
        world.service.resolve_tasks(local(request)).await.expect_err("nobody is named");
    }
    assert_eq!(world.head(), head, "nothing is written");
}

#[tokio::test(start_paused = true)]
async fn each_task_of_many_needs_its_own_right() {
    let world = World::new().await;
    for request in [drive("in-hall", "A01", &[]), drive("in-quality", "Q01", &[])] {
        submit(&world.service, request).await.expect("admitted");
    }
    let by = anna(&["viewer", "dispatcher@quality"]);
    let answer = world.service.cancel_tasks(asked(&by, cancel(&[], false))).await.expect("durable").into_inner();
    let done = answer.outcome.expect("always set");
    assert_eq!((done.matched, done.asked), (2, 1));
    assert_eq!(done.refused.values().sum::<u32>(), 1, "{done:?}");
}

#[tokio::test(start_paused = true)]
async fn a_pin_to_a_robot_that_nobody_knows_is_admitted_with_a_note() {
    let world = World::new().await;
    let pinned = |request_id: &str| {
        let mut request = transport(request_id, "B03");
        if let Some(Body::Flat(flat)) = &mut request.body {
            flat.robot_id = "rbt-99".into();
        }
        request
    };
    let notes = async |request_id: &str| {
        let answer = world.service.submit_task(local(pinned(request_id))).await.expect("admitted").into_inner();
        answer.notes.into_iter().map(|note| note.code).collect::<Vec<_>>()
    };
    assert_eq!(notes("r1").await, ["PINNED_ROBOT_UNKNOWN"]);
    let robot = RobotIdentity {
        robot_id: RobotId::parse("rbt-99").expect("an id"),
        key: None,
        enrolled_unix_ms: Some(NOON.0),
        expires_unix_ms: None,
        enrolment: None,
        revoked: None,
        denied: Vec::new(),
    };
    let mut item = Item::new(Writer::Identity, "anna");
    item.create(&robot, "robot.enrolled");
    world.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    assert!(notes("r2").await.is_empty());
}

#[tokio::test(start_paused = true)]
async fn every_form_of_a_task_can_say_how_long_it_may_be_ready() {
    let world = World::new().await;
    let asked = |body: Body| v1::SubmitTaskRequest { body: Some(body), ..v1::SubmitTaskRequest::default() };
    let Some(Body::Flat(flat)) = transport("", "B03").body else { unreachable!("a flat form") };
    let content = v1::NestedContent { from_waypoint: "A01".into(), to_waypoint: "B03".into(), item_sku: String::new() };
    let nested = v1::NestedTask {
        r#type: "transport".into(),
        content: Some(content),
        timeout_seconds: Some(300),
        schedule_to_start_seconds: Some(90),
        ..v1::NestedTask::default()
    };
    let limited = v1::FlatTask { schedule_to_start_seconds: Some(90), ..flat.clone() };
    for (body, limit) in [(Body::Flat(limited), Some(90)), (Body::Nested(nested), Some(90)), (Body::Flat(flat), None)] {
        let spec = submit(&world.service, asked(body)).await.expect("admitted").spec.expect("always set");
        assert_eq!(spec.schedule_to_start_timeout.map(|limit| limit.seconds), limit);
    }
}
