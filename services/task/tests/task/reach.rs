//! Callers who may do something in some areas only: A01 lies in the hall, Q01 in the quality room.

use crate::world::{NOON, World, patrol, reason, submit, transport};
use midshift_core::fleet::rows::{HolderState, Place, PlaceHolder};
use midshift_core::identity::{Caller, TokenId};
use midshift_core::ids::{PlaceId, RobotId};
use midshift_core::item::Item;
use midshift_core::reason::Refusal;
use midshift_core::rows::{Table, Writer};
use midshift_core::site::PlaceKind;
use midshift_core::task::{TaskIntake, TaskRequest};
use midshift_proto::DenialReporter;
use midshift_proto::denials::DenialSink;
use midshift_proto::task::v1::submit_task_request::Body;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_result::Outcome, watch_tasks_response};
use midshift_store::{Query, Store, load};
use std::sync::{Arc, Mutex};
use tokio_stream::StreamExt;
use tonic::{Code, Request};

/// Whoever writes down what the service denies.
#[derive(Default)]
struct Heard(Mutex<Vec<String>>);

impl Heard {
    fn codes(&self) -> Vec<String> {
        self.0.lock().expect("not poisoned").clone()
    }
}

impl DenialSink for Heard {
    fn denied(&self, refusal: &Refusal) {
        self.0.lock().expect("not poisoned").push(refusal.reason.code.as_str().to_owned());
    }
}

pub fn asked<T>(by: &Caller, message: T) -> Request<T> {
    let mut request = Request::new(message);
    request.extensions_mut().insert(by.clone());
    request
}

/// Anna, with these rights.
pub fn anna(grants: &[&str]) -> Caller {
    let grants = grants.iter().map(|grant| (*grant).to_owned().into()).collect();
    Caller::holder(TokenId::new("t1").expect("an id"), "anna".into(), grants, false)
}

/// A drive to one waypoint.
pub fn drive(request_id: &str, to: &str, depends_on: &[&str]) -> SubmitTaskRequest {
    let mut request = patrol(request_id, depends_on);
    if let Some(Body::Spec(spec)) = &mut request.body {
        spec.steps[0].kind = Some(v1::step::Kind::Goto(v1::Goto { waypoint: to.into() }));
    }
    SubmitTaskRequest { task_id: request_id.into(), ..request }
}

/// A world with a task in each of the two areas, and one that needs both.
async fn world() -> World {
    let world = World::new().await;
    for request in [drive("in-hall", "A01", &[]), drive("in-quality", "Q01", &[])] {
        submit(&world.service, request).await.expect("admitted");
    }
    let both = SubmitTaskRequest { task_id: "in-both".into(), ..transport("in-both", "Q01") };
    submit(&world.service, both).await.expect("admitted");
    world
}

async fn listed(world: &World, by: &Caller, task_ids: &[&str]) -> Vec<String> {
    let task_ids = task_ids.iter().map(ToString::to_string).collect();
    let filter = Some(v1::TaskFilter { task_ids, ..Default::default() });
    let request = v1::ListTasksRequest { filter, ..Default::default() };
    let page = world.service.list_tasks(asked(by, request)).await.expect("a page").into_inner();
    page.tasks.into_iter().map(|task| task.task_id).collect()
}

#[tokio::test]
async fn work_is_brought_in_where_the_caller_dispatches_and_under_its_name() {
    let world = World::new().await;
    let anna = anna(&["dispatcher@hall", "viewer@quality"]);
    world.service.submit_task(asked(&anna, drive("own", "A01", &[]))).await.expect("her area");
    let (intake, _) = load::<TaskIntake>(world.store.as_ref(), "own").await.expect("a store").expect("a task");
    assert_eq!(intake.actor, "anna");
    for request in [drive("other", "Q01", &[]), transport("both", "Q01")] {
        let checked = SubmitTaskRequest { validate_only: true, ..request.clone() };
        for request in [request, checked] {
            let refused = world.service.submit_task(asked(&anna, request)).await.expect_err("not her area");
            assert_eq!((refused.code(), reason(&refused).as_str()), (Code::PermissionDenied, "NOT_PERMITTED"));
        }
    }
    let told = Arc::new(Heard::default());
    let mut request = asked(&anna, drive("other", "Q01", &[]));
    request.extensions_mut().insert(DenialReporter::new(told.clone()));
    world.service.submit_task(request).await.expect_err("not her area");
    assert_eq!(told.codes(), ["NOT_PERMITTED"], "for the audit");
    let nowhere = v1::step::Kind::Wait(v1::Wait { duration: Some(prost_types::Duration { seconds: 1, nanos: 0 }) });
    let mut request = patrol("nowhere", &[]);
    if let Some(Body::Spec(spec)) = &mut request.body {
        spec.steps[0].kind = Some(nowhere);
    }
    let refused = world.service.submit_task(asked(&anna, request)).await.expect_err("it is the site's");
    assert_eq!(refused.code(), Code::PermissionDenied);
}

