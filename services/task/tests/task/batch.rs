//! Batches: each item stands for itself, in order.

use crate::world::{World, count, patrol, transport};
use midshift_core::limits;
use midshift_proto::access::local;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_request::Body, submit_task_result::Outcome};
use std::collections::BTreeSet;
use std::time::Duration;
use tokio_stream::StreamExt;
use tonic::{Code, Status};

async fn send(world: &World, items: Vec<SubmitTaskRequest>) -> Result<Vec<v1::SubmitTaskResult>, Status> {
    let stream = tokio_stream::iter(items.into_iter().map(|item| v1::SubmitTasksRequest { item: Some(item) }));
    Ok(world.client().submit_tasks(local(stream)).await?.into_inner().results)
}

fn shown(result: &v1::SubmitTaskResult) -> String {
    match result.outcome.as_ref().expect("always set") {
        Outcome::TaskId(id) => id.clone(),
        Outcome::Refusal(refusal) => refusal.reason.as_ref().expect("always set").code.clone(),
    }
}

#[tokio::test]
async fn each_item_stands_for_itself_and_answers_come_in_order() {
    let world = World::new().await;
    let named =
        |request_id: &str, task_id: &str| SubmitTaskRequest { task_id: task_id.into(), ..transport(request_id, "B03") };
    let items = vec![
        named("r1", "T1"),
        transport("r2", "nowhere"),
        named("r1", "T1"),
        transport("r1", "B01"),
        transport("", "B03"),
        SubmitTaskRequest { task_id: "T1".into(), ..transport("r3", "B01") },
        SubmitTaskRequest { validate_only: true, ..transport("r4", "B03") },
        named("r5", "T5"),
    ];
    let results = send(&world, items).await.expect("a batch");
    let ids: Vec<_> = results.iter().map(|r| r.request_id.as_str()).collect();
    assert_eq!(ids, ["r1", "r2", "r1", "r1", "", "r3", "r4", "r5"]);
    let outcomes: Vec<_> = results.iter().map(shown).collect();
    let invalid = "INVALID_REQUEST";
    assert_eq!(outcomes, ["T1", invalid, "T1", "REQUEST_ID_REUSED", invalid, "TASK_ID_TAKEN", invalid, "T5"]);
    assert_eq!(count(&world.service).await, 2);
}

#[tokio::test]
async fn an_item_whose_parameters_are_no_json_is_refused_by_their_path_and_the_others_are_admitted() {
    let world = World::new().await;
    let mut broken = patrol("r1", &[]);
    let Some(Body::Spec(spec)) = &mut broken.body else { panic!("a spec") };
    let number = prost_types::Value { kind: Some(prost_types::value::Kind::NumberValue(f64::INFINITY)) };
    let params = Some(prost_types::Struct { fields: [("weight".to_owned(), number)].into() });
    let inspect = v1::step::Kind::Action(v1::Action { name: "inspect".to_owned(), params });
    spec.steps.push(v1::Step { kind: Some(inspect), ..v1::Step::default() });
    let results = send(&world, vec![broken, patrol("r2", &[])]).await.expect("a batch");
    let Some(Outcome::Refusal(refusal)) = &results[0].outcome else { panic!("{results:?}") };
    let fields: Vec<_> = refusal.violations.iter().map(|v| v.field.as_str()).collect();
    assert_eq!(fields, ["spec.steps[1].action.params.weight"]);
    assert!(matches!(results[1].outcome, Some(Outcome::TaskId(_))), "{results:?}");
    assert_eq!(count(&world.service).await, 1);
}

#[tokio::test]
async fn an_item_may_depend_on_one_before_it_wherever_slices_end_but_not_on_one_after_it() {
    let world = World::new().await;
    let named = |id: &str, depends_on: &[&str]| SubmitTaskRequest { task_id: id.into(), ..patrol(id, depends_on) };
    let items = vec![named("T1", &[]), named("T2", &["T1"]), named("T3", &["T4"]), named("T4", &["T1", "T2"])];
    let outcomes: Vec<_> = send(&world, items).await.expect("a batch").iter().map(shown).collect();
    assert_eq!(outcomes, ["T1", "T2", "INVALID_REQUEST", "T4"]);
}

