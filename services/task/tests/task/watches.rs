//! Watches: every change once, with state and attempt of its moment, from any cursor.

use crate::world::{World, reason, submit, transport};
use midshift_core::ids::TaskId;
use midshift_core::item::Item as StoredItem;
use midshift_core::rows::Writer;
use midshift_core::task::{AttemptPhase, Phase, TaskIntake};
use midshift_proto::access::local;
use midshift_proto::task::v1::{self, AttemptState, TaskState, watch_tasks_response::Item};
use midshift_store::{Store, load};
use tonic::Code;

type Seen = (TaskState, Option<AttemptState>);

fn seen(task: &v1::Task) -> Seen {
    (task.state(), task.attempt.as_ref().map(v1::Attempt::state))
}

/// Submits a task that is driven, acted on, told to stop and ended. Returns what a watcher must see.
async fn life(world: &World, request_id: &str) -> (String, Vec<Seen>) {
    let task_id = submit(&world.service, transport(request_id, "B03")).await.expect("admitted").task_id;
    let (mut task, mut attempt) = world.runs(&task_id, 1).await;
    attempt.phase = AttemptPhase::Executing;
    world.fleet_writes(&task, Some(&attempt)).await;
    task.next_step = 1;
    world.fleet_writes(&task, None).await;
    (task.phase, attempt.phase) = (Phase::Stopping, AttemptPhase::Stopping);
    world.fleet_writes(&task, Some(&attempt)).await;
    (task.phase, attempt.phase) = (Phase::Canceled, AttemptPhase::Aborted);
    world.fleet_writes(&task, Some(&attempt)).await;
    let seen = vec![
        (TaskState::Queued, None),
        (TaskState::Running, Some(AttemptState::Navigating)),
        (TaskState::Running, Some(AttemptState::Executing)),
        (TaskState::Running, Some(AttemptState::Executing)),
        (TaskState::Stopping, Some(AttemptState::Stopping)),
        (TaskState::Canceled, Some(AttemptState::Aborted)),
    ];
    (task_id, seen)
}

#[tokio::test(start_paused = true)]
async fn a_change_has_the_state_and_the_attempt_of_its_moment() {
    let world = World::new().await;
    let mut watch = world.watch(None, "").await;
    watch.bookmark().await;
    let (_, expected) = life(&world, "r1").await;
    for expected in expected {
        assert_eq!(seen(&watch.changed().await), expected);
    }
}

#[tokio::test(start_paused = true)]
async fn from_every_cursor_on_the_rest_is_heard_once_and_unchanged() {
    let world = World::new().await;
    let mut watch = world.watch(None, "").await;
    let mut cursors = vec![watch.bookmark().await];
    let (_, mut whole) = life(&world, "r1").await;
    whole.extend(life(&world, "r2").await.1);
    for _ in &whole {
        cursors.push(watch.change().await.1);
    }
    for (at, cursor) in cursors.iter().enumerate() {
        let mut watch = world.watch(None, cursor).await;
        let mut rest = Vec::new();
        for _ in at..whole.len() {
            rest.push(seen(&watch.changed().await));
        }
        assert_eq!(rest, whole[at..], "from cursor {at}");
        let end = watch.message().await;
        assert!(matches!(end.item, Some(Item::Bookmark(_))), "nothing is said twice");
    }
}

#[tokio::test(start_paused = true)]
async fn changes_longer_than_a_page_are_all_heard_with_their_attempts() {
    let world = World::new().await;
    let mut watch = world.watch(None, "").await;
    let cursor = watch.bookmark().await;
    let mut expected = Vec::new();
    for i in 0..400 {
        let (task_id, lived) = life(&world, &format!("r{i}")).await;
        expected.extend(lived.into_iter().map(|seen| (task_id.clone(), seen)));
    }
    let mut late = world.watch(None, &cursor).await;
    for (task_id, expected) in expected {
        let task = late.changed().await;
        assert_eq!((&task.task_id, seen(&task)), (&task_id, expected));
    }
}