#[tokio::test]
async fn one_item_of_a_batch_that_is_out_of_reach_is_refused_alone() {
    let world = World::new().await;
    let items = [drive("T1", "A01", &[]), drive("T2", "Q01", &[]), drive("T3", "A01", &["T1"])];
    let stream = tokio_stream::iter(items.map(|item| v1::SubmitTasksRequest { item: Some(item) }));
    let mut request = Request::new(stream);
    request.extensions_mut().insert(anna(&["dispatcher@hall"]));
    let results = world.client().submit_tasks(request).await.expect("a batch").into_inner().results;
    let shown = results.into_iter().map(|result| match result.outcome.expect("always set") {
        Outcome::TaskId(id) => id,
        Outcome::Refusal(refusal) => refusal.reason.expect("always set").code,
    });
    assert_eq!(shown.collect::<Vec<_>>(), ["T1", "NOT_PERMITTED", "T3"]);
    let (intake, _) = load::<TaskIntake>(world.store.as_ref(), "T3").await.expect("a store").expect("a task");
    assert_eq!(intake.actor, "anna");
}

#[tokio::test]
async fn a_task_that_may_not_be_seen_is_not_there_and_one_that_is_seen_is_denied() {
    let world = world().await;
    let anna = anna(&["operator@hall", "viewer@quality"]);
    let blind = self::anna(&["operator@hall"]);
    let get = async |by: &Caller, id: &str| {
        let request = v1::GetTaskRequest { task_id: id.into() };
        world.service.get_task(asked(by, request)).await.err().map(|refused| (refused.code(), reason(&refused)))
    };
    for id in ["in-hall", "in-quality", "in-both"] {
        assert_eq!(get(&anna, id).await, None, "{id}");
    }
    let gone = get(&blind, "never").await;
    assert_eq!(gone, Some((Code::NotFound, "TASK_NOT_FOUND".to_owned())));
    assert_eq!([get(&blind, "in-quality").await, get(&blind, "in-both").await], [gone.clone(), gone.clone()]);
    let cancel = async |by: &Caller, id: &str| {
        let request = v1::CancelTaskRequest { task_id: id.into(), reason: "no need".into(), ..Default::default() };
        world.service.cancel_task(asked(by, request)).await.map_or_else(|refused| refused.code(), |_| Code::Ok)
    };
    assert_eq!(cancel(&blind, "in-quality").await, Code::NotFound);
    assert_eq!(cancel(&anna, "in-quality").await, Code::PermissionDenied);
    assert_eq!(cancel(&anna, "in-both").await, Code::PermissionDenied, "every area of it");
    assert_eq!(cancel(&anna, "in-hall").await, Code::Ok);
    let request = v1::ResolveTaskRequest {
        task_id: "in-quality".into(),
        reason: "seen".into(),
        resolution: v1::Resolution::Failed.into(),
        etag: "1".into(),
        ..Default::default()
    };
    let refused = world.service.resolve_task(asked(&anna, request)).await.expect_err("not her area");
    assert_eq!(refused.code(), Code::PermissionDenied);
    let asked = world.store.list(Query::all(Table::TaskRequest)).await.expect("rows");
    let actors: Vec<String> = asked.iter().map(|row| row.decode::<TaskRequest>().expect("a row").actor).collect();
    assert_eq!(actors, ["anna"], "what was refused was not written");
}

