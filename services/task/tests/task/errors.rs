//! What a caller hears of a refusal.

use crate::world::{World, transport};
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{GetTaskRequest, SubmitTaskRequest};
use tonic::Status;

async fn shown(world: &World, request_id: &str, header: Option<&str>) -> String {
    let mut request = local(SubmitTaskRequest { request_id: request_id.into(), ..transport("", "nowhere") });
    if let Some(header) = header {
        request.metadata_mut().insert("x-request-id", header.parse().expect("ascii"));
    }
    let status: Status = world.service.submit_task(request).await.expect_err("no such waypoint");
    midshift_proto::refusal_of(&status).request_id
}

#[tokio::test]
async fn an_error_names_the_request_of_its_body_or_of_its_header_or_one_that_was_drawn() {
    let world = World::new().await;
    assert_eq!(shown(&world, "r1", Some("h1")).await, "r1");
    assert_eq!(shown(&world, "", Some("h1")).await, "h1");
    let (one, two) = (shown(&world, "", None).await, shown(&world, "", Some("not an id")).await);
    assert!(one.len() == 16 && two.len() == 16 && one != two, "{one} {two}");
    let request = local(GetTaskRequest { task_id: "TASK-X".into() });
    let status = world.service.get_task(request).await.expect_err("no such task");
    assert!(!midshift_proto::refusal_of(&status).request_id.is_empty());
}
