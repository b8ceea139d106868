//! Lists: filters and tasks in full.

use crate::world::{World, patrol, submit, transport};
use midshift_core::task::AttemptPhase;
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, ListTasksRequest, TaskFilter};
use tonic::Code;

async fn page(world: &World, filter: TaskFilter, size: u32, token: &str) -> v1::ListTasksResponse {
    let request = ListTasksRequest { filter: Some(filter), page_size: size, page_token: token.into() };
    world.service.list_tasks(local(request)).await.expect("a page").into_inner()
}

async fn numbers(world: &World, filter: TaskFilter) -> Vec<u64> {
    page(world, filter, 0, "").await.tasks.iter().map(|t| t.number).collect()
}

fn ids(page: &v1::ListTasksResponse) -> Vec<&str> {
    page.tasks.iter().map(|task| task.task_id.as_str()).collect()
}

#[tokio::test]
async fn every_filter_holds_and_they_hold_together() {
    let world = World::new().await;
    let first = submit(&world.service, transport("r1", "B03")).await.expect("admitted");
    let second = submit(&world.service, patrol("r2", &[])).await.expect("admitted");
    let third = submit(&world.service, transport("r3", "B01")).await.expect("admitted");
    world.runs(&third.task_id, 1).await;
    let types = |t: &str| TaskFilter { types: vec![t.into()], ..TaskFilter::default() };
    assert_eq!(numbers(&world, TaskFilter::default()).await, [third.number, second.number, first.number]);
    assert_eq!(numbers(&world, types("transport")).await, [third.number, first.number]);
    let states = vec![v1::TaskState::Running.into()];
    assert_eq!(numbers(&world, TaskFilter { states, ..types("transport") }).await, [third.number]);
    let robot_ids = vec!["rbt-01".to_owned()];
    assert_eq!(numbers(&world, TaskFilter { robot_ids, ..types("patrol") }).await, [0u64; 0]);
    let task_id_prefix = first.task_id.clone();
    assert_eq!(numbers(&world, TaskFilter { task_id_prefix, ..TaskFilter::default() }).await, [first.number]);
}

#[tokio::test]
async fn tasks_named_by_id_come_in_pages_newest_first_and_unknown_ones_are_left_out() {
    let world = World::new().await;
    let mut admitted = Vec::new();
    for i in 0..4 {
        admitted.push(submit(&world.service, transport(&format!("r{i}"), "B03")).await.expect("admitted").task_id);
    }
    let task_ids = vec!["TASK-X".to_owned(), admitted[0].clone(), admitted[2].clone(), admitted[3].clone()];
    let filter = TaskFilter { task_ids, ..TaskFilter::default() };
    let first = page(&world, filter.clone(), 2, "").await;
    assert_eq!(ids(&first), [admitted[3].as_str(), &admitted[2]]);
    let last = page(&world, filter, 2, &first.next_page_token).await;
    assert_eq!(ids(&last), [admitted[0].as_str()]);
    assert!(last.next_page_token.is_empty());
}

#[tokio::test]
async fn tasks_of_two_services_are_listed_newest_first_by_either_and_a_page_of_one_goes_on_at_the_other() {
    let world = World::new().await;
    let other = World::over(world.store.clone(), world.site.clone()).await;
    let mut admitted = Vec::new();
    // One of them admits most.
    for (i, service) in [&world.service; 5].into_iter().chain([&other.service, &world.service]).enumerate() {
        admitted.push(submit(service, transport(&format!("r{i}"), "B03")).await.expect("admitted").task_id);
    }
    admitted.reverse();
    let first = page(&other, TaskFilter::default(), 3, "").await;
    let rest = page(&world, TaskFilter::default(), 10, &first.next_page_token).await;
    assert_eq!([ids(&first), ids(&rest)].concat(), admitted);
    assert_eq!(page(&other, TaskFilter::default(), 10, "").await, page(&world, TaskFilter::default(), 10, "").await);
}

#[tokio::test]
async fn a_page_too_large_and_a_token_made_up_are_refused() {
    let world = World::new().await;
    for (page_size, page_token) in [(1001, ""), (1, "x:y:z")] {
        let request = ListTasksRequest { filter: None, page_size, page_token: page_token.into() };
        let status = world.service.list_tasks(local(request)).await.expect_err("refused");
        assert_eq!(status.code(), Code::InvalidArgument);
    }
}

#[tokio::test]
async fn a_task_is_shown_with_all_its_attempts_oldest_first() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    for epoch in [1, 2] {
        let (task, mut attempt) = world.runs(&task_id, epoch).await;
        attempt.phase = AttemptPhase::Failed;
        world.fleet_writes(&task, Some(&attempt)).await;
    }
    let request = local(v1::GetTaskRequest { task_id });
    let answer = world.service.get_task(request).await.expect("a task").into_inner();
    assert_eq!(answer.attempts.iter().map(|a| a.epoch).collect::<Vec<_>>(), [1, 2]);
    assert_eq!(answer.task.expect("always set").attempt, answer.attempts.last().cloned());
}