#[tokio::test(start_paused = true)]
async fn an_attempt_older_than_the_log_is_shown_as_its_row_has_it() {
    let world = World::keeping(20).await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    let (mut task, _) = world.runs(&task_id, 1).await;
    for i in 0..30 {
        let other = submit(&world.service, transport(&format!("x{i}"), "B03")).await.expect("admitted").task_id;
        let (other, _) = world.state(&other).await;
        world.fleet_writes(&other, None).await;
    }
    let mut watch = world.watch(None, "").await;
    watch.bookmark().await;
    task.next_step = 1;
    world.fleet_writes(&task, None).await;
    assert_eq!(seen(&watch.changed().await), (TaskState::Running, Some(AttemptState::Navigating)));
}

#[tokio::test(start_paused = true)]
async fn a_cancel_obeyed_by_fleet_shows_the_task_and_its_attempt_stopping_together() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    world.runs(&task_id, 1).await;
    let mut watch = world.watch(None, "").await;
    watch.bookmark().await;
    let request = v1::CancelTaskRequest { task_id, reason: "enough".into(), ..v1::CancelTaskRequest::default() };
    world.client().cancel_task(local(request)).await.expect("durable");
    world.fleet_turns().await;
    assert_eq!(seen(&watch.changed().await), (TaskState::Stopping, Some(AttemptState::Stopping)));
}

#[tokio::test(start_paused = true)]
async fn no_task_goes_backwards_when_it_changes_while_existing_ones_are_read() {
    let world = World::new().await;
    let mut last = String::new();
    // More than one page: the watcher fixes its place, reads the first, and waits for room before it reads the second.
    for i in 0..1_100 {
        last = submit(&world.service, transport(&format!("r{i}"), "B03")).await.expect("admitted").task_id;
    }
    let mut watch = world.watch(None, "").await;
    watch.message().await;
    for _ in 0..5 {
        let (task, _) = world.state(&last).await;
        world.fleet_writes(&task, None).await;
    }
    let (mut newest, mut bookmarks) = (0, 0);
    while bookmarks < 2 {
        let (task, existing) = match watch.message().await.item.expect("always set") {
            Item::Existing(task) => (task, true),
            Item::Change(change) => (change.task.expect("always set"), false),
            Item::Bookmark(_) => {
                bookmarks += 1;
                continue;
            }
        };
        if task.task_id == last {
            let etag: u64 = task.etag.parse().expect("a number");
            assert!(newest < etag, "from {newest} to {etag}");
            newest = etag;
            assert!(!existing || etag == 6, "the changes lie before the reading of its page");
        }
    }
    assert_eq!(newest, 6, "the last change was heard");
}

#[tokio::test(start_paused = true)]
async fn a_watcher_of_a_busy_store_still_hears_bookmarks() {
    let world = World::new().await;
    let task_id = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    let filter = v1::TaskFilter { types: vec!["patrol".into()], ..v1::TaskFilter::default() };
    let mut watch = world.watch(Some(filter), "").await;
    let first = watch.bookmark().await;
    let noise = async {
        loop {
            tokio::time::sleep(std::time::Duration::from_secs(1)).await;
            let (task, _) = world.state(&task_id).await;
            world.fleet_writes(&task, None).await;
        }
    };
    let limit = tokio::time::Instant::now() + std::time::Duration::from_secs(60);
    let next = tokio::select! {
        next = watch.bookmark() => next,
        () = noise => String::new(),
        () = tokio::time::sleep_until(limit) => String::new(),
    };
    assert!(!next.is_empty() && next != first, "a bookmark of a later place");
}