#[tokio::test]
async fn lists_and_watches_have_the_tasks_only_that_may_be_seen() {
    let world = world().await;
    let all = ["in-both", "in-quality", "in-hall"];
    assert_eq!(listed(&world, &anna(&["viewer"]), &[]).await, all);
    assert_eq!(listed(&world, &Caller::local(), &[]).await, all);
    let blind = anna(&["viewer@hall"]);
    for named in [&[][..], &all] {
        assert_eq!(listed(&world, &blind, named).await, ["in-hall"], "{named:?}");
        assert_eq!(listed(&world, &anna(&["stop-only"]), named).await, [""; 0], "{named:?}");
    }
    let request = v1::WatchTasksRequest::default();
    let mut watch = world.service.watch_tasks(asked(&blind, request)).await.expect("a watch").into_inner();
    submit(&world.service, drive("later-quality", "Q01", &[])).await.expect("admitted");
    world.runs("in-quality", 1).await;
    submit(&world.service, drive("later-hall", "A01", &[])).await.expect("admitted");
    let mut told = Vec::new();
    while told.last().is_none_or(|id| id != "later-hall") {
        match watch.next().await.expect("a message").expect("no refusal").item.expect("always set") {
            watch_tasks_response::Item::Existing(task) => told.push(task.task_id),
            watch_tasks_response::Item::Change(change) => told.push(change.task.expect("always set").task_id),
            watch_tasks_response::Item::Bookmark(_) => {}
        }
    }
    assert_eq!(told, ["in-hall", "later-hall"]);
}

#[tokio::test]
async fn nobody_waits_for_a_task_that_it_may_not_see() {
    let world = world().await;
    let depends = |on: &str| drive("T", "A01", &[on]);
    let refused = world.service.submit_task(asked(&anna(&["dispatcher@hall"]), depends("in-quality"))).await;
    let unknown = world.service.submit_task(asked(&anna(&["dispatcher@hall"]), depends("in-qualitx"))).await;
    let text = |refused: Result<_, tonic::Status>| format!("{:?}", refused.map(drop).expect_err("not there").message());
    assert_eq!(text(refused), text(unknown).replace("in-qualitx", "in-quality"));
    let seen = anna(&["dispatcher@hall", "viewer@quality"]);
    world.service.submit_task(asked(&seen, depends("in-quality"))).await.expect("she sees it");
}

#[tokio::test(start_paused = true)]
async fn what_is_held_is_let_go_where_the_caller_operates() {
    let world = world().await;
    let mut item = Item::new(Writer::Fleet, "fleet");
    for (robot, place) in [("r1", "A01"), ("r2", "Q01")] {
        let holder = PlaceHolder {
            robot_id: RobotId::parse(robot).expect("an id"),
            state: HolderState::Inside,
            since: NOON,
            grant_id: 1,
            claimed: false,
        };
        let place_id = PlaceId::parse(place).expect("an id");
        item.create(
            &Place {
                place_id,
                capacity: 3,
                kind: PlaceKind::Standing,
                holders: vec![holder],
                quarantine: None,
                cleared: Vec::new(),
            },
            "place.granted",
        );
    }
    world.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    world.copies_stop("STOP-1", true).await;
    world.enrols(&["r1", "r2"]).await;
    let resume = async |by: &Caller, change: &dyn Fn(&mut v1::ResumeHeldRequest)| {
        let mut request = v1::ResumeHeldRequest { reason: "clear".into(), ..Default::default() };
        change(&mut request);
        world.service.resume_held(asked(by, request)).await.map_or_else(|refused| refused.code(), |_| Code::Ok)
    };
    let anna = anna(&["operator@hall", "viewer@quality"]);
    let denied = Code::PermissionDenied;
    assert_eq!(resume(&anna, &|r| r.stop_id = "STOP-1".into()).await, denied, "everywhere");
    assert_eq!(resume(&self::anna(&["operator"]), &|r| r.stop_id = "STOP-1".into()).await, Code::Ok);
    for (area, expected) in [("hall", Code::Ok), ("quality", denied)] {
        assert_eq!(resume(&anna, &|r| r.area_id = area.into()).await, expected, "{area}");
    }
    for (task, expected) in [("in-hall", Code::Ok), ("in-quality", denied), ("in-both", denied)] {
        assert_eq!(resume(&anna, &|r| r.task_ids = vec![task.into()]).await, expected, "{task}");
    }
    let blind = self::anna(&["operator@hall"]);
    for hidden in ["in-quality", "never"] {
        let both = |r: &mut v1::ResumeHeldRequest| r.task_ids = vec!["in-hall".into(), hidden.into()];
        assert_eq!(resume(&blind, &both).await, Code::NotFound, "{hidden}");
    }
    for (robot, expected) in [("r1", Code::Ok), ("r2", denied), ("r3", denied)] {
        assert_eq!(resume(&anna, &|r| r.robot_ids = vec![robot.into()]).await, expected, "{robot}");
    }
    let one_too_many = |r: &mut v1::ResumeHeldRequest| {
        r.area_id = "hall".into();
        r.robot_ids = vec!["r1".into(), "r2".into()];
    };
    assert_eq!(resume(&anna, &one_too_many).await, denied);
}
