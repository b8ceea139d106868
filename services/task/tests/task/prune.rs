//! What is kept for some days, and then no longer.

use crate::world::{World, count, submit, transport};
use midshift_core::item::Item;
use midshift_core::rows::{Key, Table, Writer};
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{CancelTaskRequest, CancelTaskResponse};
use midshift_store::{Query, Store};
use midshift_task::TaskService;

const DAY_MS: i64 = 86_400_000;

async fn rows(world: &World, table: Table) -> usize {
    world.store.list(Query::all(table)).await.expect("a list").len()
}

async fn cancel(service: &TaskService, task_id: &str) -> CancelTaskResponse {
    let request = CancelTaskRequest {
        task_id: task_id.into(),
        request_id: "stop-1".into(),
        reason: "not wanted".into(),
        ..CancelTaskRequest::default()
    };
    service.cancel_task(local(request)).await.expect("durable").into_inner()
}

#[tokio::test(start_paused = true)]
async fn a_used_request_id_is_known_for_seven_days_and_then_free_again() {
    let world = World::new().await;
    // More than one slice.
    for n in 0..450 {
        submit(&world.service, transport(&format!("req-{n}"), "B03")).await.expect("admitted");
    }
    let first = submit(&world.service, transport("req-0", "B03")).await.expect("known").task_id;
    let on_the_last_day = world.later(7 * DAY_MS).await;
    assert_eq!(on_the_last_day.prune().await.expect("pruned"), 0);
    assert_eq!(submit(&on_the_last_day, transport("req-0", "B03")).await.expect("known").task_id, first);
    let after = world.later(7 * DAY_MS + 1).await;
    assert_eq!(after.prune().await.expect("pruned"), 450);
    assert_eq!((rows(&world, Table::RequestKey).await, rows(&world, Table::TaskIntake).await), (0, 450));
    assert_ne!(submit(&after, transport("req-0", "B03")).await.expect("admitted anew").task_id, first);
    assert_eq!(count(&after).await, 100, "tasks stay");
}

#[tokio::test(start_paused = true)]
async fn what_people_asked_is_kept_for_thirty_days() {
    let world = World::new().await;
    let task = submit(&world.service, transport("", "B03")).await.expect("admitted");
    cancel(&world.service, &task.task_id).await;
    let later = world.later(30 * DAY_MS).await;
    assert_eq!(later.prune().await.expect("pruned"), 1, "the request_id");
    assert_eq!(rows(&world, Table::TaskRequest).await, 1);
    let after = world.later(30 * DAY_MS + 1).await;
    assert_eq!(after.prune().await.expect("pruned"), 1);
    assert_eq!(rows(&world, Table::TaskRequest).await, 0);
}

#[tokio::test(start_paused = true)]
async fn what_was_asked_for_is_kept_as_long_as_its_task_and_goes_with_it() {
    let world = World::new().await;
    let task = submit(&world.service, transport("", "B03")).await.expect("admitted");
    let other = submit(&world.service, transport("", "B03")).await.expect("admitted");
    let after = world.later(31 * DAY_MS).await;
    after.prune().await.expect("pruned");
    assert_eq!(rows(&world, Table::TaskIntake).await, 2, "both tasks are there");
    let state = world.store.get(vec![Key::new(Table::TaskState, &task.task_id)]).await.expect("rows").remove(0);
    let mut item = Item::new(Writer::Fleet, "fleet");
    item.delete(state.key, state.revision, "task.forgotten");
    world.store.commit(vec![item]).await.remove(0).expect("applied");
    assert_eq!(after.prune().await.expect("pruned"), 1);
    let left = world.store.list(Query::all(Table::TaskIntake)).await.expect("a list");
    assert_eq!(left.iter().map(|row| &*row.key.id).collect::<Vec<_>>(), [other.task_id.as_str()]);
}

#[tokio::test(start_paused = true)]
async fn what_was_asked_of_tasks_that_are_still_there_shields_none_behind_it() {
    let world = World::new().await;
    // More than one slice of tasks that nobody resolves, and one behind them that is gone.
    for _ in 0..450 {
        submit(&world.service, transport("", "B03")).await.expect("admitted");
    }
    let gone = submit(&world.service, transport("", "B03")).await.expect("admitted").task_id;
    let (_, revision) = world.state(&gone).await;
    let mut item = Item::new(Writer::Fleet, "fleet");
    item.delete(Key::new(Table::TaskState, &gone), revision, "task.forgotten");
    world.store.commit(vec![item]).await.remove(0).expect("applied");
    let after = world.later(31 * DAY_MS).await;
    assert_eq!(after.prune().await.expect("pruned"), 1);
    assert_eq!(world.store.get(vec![Key::new(Table::TaskIntake, &gone)]).await.expect("rows").len(), 0);
}

#[tokio::test(start_paused = true)]
async fn a_request_id_used_again_after_it_was_forgotten_waits_for_its_own_request() {
    let world = World::new().await;
    let [one, two] = ["B03", "B02"].map(|to| transport("", to));
    let one = submit(&world.service, one).await.expect("admitted").task_id;
    let two = submit(&world.service, two).await.expect("admitted").task_id;
    assert!(cancel(&world.service, &one).await.pending);
    let later = world.later(8 * DAY_MS).await;
    later.prune().await.expect("pruned");
    // Fleet has looked at everything up to here, and at nothing after it.
    world.fleet_turns().await;
    assert!(cancel(&later, &two).await.pending);
    assert!(cancel(&later, &two).await.pending, "the log still has the first use of the id, which fleet has looked at");
}
