//! Lookups in a store where far more has ended than one call may look at: what is asked for by id, by its beginning or by robot is found by
//! an index. What counts is how many rows the store hands out.

use crate::counted::Counted;
use crate::world::{Watch, World, patrol, submit};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::rows::Writer;
use midshift_core::task::{Phase, TaskIntake, TaskState};
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as _;
use midshift_proto::task::v1::{self, ListTasksRequest, TaskFilter};
use midshift_store::{Store, load};
use midshift_task::{Parts, TaskService};
use std::sync::Arc;

/// Tasks that have ended: more than one call looks at.
const ENDED: u64 = limits::LIST_ROWS_READ_MAX as u64 + 2_500;
/// Rows of one item, two a task.
const TASKS_PER_ITEM: u64 = 100;

/// An old site: the first task is the one that is looked for, and r-old is the only robot of nine of them; then come those that others did.
struct Old {
    service: TaskService,
    counted: Arc<Counted>,
    first: String,
}

impl Old {
    async fn site() -> Self {
        let world = World::new().await;
        let first = submit(&world.service, patrol("first", &[])).await.expect("admitted").task_id;
        let (intake, _) = load::<TaskIntake>(&*world.store, &first).await.expect("a store").expect("a task");
        let (state, _) = world.state(&first).await;
        for from in (1..ENDED).step_by(TASKS_PER_ITEM as usize) {
            let mut item = Item::new(Writer::Task, "task");
            for number in from + 1..=from + TASKS_PER_ITEM {
                let task_id = TaskId::parse(&format!("OLD-{number:06}")).expect("an id");
                let robot = if number <= 10 { "r-old" } else { ["r-1", "r-2"][number as usize % 2] };
                let robot_id = Some(RobotId::parse(robot).expect("an id"));
                let mut state = TaskState { task_id: task_id.clone(), number, robot_id, ..state.clone() };
                state.phase = Phase::Succeeded;
                item.create(&TaskIntake { task_id, number, ..intake.clone() }, "task.submitted");
                item.create(&state, "task.submitted");
            }
            world.store.commit(vec![item]).await.remove(0).expect("applied");
        }
        let counted = Counted::over(world.store.clone());
        let parts =
            Parts { store: counted.clone(), site: world.site.clone(), clock: world.clock(), bugs: Default::default() };
        let service = TaskService::open(parts, world.shutdown.clone()).await.expect("a store opens");
        Self { service, counted, first }
    }
    /// What `filter` finds, and how many rows the store handed out for it.
    async fn page(&self, filter: TaskFilter, size: u32, token: &str) -> (v1::ListTasksResponse, usize) {
        let request = ListTasksRequest { filter: Some(filter), page_size: size, page_token: token.to_owned() };
        self.counted.take_count();
        let page = self.service.list_tasks(local(request)).await.expect("a page").into_inner();
        (page, self.counted.take_count())
    }
}

fn ids(page: &v1::ListTasksResponse) -> Vec<&str> {
    page.tasks.iter().map(|task| task.task_id.as_str()).collect()
}

#[tokio::test]
async fn the_oldest_task_is_found_by_the_beginning_of_its_id_and_nothing_else_is_read() {
    let old = Old::site().await;
    let task_id_prefix = old.first[..8].to_owned();
    let (page, rows) = old.page(TaskFilter { task_id_prefix, ..TaskFilter::default() }, 2, "").await;
    assert_eq!((ids(&page), page.next_page_token.as_str()), (vec![old.first.as_str()], ""));
    assert!(rows <= 4, "{rows} rows");
    let task_id_prefix = "OLD-00001".to_owned();
    let filter = TaskFilter { task_id_prefix, ..TaskFilter::default() };
    let (page, rows) = old.page(filter.clone(), 8, "").await;
    assert_eq!((ids(&page)[0], page.tasks.len()), ("OLD-000019", 8));
    assert!(rows <= 4 * 10, "{rows} rows");
    let (rest, _) = old.page(filter, 8, &page.next_page_token).await;
    assert_eq!((ids(&rest), rest.next_page_token.as_str()), (vec!["OLD-000011", "OLD-000010"], ""));
}

