//! Both JSON forms of the source article, as they stand.

use crate::world::{World, reason, submit, transport};
use midshift_core::site::text;
use midshift_proto::json::from_json;
use midshift_proto::task::v1::{SubmitTaskRequest, Task, step::Kind, submit_task_request::Body};
use std::sync::Arc;

const FLAT: &str = include_str!("../../../../proto/golden/article_flat.json");
const NESTED: &str = include_str!("../../../../proto/golden/article_nested.json");

fn flat() -> SubmitTaskRequest {
    let flat = from_json(serde_json::from_str(FLAT).expect("json")).expect("a flat task");
    SubmitTaskRequest { body: Some(Body::Flat(flat)), ..SubmitTaskRequest::default() }
}

fn nested() -> SubmitTaskRequest {
    let nested = from_json(serde_json::from_str(NESTED).expect("json")).expect("a nested task");
    SubmitTaskRequest { body: Some(Body::Nested(nested)), ..SubmitTaskRequest::default() }
}

fn steps(task: &Task) -> Vec<String> {
    let spec = task.spec.as_ref().expect("always set");
    let word = |kind: &Kind| match kind {
        Kind::Goto(goto) => format!("goto {}", goto.waypoint),
        Kind::Action(action) => action.name.clone(),
        Kind::Wait(_) => "wait".to_owned(),
    };
    spec.steps.iter().map(|s| word(s.kind.as_ref().expect("always set"))).collect()
}

#[tokio::test]
async fn both_forms_of_the_article_become_the_same_task() {
    let mut specs = Vec::new();
    for form in [flat(), nested()] {
        let world = World::new().await;
        let task = submit(&world.service, form.clone()).await.expect("admitted");
        assert_eq!(task.task_id, "TASK-20260601-001");
        assert_eq!(steps(&task), ["goto A01", "pick", "goto B03", "place"]);
        let again = submit(&world.service, form).await.expect("the same body is the same task");
        assert_eq!(again, task);
        specs.push(task.spec.expect("always set"));
    }
    assert_eq!(specs[0], specs[1]);
    assert_eq!((specs[0].priority, specs[0].robot_id.as_str()), (Some(2), "rbt-01"));
    assert_eq!(specs[0].retry.as_ref().expect("asked for").max_retry_times, 3);
}

#[tokio::test]
async fn a_task_without_a_timeout_is_refused_in_every_form() {
    let world = World::new().await;
    let mut request = flat();
    let Some(Body::Flat(flat)) = &mut request.body else { panic!("a flat task") };
    flat.timeout_seconds = None;
    let status = submit(&world.service, request).await.expect_err("no timeout");
    let violations = midshift_proto::refusal_of(&status).violations;
    assert_eq!(violations.iter().map(|v| v.field.as_str()).collect::<Vec<_>>(), ["flat.timeout_seconds"]);
}

#[tokio::test]
async fn a_repeat_gets_its_task_although_the_site_has_changed_since() {
    let world = World::new().await;
    let first = submit(&world.service, transport("r1", "B03")).await.expect("admitted");
    let chosen = submit(&world.service, flat()).await.expect("admitted");
    let other = midshift_core::site::DEMO.replace("B03", "B99");
    let site = Arc::new(text::parse(&other).expect("a site without B03"));
    let world = World::over(world.store.clone(), site).await;
    assert_eq!(submit(&world.service, transport("r1", "B03")).await.expect("the same").task_id, first.task_id);
    assert_eq!(submit(&world.service, flat()).await.expect("the same").task_id, chosen.task_id);
    let fresh = submit(&world.service, transport("r2", "B03")).await.expect_err("a new one is refused");
    assert_eq!(reason(&fresh), "INVALID_REQUEST");
    let number = submit(&world.service, transport("r3", "B99")).await.expect("admitted").number;
    assert!(number > chosen.number, "numbers go on after a restart");
}