#[tokio::test]
async fn an_item_of_each_form_may_ask_for_the_robot_of_one_before_it() {
    let world = World::new().await;
    let first = SubmitTaskRequest { task_id: "T1".into(), ..transport("r1", "B03") };
    let mut flat = transport("r2", "B03");
    let Some(Body::Flat(form)) = &mut flat.body else { panic!("{flat:?}") };
    form.same_robot_as = "T1".into();
    let content = Some(v1::NestedContent { to_waypoint: "B03".into(), ..v1::NestedContent::default() });
    let form = v1::NestedTask {
        task_id: "T3".into(),
        r#type: "patrol".into(),
        content,
        timeout_seconds: Some(60),
        same_robot_as: "T1".into(),
        ..v1::NestedTask::default()
    };
    let nested = SubmitTaskRequest { body: Some(Body::Nested(form)), ..transport("r3", "B03") };
    let outcomes: Vec<_> = send(&world, vec![first, flat, nested]).await.expect("a batch").iter().map(shown).collect();
    let spec = world.get(&outcomes[1]).await.spec.expect("a spec");
    assert_eq!((spec.same_robot_as.as_str(), outcomes[2].as_str()), ("T1", "T3"));
}

#[tokio::test]
async fn a_batch_longer_than_a_slice_is_admitted_whole_in_the_order_sent_and_can_be_sent_again() {
    let world = World::new().await;
    let items: Vec<_> = (0..limits::SUBMIT_SLICE * 2 + 1).map(|i| transport(&format!("r{i}"), "B03")).collect();
    let first: Vec<_> = send(&world, items.clone()).await.expect("a batch").iter().map(shown).collect();
    assert_eq!(first.iter().collect::<BTreeSet<_>>().len(), items.len());
    let (early, late) = (world.get(&first[0]).await, world.get(&first[items.len() - 1]).await);
    assert!(early.number < late.number);
    let head = world.head();
    let again: Vec<_> = send(&world, items).await.expect("the same batch").iter().map(shown).collect();
    assert_eq!((again, world.head()), (first, head));
}

#[tokio::test]
async fn a_batch_over_its_limit_is_refused_after_what_came_before_was_admitted() {
    let world = World::new().await;
    // Dependencies cut slices short, so that the limit falls inside one.
    let mut items = vec![SubmitTaskRequest { task_id: "T1".into(), ..patrol("T1", &[]) }, patrol("T2", &["T1"])];
    items.extend((2..=limits::SUBMIT_ITEMS_MAX).map(|i| transport(&format!("r{i}"), "B03")));
    let refused = send(&world, items).await.expect_err("10001 items");
    assert_eq!(refused.code(), Code::InvalidArgument);
    let head = world.head();
    let last = send(&world, vec![transport("r9999", "B03")]).await.expect("a batch");
    world.get(&shown(&last[0])).await;
    assert_eq!(world.head(), head, "it was the last one admitted then, not a new one");
}

#[tokio::test]
async fn a_batch_over_its_limit_is_refused_while_its_sender_still_holds_the_stream_open() {
    let world = World::new().await;
    let items = (0..=limits::SUBMIT_ITEMS_MAX).map(|i| transport(&format!("r{i}"), "B03"));
    let messages = items.map(|item| v1::SubmitTasksRequest { item: Some(item) });
    let stream = tokio_stream::iter(messages).chain(tokio_stream::pending());
    let mut client = world.client();
    let answer = tokio::time::timeout(Duration::from_secs(60), client.submit_tasks(local(stream))).await;
    assert_eq!(answer.expect("an answer").expect_err("10001 items").code(), Code::InvalidArgument);
}