#[tokio::test]
async fn tasks_of_a_robot_are_found_behind_any_number_of_others_and_no_page_is_empty_with_more() {
    let old = Old::site().await;
    let of = |robots: &[&str]| TaskFilter {
        robot_ids: robots.iter().map(ToString::to_string).collect(),
        ..TaskFilter::default()
    };
    let (page, rows) = old.page(of(&["r-old"]), 5, "").await;
    assert_eq!(page.tasks.iter().map(|t| t.number).collect::<Vec<_>>(), [10, 9, 8, 7, 6]);
    assert!(rows <= 4 * 9, "{rows} rows");
    let (rest, _) = old.page(of(&["r-old"]), 5, &page.next_page_token).await;
    assert_eq!(rest.tasks.iter().map(|t| t.number).collect::<Vec<_>>(), [5, 4, 3, 2]);
    assert_eq!(rest.next_page_token, "");
    let states = vec![v1::TaskState::Running.into()];
    let (none, rows) = old.page(TaskFilter { states, ..of(&["r-1"]) }, 5, "").await;
    assert_eq!(
        (none.tasks.len(), none.next_page_token.as_str(), rows),
        (0, "", 0),
        "live tasks are an index of their own"
    );
    // Several robots, page by page, are what each of them is alone, by number.
    let (mut token, mut seen) = (String::new(), Vec::new());
    loop {
        let (page, _) = old.page(of(&["r-1", "r-old", "r-none"]), 1_000, &token).await;
        seen.extend(page.tasks.iter().map(|task| task.number));
        token = page.next_page_token;
        if token.is_empty() {
            break;
        }
        assert!(!page.tasks.is_empty());
    }
    let last = 1 + (ENDED - 1).div_ceil(TASKS_PER_ITEM) * TASKS_PER_ITEM;
    let expected: Vec<u64> = (2..=last).rev().filter(|n| *n <= 10 || n % 2 == 0).collect();
    assert_eq!(seen, expected);
}

#[tokio::test]
async fn a_page_says_more_only_if_there_is_a_task_more_or_it_says_how_far_it_looked() {
    let old = Old::site().await;
    let states = vec![v1::TaskState::Queued.into()];
    let (page, _) = old.page(TaskFilter { states, ..TaskFilter::default() }, 1, "").await;
    assert_eq!((page.tasks.len(), page.next_page_token.as_str()), (1, ""), "a full page may be the last one");
    let rare = TaskFilter { external_ref: "never".to_owned(), ..TaskFilter::default() };
    let (page, _) = old.page(rare.clone(), 1, "").await;
    assert!(page.rows_read >= limits::LIST_ROWS_READ_MAX as u64 && page.rows_read < ENDED, "{}", page.rows_read);
    assert!(page.tasks.is_empty() && !page.next_page_token.is_empty());
    let (rest, _) = old.page(rare, 1, &page.next_page_token).await;
    assert!(rest.tasks.is_empty() && rest.next_page_token.is_empty());
    assert!(page.rows_read + rest.rows_read >= ENDED, "each is looked at");
}

#[tokio::test]
async fn a_watch_of_one_task_reads_that_one() {
    let old = Old::site().await;
    let filter = TaskFilter { task_ids: vec![old.first.clone()], ..TaskFilter::default() };
    old.counted.take_count();
    let request = v1::WatchTasksRequest { filter: Some(filter), cursor: String::new() };
    let stream = old.service.watch_tasks(local(request)).await.expect("a watch").into_inner();
    let mut watch = Watch::over(stream);
    let existing = watch.message().await;
    assert!(matches!(existing.item, Some(v1::watch_tasks_response::Item::Existing(task)) if task.task_id == old.first));
    watch.bookmark().await;
    let rows = old.counted.take_count();
    assert!(rows <= 8, "{rows} rows");
}

#[tokio::test]
async fn a_task_is_shown_whatever_came_after_it() {
    let old = Old::site().await;
    old.counted.take_count();
    let request = local(v1::GetTaskRequest { task_id: old.first.clone() });
    let task = old.service.get_task(request).await.expect("a task").into_inner().task.expect("always set");
    assert_eq!(task.task_id, old.first);
    let rows = old.counted.take_count();
    assert!(rows <= 3, "{rows} rows");
}