#[tokio::test(start_paused = true)]
async fn a_cursor_that_is_gone_or_foreign_or_nonsense_is_refused_for_what_it_is() {
    let world = World::keeping(4).await;
    let mut watch = world.watch(None, "").await;
    let cursor = watch.bookmark().await;
    life(&world, "r1").await;
    let gone = world.watch(None, &cursor).await.refusal().await;
    assert_eq!((gone.code(), reason(&gone).as_str()), (Code::OutOfRange, "CURSOR_EXPIRED"));
    let ahead = world.watch(None, &format!("store-1:{}", world.head().0 + 1)).await.refusal().await;
    assert_eq!(ahead.code(), Code::OutOfRange);
    for (cursor, code) in [("store-2:7", Code::FailedPrecondition), ("7", Code::InvalidArgument)] {
        let request = v1::WatchTasksRequest { filter: None, cursor: cursor.into() };
        let status = world.client().watch_tasks(local(request)).await.expect_err("refused");
        assert_eq!(status.code(), code, "{cursor}");
    }
}

#[tokio::test(start_paused = true)]
async fn a_watcher_that_does_not_read_holds_up_nobody_and_all_end_at_shutdown() {
    let world = World::new().await;
    let mut slow = world.watch(None, "").await;
    let mut quick = world.watch(None, "").await;
    quick.bookmark().await;
    for i in 0..100 {
        let task_id = submit(&world.service, transport(&format!("r{i}"), "B03")).await.expect("admitted").task_id;
        assert_eq!(quick.changed().await.task_id, task_id);
    }
    world.shutdown.cancel();
    assert_eq!(reason(&quick.refusal().await), "SHUTTING_DOWN");
    slow.drained().await;
}

#[tokio::test(start_paused = true)]
async fn a_task_that_leaves_the_filter_is_told_once_more_and_then_no_longer() {
    let world = World::new().await;
    let running = v1::TaskFilter { states: vec![TaskState::Running as i32], ..v1::TaskFilter::default() };
    let mut watch = world.watch(Some(running), "").await;
    watch.bookmark().await;
    life(&world, "r1").await;
    let mut states = Vec::new();
    for _ in 0..4 {
        states.push(watch.changed().await.state());
    }
    assert_eq!(states, [TaskState::Running, TaskState::Running, TaskState::Running, TaskState::Stopping]);
    life(&world, "r2").await;
    assert_eq!(watch.changed().await.state(), TaskState::Running, "the end of the first is not told");
}

#[tokio::test(start_paused = true)]
async fn tasks_that_two_services_numbered_alike_are_told_each_for_itself() {
    let world = World::new().await;
    let other = World::over(world.store.clone(), world.site.clone()).await;
    let first = submit(&world.service, transport("r1", "B03")).await.expect("admitted").task_id;
    // Another process that has not heard of it yet admits this one.
    let (intake, _) = load::<TaskIntake>(&*world.store, &first).await.expect("a store").expect("a task");
    let second = format!("{first}-2");
    let twin = TaskIntake { task_id: TaskId::parse(&second).expect("an id"), ..intake };
    let mut item = StoredItem::new(Writer::Task, "wms");
    item.create(&twin, "task.admitted").create(&midshift_core::task::TaskState::born(&twin), "task.born");
    world.store.commit(vec![item]).await.remove(0).expect("applied");
    assert_eq!(world.state(&first).await.0.number, world.state(&second).await.0.number, "admitted at the same moment");
    let queued = v1::TaskFilter { states: vec![TaskState::Queued as i32], ..v1::TaskFilter::default() };
    let mut watches = [world.watch(Some(queued.clone()), "").await, other.watch(Some(queued), "").await];
    for watch in &mut watches {
        watch.bookmark().await;
    }
    world.runs(&first, 1).await;
    world.runs(&second, 1).await;
    submit(&world.service, transport("r3", "B03")).await.expect("admitted");
    for watch in &mut watches {
        let told = [watch.changed().await.task_id, watch.changed().await.task_id];
        assert_eq!(told, [first.clone(), second.clone()], "each is told as it leaves the filter");
    }
}