#[tokio::test]
async fn a_watch_without_a_filter_begins_with_what_is_alive_and_reads_nothing_else() {
    let old = Old::site().await;
    let first = async |filter: Option<TaskFilter>| {
        old.counted.take_count();
        let request = v1::WatchTasksRequest { filter, cursor: String::new() };
        let stream = old.service.watch_tasks(local(request)).await.expect("a watch").into_inner();
        let mut watch = Watch::over(stream);
        let mut told = Vec::new();
        while let Some(v1::watch_tasks_response::Item::Existing(task)) = watch.message().await.item {
            told.push(task.task_id);
        }
        (told, old.counted.take_count())
    };
    let (told, rows) = first(None).await;
    assert_eq!(told, [old.first.as_str()], "the only one that is alive");
    assert!(rows <= 8, "{rows} rows");
    let named = TaskFilter { task_ids: vec!["OLD-000002".into()], ..TaskFilter::default() };
    assert_eq!(first(Some(named)).await.0, ["OLD-000002"], "what is over is told where it is named");
}

#[tokio::test]
async fn a_page_of_one_reads_little_more_than_it_shows() {
    let old = Old::site().await;
    let (page, rows) = old.page(TaskFilter::default(), 1, "").await;
    assert_eq!((page.tasks.len(), page.rows_read), (1, 2));
    assert!(rows <= 8, "{rows} rows");
}

#[tokio::test]
async fn a_search_by_what_was_asked_for_reads_each_intake_once_and_of_other_tasks_nothing_else() {
    let old = Old::site().await;
    let rare = TaskFilter { external_ref: "never".to_owned(), ..TaskFilter::default() };
    let (page, rows) = old.page(rare, 1, "").await;
    assert_eq!(page.rows_read as usize, rows);
}

#[tokio::test]
async fn what_was_asked_for_is_found_whatever_stands_in_it() {
    let world = World::new().await;
    let odd = "a \"quoted\" \\ back\u{e9}\u{1f916}\tslash";
    for (request_id, text) in [("odd", odd), ("plain", "plain")] {
        let mut request = patrol(request_id, &[]);
        let Some(v1::submit_task_request::Body::Spec(spec)) = &mut request.body else { panic!("a patrol is a spec") };
        spec.external_ref = text.into();
        spec.labels.insert("line".into(), text.into());
        submit(&world.service, request).await.expect("admitted");
    }
    let found = async |filter: TaskFilter| {
        let request = ListTasksRequest { filter: Some(filter), ..ListTasksRequest::default() };
        let page = world.service.list_tasks(local(request)).await.expect("a page").into_inner();
        page.tasks.into_iter().map(|task| task.spec.expect("always set").external_ref).collect::<Vec<_>>()
    };
    let by_label = |text: &str| TaskFilter { labels: [("line".into(), text.into())].into(), ..TaskFilter::default() };
    let by_reference = |text: &str| TaskFilter { external_ref: text.into(), ..TaskFilter::default() };
    let queued = |filter| TaskFilter { states: vec![v1::TaskState::Queued.into()], ..filter };
    for text in [odd, "plain"] {
        for filter in [by_label(text), by_reference(text), queued(by_label(text)), queued(by_reference(text))] {
            assert_eq!(found(filter).await, [text]);
        }
        assert_eq!(found(TaskFilter { types: vec!["patrol".into()], ..by_label(text) }).await, [text]);
        assert_eq!(found(TaskFilter { types: vec!["other".into()], ..by_label(text) }).await, [""; 0]);
        let types = vec!["other".into(), "patrol".into()];
        assert_eq!(found(TaskFilter { types, ..TaskFilter::default() }).await.len(), 2);
        // The value of another label, and a part of a text.
        let other = TaskFilter { labels: [("row".into(), text.into())].into(), ..TaskFilter::default() };
        assert_eq!(found(other).await, [""; 0]);
        assert_eq!(found(by_reference(&text[..3])).await, [""; 0]);
    }
}
