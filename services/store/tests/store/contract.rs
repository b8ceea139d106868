//! The contract of a store, the same for every engine.

use crate::support::{WALL, at, indexed, item, one, put};
use midshift_core::item::{Expect, Fact, Item, RowChange, Write};
use midshift_core::rows::{Index, Key, Log, Naming, Revision, Row, RowSelection, Seq, Table, Writer};
use midshift_store::{CommitError, Cursor, Error, Query, Retention, Store, Subjects};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Runs each case on each engine.
macro_rules! contract {
    ($($case:ident)*) => {
        mod memory { $(#[tokio::test] async fn $case() { let b = crate::support::memory(); super::$case(b.store.clone()).await; })* }
        mod sqlite { $(#[tokio::test] async fn $case() { let b = crate::support::sqlite().await; super::$case(b.store.clone()).await; })* }
        mod postgres { $(#[tokio::test] async fn $case() { let b = crate::support::postgres().await; super::$case(b.store.clone()).await; })* }
    };
}

contract! {
    two_grants_of_one_place_from_one_snapshot_cannot_both_win
    a_chain_of_items_in_one_call_builds_on_itself
    a_conflict_in_a_chain_fails_what_depends_on_it_and_nothing_else
    an_item_is_applied_whole_or_not_at_all
    a_feed_page_that_ends_inside_a_commit_loses_nothing
    a_feed_merges_logs_in_commit_order
    a_feed_of_subjects_holds_theirs_alone
    a_cursor_ahead_of_the_store_has_expired
    a_service_cannot_write_what_another_one_owns
    a_task_state_is_born_with_its_intake_and_then_belongs_to_fleet
    a_kept_row_guards_and_stays_as_it_is
    a_deleted_row_is_gone_and_its_entry_says_so
    an_item_over_its_limit_or_with_a_row_twice_is_refused
    a_list_pages_through_every_row_once_in_both_directions
    a_list_filters_by_state_and_parent_as_they_are_now
    a_row_that_moves_in_one_index_alone_is_found_where_it_is
    a_reading_holds_its_parts_and_what_they_name_and_nothing_else
    a_reading_holds_rows_by_key_and_what_belongs_to_each_that_it_holds
    a_prefix_lists_by_id_the_rows_that_begin_with_it
    a_submit_between_snapshot_and_commit_does_not_spoil_the_plan
    a_mark_leaves_an_entry_where_nothing_else_does
    concurrent_writers_all_make_progress_and_numbers_have_no_holes
    a_row_reads_back_as_written_in_every_table
    entries_say_who_did_what_and_on_whose_request
    a_raised_head_is_never_lowered
    pruning_takes_old_entries_but_never_past_the_slowest_consumer
    a_wake_shows_the_newest_number
    many_rows_of_one_call_are_all_there
    ids_are_ordered_by_their_bytes
    a_text_that_an_engine_cannot_hold_is_refused_by_all
}

async fn two_grants_of_one_place_from_one_snapshot_cannot_both_win(store: Arc<dyn Store>) {
    one(&*store, Writer::Fleet, vec![put(Table::PlaceGrant, "dock", Expect::Absent, "{}")]).await.unwrap();
    let grant = |robot: &str| {
        let held = put(Table::PlaceGrant, "dock", at(1), &format!("{{\"holder\":\"{robot}\"}}"));
        item(Writer::Fleet, vec![held, put(Table::DesiredWork, robot, Expect::Absent, "{}")])
    };
    let results = store.commit(vec![grant("r1"), grant("r2")]).await;
    assert!(results[0].is_ok());
    let lost = results[1].as_ref().unwrap_err();
    assert!(matches!(lost, CommitError::Conflict { found: Some(Revision(2)), .. }), "{lost}");
    assert!(store.get(vec![Key::new(Table::DesiredWork, "r2")]).await.unwrap().is_empty());
}

async fn a_chain_of_items_in_one_call_builds_on_itself(store: Arc<dyn Store>) {
    let step = |expect, body: &str| item(Writer::Fleet, vec![put(Table::RobotControl, "r1", expect, body)]);
    let results = store.commit(vec![step(Expect::Absent, "1"), step(at(1), "2"), step(at(2), "3")]).await;
    assert!(results.iter().all(Result::is_ok), "{results:?}");
    let rows = store.get(vec![Key::new(Table::RobotControl, "r1")]).await.unwrap();
    assert_eq!((rows[0].revision, &*rows[0].body), (Revision(3), "3"));
    let page = store.feed(Seq(0), &[Log::Fleet], 10).await.unwrap();
    let bodies: Vec<_> = page.entries.iter().map(|e| e.body.as_deref().unwrap()).collect();
    assert_eq!(bodies, ["1", "2", "3"], "every link of the chain is in the log");
}

async fn a_conflict_in_a_chain_fails_what_depends_on_it_and_nothing_else(store: Arc<dyn Store>) {
    let step = |robot: &str, expect| item(Writer::Fleet, vec![put(Table::RobotControl, robot, expect, "{}")]);
    let chain = vec![
        step("r1", Expect::Absent),
        step("r1", at(7)),
        step("r1", at(2)),
        step("r2", Expect::Absent),
        step("r1", at(1)),
    ];
    let applied: Vec<bool> = store.commit(chain).await.iter().map(Result::is_ok).collect();
    assert_eq!(applied, [true, false, false, true, true]);
}

async fn an_item_is_applied_whole_or_not_at_all(store: Arc<dyn Store>) {
    let mut broken = item(
        Writer::Fleet,
        vec![put(Table::Attempt, "a", Expect::Absent, "{}"), put(Table::RobotAuthority, "r1", at(1), "{}")],
    );
    broken.facts.clear();
    let before = store.snapshot(Table::ALL).await.unwrap();
    assert!(store.commit(vec![broken]).await[0].is_err());
    assert_eq!(store.snapshot(Table::ALL).await.unwrap(), before);
}

async fn a_feed_page_that_ends_inside_a_commit_loses_nothing(store: Arc<dyn Store>) {
    let rows = (0..5).map(|n| put(Table::Attempt, &format!("a{n}"), Expect::Absent, "{}")).collect();
    one(&*store, Writer::Fleet, rows).await.unwrap();
    let (mut after, mut seen) = (Seq(0), Vec::new());
    loop {
        let page = store.feed(after, &[Log::Fleet], 2).await.unwrap();
        assert!(page.entries.len() <= 2);
        seen.extend(page.entries.iter().map(|e| e.subject.to_string()));
        after = page.next;
        if page.next == page.head {
            break;
        }
    }
    assert_eq!(seen, ["a0", "a1", "a2", "a3", "a4"]);
}

async fn a_feed_merges_logs_in_commit_order(store: Arc<dyn Store>) {
    for n in 0..4 {
        one(&*store, Writer::Fleet, vec![put(Table::Attempt, &n.to_string(), Expect::Absent, "{}")]).await.unwrap();
        one(&*store, Writer::Telemetry, vec![put(Table::Presence, &n.to_string(), Expect::Absent, "{}")])
            .await
            .unwrap();
    }
    // From 0 the file is read, from the snapshot's number onwards memory would do: both must agree.
    let page = store.feed(Seq(0), &[Log::Telemetry, Log::Fleet, Log::Fleet], 100).await.unwrap();
    let logs: Vec<Log> = page.entries.iter().map(|e| e.log).collect();
    assert_eq!(logs, [Log::Fleet, Log::Telemetry].repeat(4));
    let first = page.entries[0].seq;
    let rest = store.feed(first, &[Log::Fleet, Log::Telemetry], 100).await.unwrap();
    assert_eq!(rest.entries, page.entries[1..]);
    assert!(store.feed(Seq(0), &[Log::Task], 100).await.unwrap().entries.is_empty());
}

async fn a_feed_of_subjects_holds_theirs_alone(store: Arc<dyn Store>) {
    let mut inbox = Item::new(Writer::Telemetry, "telemetry");
    for robot in ["r1", "r2", "r3", "r1"] {
        inbox.facts.push(Fact {
            log: Log::RobotInbox,
            subject: Arc::from(robot),
            kind: "event",
            body: Arc::from("{}"),
        });
    }
    let applied = store.commit(vec![inbox]).await.remove(0).unwrap();
    for after in [Seq(0), Seq(applied.seq.0 - 4)] {
        let of = [Arc::from("r1"), Arc::from("r3")];
        let page = store.feed_of(Subjects::Robots(&of), after, 2).await.unwrap();
        let subjects: Vec<&str> = page.entries.iter().map(|e| &*e.subject).collect();
        assert_eq!(subjects, ["r1", "r3"]);
        let rest = store.feed_of(Subjects::Robots(&of), page.next, 2).await.unwrap();
        assert_eq!((rest.entries.len(), rest.next), (1, applied.seq));
        assert!(store.feed_of(Subjects::Robots(&[]), after, 2).await.unwrap().entries.is_empty());
    }
    let start = store.snapshot(&[]).await.unwrap().seq;
    let of_fleet = [Table::Attempt, Table::Incident].map(|table| put(table, "x", Expect::Absent, "{}"));
    one(&*store, Writer::Fleet, of_fleet.to_vec()).await.unwrap();
    let of_task = [Table::RequestKey, Table::TaskIntake].map(|table| put(table, "x", Expect::Absent, "{}"));
    one(&*store, Writer::Task, of_task.to_vec()).await.unwrap();
    let of = [Arc::from("x")];
    for (of, table) in [(Subjects::Attempts(&of), Table::Attempt), (Subjects::RequestKeys(&of), Table::RequestKey)] {
        for after in [Seq(0), start] {
            let page = store.feed_of(of, after, 9).await.unwrap();
            let tables: Vec<_> = page.entries.iter().map(|entry| entry.table).collect();
            assert_eq!(tables, [Some(table)], "others of the same id are not about it");
        }
    }
}

async fn a_cursor_ahead_of_the_store_has_expired(store: Arc<dyn Store>) {
    let head = store.snapshot(&[]).await.unwrap().seq;
    assert!(head >= Seq(WALL.cast_unsigned()), "numbers start at the wall time of creation");
    let page = store.feed(Seq(head.0 + 1), &[Log::Task], 1).await;
    assert!(matches!(page, Err(Error::CursorExpired { .. })), "{page:?}");
}

async fn a_service_cannot_write_what_another_one_owns(store: Arc<dyn Store>) {
    let foreign = one(&*store, Writer::Task, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await;
    assert!(matches!(foreign, Err(CommitError::NotTheWriter { owned: "attempt", .. })), "{foreign:?}");
    let mut fact = Item::new(Writer::Fleet, "fleet");
    fact.facts.push(Fact { log: Log::RobotInbox, subject: Arc::from("r1"), kind: "event", body: Arc::from("{}") });
    let foreign = store.commit(vec![fact]).await.remove(0);
    assert!(matches!(foreign, Err(CommitError::NotTheWriter { owned: "robot_inbox", .. })), "{foreign:?}");
}

async fn a_task_state_is_born_with_its_intake_and_then_belongs_to_fleet(store: Arc<dyn Store>) {
    let state = |expect| put(Table::TaskState, "t", expect, "{}");
    assert!(one(&*store, Writer::Fleet, vec![state(Expect::Absent)]).await.is_err());
    one(&*store, Writer::Task, vec![put(Table::TaskIntake, "t", Expect::Absent, "{}"), state(Expect::Absent)])
        .await
        .unwrap();
    assert!(matches!(one(&*store, Writer::Task, vec![state(at(1))]).await, Err(CommitError::NotTheWriter { .. })));
    one(&*store, Writer::Fleet, vec![state(at(1))]).await.unwrap();
}

async fn a_kept_row_guards_and_stays_as_it_is(store: Arc<dyn Store>) {
    one(&*store, Writer::Telemetry, vec![put(Table::Presence, "r1", Expect::Absent, "{}")]).await.unwrap();
    let presence = Key::new(Table::Presence, "r1");
    let mut relying = item(Writer::Fleet, vec![put(Table::RobotAuthority, "r1", Expect::Absent, "{}")]);
    relying.keep_row(presence.clone(), at(2));
    assert!(store.commit(vec![relying.clone()]).await[0].is_err(), "the guard does not hold");
    relying.rows[1].expect = at(1);
    let applied = store.commit(vec![relying]).await.remove(0).unwrap();
    assert_eq!(applied.revisions, [(Key::new(Table::RobotAuthority, "r1"), Revision(1))]);
    assert_eq!(store.get(vec![presence]).await.unwrap()[0].revision, Revision(1));
}

async fn a_deleted_row_is_gone_and_its_entry_says_so(store: Arc<dyn Store>) {
    one(&*store, Writer::Fleet, vec![put(Table::Timer, "t", Expect::Absent, "{}")]).await.unwrap();
    let timer = Key::new(Table::Timer, "t");
    let mut gone = Item::new(Writer::Fleet, "fleet");
    gone.delete(timer.clone(), Revision(1), "timer.fired");
    store.commit(vec![gone.clone()]).await.remove(0).unwrap();
    assert!(store.get(vec![timer.clone()]).await.unwrap().is_empty());
    assert!(store.list(Query::all(Table::Timer)).await.unwrap().is_empty());
    let page = store.feed(Seq(0), &[Log::Fleet], 10).await.unwrap();
    let last = page.entries.last().unwrap();
    assert_eq!((last.revision, &last.body, &*last.kind), (Revision(2), &None, "timer.fired"));
    let again = store.commit(vec![gone]).await.remove(0);
    assert!(matches!(again, Err(CommitError::Conflict { found: None, .. })), "{again:?}");
    let absent = RowChange { key: timer, expect: Expect::Absent, write: Write::Delete, kind: "timer.fired" };
    assert!(one(&*store, Writer::Fleet, vec![absent]).await.is_err(), "there is nothing to delete");
}

async fn an_item_over_its_limit_or_with_a_row_twice_is_refused(store: Arc<dyn Store>) {
    let many = (0..257).map(|n| put(Table::Attempt, &n.to_string(), Expect::Absent, "{}")).collect();
    assert!(matches!(one(&*store, Writer::Fleet, many).await, Err(CommitError::TooLarge)));
    let huge = "x".repeat(1024 * 1024);
    let huge = vec![put(Table::Site, "s", Expect::Absent, &huge)];
    assert!(matches!(one(&*store, Writer::Fleet, huge).await, Err(CommitError::TooLarge)));
    let twice = vec![put(Table::Attempt, "a", Expect::Absent, "1"), put(Table::Attempt, "a", at(1), "2")];
    assert!(matches!(one(&*store, Writer::Fleet, twice).await, Err(CommitError::DuplicateKey { .. })));
}

async fn a_list_pages_through_every_row_once_in_both_directions(store: Arc<dyn Store>) {
    // Equal orders and rows without one: the id decides.
    let orders = [None, Some(5), Some(5), Some(-3), None, Some(9), Some(5)];
    let rows = orders.iter().enumerate().map(|(n, order)| {
        let index = Index { order: *order, ..Index::default() };
        indexed(Table::Incident, &format!("i{n}"), Expect::Absent, "{}", index)
    });
    one(&*store, Writer::Fleet, rows.collect()).await.unwrap();
    let mut expected = vec!["i0", "i4", "i3", "i1", "i2", "i6", "i5"];
    for newest_first in [false, true] {
        let (mut after, mut seen) = (None, Vec::new());
        loop {
            let query = Query { after, limit: 2, newest_first, ..Query::all(Table::Incident) };
            let page = store.list(query).await.unwrap();
            let Some(last) = page.last() else { break };
            after = Some(Cursor::of_row(last));
            seen.extend(page.iter().map(|row| row.key.id.to_string()));
        }
        assert_eq!(seen, expected);
        expected.reverse();
    }
}

async fn a_list_filters_by_state_and_parent_as_they_are_now(store: Arc<dyn Store>) {
    let row = |id: &str, expect, state, parent: &str| {
        let index = Index { state: Some(state), parent: Some(Arc::from(parent)), order: Some(state) };
        indexed(Table::Attempt, id, expect, "{}", index)
    };
    let rows =
        vec![row("a", Expect::Absent, 1, "t1"), row("b", Expect::Absent, 2, "t1"), row("c", Expect::Absent, 3, "t2")];
    one(&*store, Writer::Fleet, rows).await.unwrap();
    one(&*store, Writer::Fleet, vec![row("a", at(1), 3, "t1")]).await.unwrap();
    let ids = async |query: Query| {
        let rows = store.list(query).await.unwrap();
        rows.iter().map(|row| row.key.id.to_string()).collect::<Vec<_>>()
    };
    let all = || Query::all(Table::Attempt);
    assert_eq!(ids(all().in_states([1])).await, [""; 0]);
    assert_eq!(ids(all().in_states([3, 2, 3])).await, ["b", "a", "c"]);
    assert_eq!(ids(all().of_parent("t1")).await, ["b", "a"]);
    assert_eq!(ids(all().of_parent("t1").in_states([3])).await, ["a"]);
    assert_eq!(ids(Query { limit: 1, newest_first: true, ..all().in_states([2, 3]) }).await, ["c"]);
}

async fn a_row_that_moves_in_one_index_alone_is_found_where_it_is(store: Arc<dyn Store>) {
    let all = || Query::all(Table::Attempt);
    let mut expect = Expect::Absent;
    for (n, (state, parent, order)) in
        [(1, "p", 1), (2, "p", 1), (2, "q", 1), (2, "q", 9), (2, "q", 9), (1, "p", 1)].into_iter().enumerate()
    {
        let index = Index { state: Some(state), parent: Some(Arc::from(parent)), order: Some(order) };
        let body = n.to_string();
        one(&*store, Writer::Fleet, vec![indexed(Table::Attempt, "a", expect, &body, index.clone())]).await.unwrap();
        let row = Row {
            key: Key::new(Table::Attempt, "a"),
            revision: Revision(n as u64 + 1),
            index,
            body: body.as_str().into(),
        };
        expect = Expect::At(row.revision);
        let after = Cursor { order: order - 1, id: Arc::from("a") };
        for query in [all().in_states([state]), all().of_parent(parent), Query { after: Some(after), ..all() }] {
            assert_eq!(store.list(query.clone()).await.unwrap(), std::slice::from_ref(&row), "{query:?}");
        }
        assert_eq!(store.list(all().in_states([3 - state])).await.unwrap(), []);
        assert_eq!(store.list(all().of_parent(if parent == "p" { "q" } else { "p" })).await.unwrap(), []);
    }
}

async fn a_reading_holds_its_parts_and_what_they_name_and_nothing_else(store: Arc<dyn Store>) {
    let state = |id: &str, state, body: &str| {
        let index = Index { state: Some(state), ..Index::default() };
        indexed(Table::TaskState, id, Expect::Absent, body, index)
    };
    // The body names what is read with it: of the task the intake, and of that another task.
    let rows = vec![state("live", 1, "0"), state("over", 2, "0"), state("awaited", 2, "0"), state("live-too", 3, "0")];
    one(&*store, Writer::Task, rows).await.unwrap();
    let intake = |id: &str, body: &str| put(Table::TaskIntake, id, Expect::Absent, body);
    let rows = vec![intake("live", "\"awaited\""), intake("live-too", "\"nobody\""), intake("over", "\"over\"")];
    one(&*store, Writer::Task, rows).await.unwrap();
    one(&*store, Writer::Fleet, vec![put(Table::Site, "north", Expect::Absent, "{}")]).await.unwrap();
    let named: Naming = |rows| {
        let of = |row: &Row| match row.key.table {
            Table::TaskState if row.index.state != Some(2) => Some(Key::new(Table::TaskIntake, &row.key.id)),
            Table::TaskIntake => Some(Key::new(Table::TaskState, row.body.trim_matches('"'))),
            _ => None,
        };
        rows.iter().filter_map(of).collect()
    };
    let parts = [
        RowSelection::InStates(Table::TaskState, vec![1, 3, 7]),
        RowSelection::Whole(Table::Site),
        RowSelection::Whole(Table::Timer),
    ];
    let read = store.read(&parts, named).await.unwrap();
    let keys: Vec<(Table, &str)> = read.rows.iter().map(|row| (row.key.table, &*row.key.id)).collect();
    let task = |id| (Table::TaskState, id);
    let intakes = [(Table::TaskIntake, "live"), (Table::TaskIntake, "live-too")];
    let rest = [task("awaited"), task("live"), task("live-too"), (Table::Site, "north")];
    assert_eq!(keys, [&intakes[..], &rest[..]].concat());
    assert_eq!(read.seq, store.snapshot(&[]).await.unwrap().seq);
    let none = store.read(&[], named).await.unwrap();
    assert!(none.rows.is_empty());
}

async fn a_reading_holds_rows_by_key_and_what_belongs_to_each_that_it_holds(store: Arc<dyn Store>) {
    let in_phase = |id: &str, phase| {
        let index = Index { state: Some(phase), ..Index::default() };
        indexed(Table::Rollout, id, Expect::Absent, "{}", index)
    };
    let rows = vec![in_phase("open", 1), in_phase("over", 2), in_phase("asked", 2), in_phase("named", 2)];
    one(&*store, Writer::Ota, rows).await.unwrap();
    let of = |id: &str| {
        let index = Index { parent: id.split('/').next().map(Arc::from), ..Index::default() };
        indexed(Table::RolloutRobot, id, Expect::Absent, "{}", index)
    };
    let robots = ["open/r1", "open/r2", "over/r1", "asked/r1", "named/r1"];
    one(&*store, Writer::Ota, robots.map(of).into()).await.unwrap();
    // What belongs to a row that is read may name another, whose rows are read too.
    let named: Naming = |rows| {
        let is_first = rows.iter().any(|row| &*row.key.id == "asked/r1");
        is_first.then(|| Key::new(Table::Rollout, "named")).into_iter().collect()
    };
    let asked = RowSelection::Rows(vec![Key::new(Table::Rollout, "asked"), Key::new(Table::Rollout, "nobody")]);
    let of_parents = RowSelection::OfParents { table: Table::RolloutRobot, parents: Table::Rollout };
    let parts = [RowSelection::InStates(Table::Rollout, vec![1]), of_parents, asked];
    let read = store.read(&parts, named).await.unwrap();
    let keys: Vec<&str> = read.rows.iter().map(|row| &*row.key.id).collect();
    assert_eq!(keys, ["asked", "named", "open", "asked/r1", "named/r1", "open/r1", "open/r2"]);
}

async fn a_prefix_lists_by_id_the_rows_that_begin_with_it(store: Arc<dyn Store>) {
    // The order runs against the ids: it must not matter.
    let ids = ["T", "T-", "T-1", "T-1\u{7f}", "T-1\u{10ffff}", "T-1\u{10ffff}z", "T-2", "T.", "U", "t-1"];
    let row = |(n, id): (usize, &&str)| {
        let index = Index { state: Some(n as i64 % 2), parent: Some(Arc::from("r1")), order: Some(-(n as i64)) };
        indexed(Table::Incident, id, Expect::Absent, "{}", index)
    };
    one(&*store, Writer::Fleet, ids.iter().enumerate().map(row).collect()).await.unwrap();
    let found = async |query: Query| {
        let rows = store.list(query).await.unwrap();
        rows.iter().map(|row| row.key.id.to_string()).collect::<Vec<_>>()
    };
    let of = |prefix: &str| Query::all(Table::Incident).of_prefix(prefix);
    assert_eq!(found(of("T-1")).await, ids[2..6]);
    assert_eq!(found(of("T-1\u{10ffff}")).await, ids[4..6]);
    assert_eq!(found(of("T-2")).await, ["T-2"], "a whole id is its own prefix");
    assert_eq!(found(of("")).await, ids);
    assert_eq!(found(of("\u{10ffff}")).await, [""; 0]);
    assert_eq!(found(of("T\0")).await, [""; 0], "there is no such id, and to ask is no error");
    assert_eq!(found(of("T-1").in_states([1])).await, [ids[3], ids[5]]);
    assert_eq!(found(of("T-").in_states([0, 1]).of_parent("r1")).await, ids[1..7]);
    assert_eq!(found(of("T-").of_parent("r2")).await, [""; 0]);
    let mut expected: Vec<&str> = ids[1..7].to_vec();
    for newest_first in [false, true] {
        let (mut after, mut seen) = (None, Vec::new());
        loop {
            let page = store.list(Query { after, limit: 4, newest_first, ..of("T-") }).await.unwrap();
            let Some(last) = page.last() else { break };
            after = Some(Cursor::of_row(last));
            seen.extend(page.iter().map(|row| row.key.id.to_string()));
        }
        assert_eq!(seen, expected);
        expected.reverse();
    }
}

async fn a_submit_between_snapshot_and_commit_does_not_spoil_the_plan(store: Arc<dyn Store>) {
    let submit = |id: &str| {
        let rows = [Table::TaskIntake, Table::TaskState].map(|table| put(table, id, Expect::Absent, "{}"));
        item(Writer::Task, rows.to_vec())
    };
    store.commit(vec![submit("t1")]).await.remove(0).unwrap();
    let snapshot = store.snapshot(&[Table::TaskIntake, Table::TaskState]).await.unwrap();
    store.commit(vec![submit("t2")]).await.remove(0).unwrap();
    let state = snapshot.rows.iter().find(|row| row.key.table == Table::TaskState).unwrap();
    let mut plan = item(Writer::Fleet, vec![put(Table::TaskState, "t1", Expect::At(state.revision), "{}")]);
    plan.keep_row(Key::new(Table::TaskIntake, "t1"), at(1));
    assert!(store.commit(vec![plan]).await[0].is_ok());
}

async fn a_mark_leaves_an_entry_where_nothing_else_does(store: Arc<dyn Store>) {
    let start = store.snapshot(&[]).await.unwrap().seq;
    let mark = |expect, body| put(Table::FleetMark, "fleet", expect, body);
    let beside = vec![mark(Expect::Absent, "1"), put(Table::Attempt, "a", Expect::Absent, "{}")];
    let first = one(&*store, Writer::Fleet, beside).await.unwrap();
    assert_eq!(first.seq, Seq(start.0 + 1));
    assert_eq!(first.revisions[0], (Key::new(Table::FleetMark, "fleet"), Revision(1)));
    let second = one(&*store, Writer::Fleet, vec![mark(at(1), "2")]).await.unwrap();
    assert_eq!(second.seq, Seq(start.0 + 2), "whoever waits for it is woken");
    let page = store.feed(start, &[Log::Fleet], 10).await.unwrap();
    let told: Vec<_> = page.entries.iter().map(|entry| entry.table).collect();
    assert_eq!(told, [Some(Table::Attempt), Some(Table::FleetMark)]);
    let marks = store.get(vec![Key::new(Table::FleetMark, "fleet")]).await.unwrap();
    assert_eq!((&*marks[0].body, marks[0].revision), ("2", Revision(2)));
}

async fn concurrent_writers_all_make_progress_and_numbers_have_no_holes(store: Arc<dyn Store>) {
    const WRITERS: u64 = 16;
    const EACH: u64 = 8;
    let start = store.snapshot(&[]).await.unwrap().seq;
    let mut tasks = tokio::task::JoinSet::new();
    for writer in 0..WRITERS {
        let store = store.clone();
        tasks.spawn(async move {
            for n in 0..EACH {
                // One row of its own and one that everybody fights over.
                loop {
                    let shared = store.get(vec![Key::new(Table::ServiceClock, "shared")]).await.unwrap();
                    let expect = shared.first().map_or(Expect::Absent, |row| Expect::At(row.revision));
                    let own = put(Table::Attempt, &format!("{writer}/{n}"), Expect::Absent, "{}");
                    match one(&*store, Writer::Fleet, vec![own, put(Table::ServiceClock, "shared", expect, "{}")]).await
                    {
                        Ok(_) => break,
                        Err(CommitError::Conflict { key, .. }) => assert_eq!(key.table, Table::ServiceClock),
                        Err(other) => panic!("{other}"),
                    }
                }
            }
        });
    }
    tasks.join_all().await;
    let shared = store.get(vec![Key::new(Table::ServiceClock, "shared")]).await.unwrap();
    assert_eq!(shared[0].revision, Revision(WRITERS * EACH));
    let page = store.feed(start, &[Log::Fleet], 5_000).await.unwrap();
    let numbers: Vec<u64> = page.entries.iter().map(|e| e.seq.0).collect();
    let expected: Vec<u64> = (start.0 + 1..=start.0 + 2 * WRITERS * EACH).collect();
    assert_eq!(numbers, expected);
}

async fn a_row_reads_back_as_written_in_every_table(store: Arc<dyn Store>) {
    let index = Index { state: Some(-1), parent: Some(Arc::from("päron")), order: Some(i64::MAX) };
    // Rows of an audit are written by notes: `audit.rs`.
    let all = || Table::ALL.iter().filter(|table| !table.is_audit());
    for table in all() {
        let row = indexed(*table, "it's", Expect::Absent, "{\"a\":\"\\u0000ö\"}", index.clone());
        one(&*store, table.born_by(), vec![row]).await.unwrap();
    }
    let snapshot = store.snapshot(Table::ALL).await.unwrap();
    let tables: BTreeSet<Table> = snapshot.rows.iter().map(|row| row.key.table).collect();
    assert_eq!(tables.len(), all().count());
    for row in &snapshot.rows {
        assert_eq!((&row.index, &*row.body), (&index, "{\"a\":\"\\u0000ö\"}"));
    }
    let keys = snapshot.rows.iter().rev().map(|row| row.key.clone()).collect();
    let got = store.get(keys).await.unwrap();
    assert!(got.iter().eq(snapshot.rows.iter().rev()), "in the order asked for");
    let odd = ["a\"b", "a\\u0041", "\u{1}\u{7f}", "\u{1f916}", "007", "null", "[1]"];
    for id in odd {
        one(&*store, Writer::Fleet, vec![put(Table::Attempt, id, Expect::Absent, "{}")]).await.unwrap();
    }
    let keys = || odd.iter().chain(["7", "aA"].iter()).chain(&odd[..2]).map(|id| Key::new(Table::Attempt, *id));
    let got = store.get(keys().chain([Key::new(Table::TaskState, "it's")]).collect()).await.unwrap();
    let ids: Vec<&str> = got.iter().map(|row| &*row.key.id).collect();
    let wanted: Vec<&str> = odd.iter().chain(&odd[..2]).copied().chain(["it's"]).collect();
    assert_eq!(ids, wanted, "each as often as it was asked for, and none that is only written alike");
}

async fn entries_say_who_did_what_and_on_whose_request(store: Arc<dyn Store>) {
    let index = Index { state: Some(4), parent: Some(Arc::from("p")), order: None };
    let mut asked = item(Writer::Fleet, vec![indexed(Table::Attempt, "a", Expect::Absent, "{}", index.clone())]);
    asked.actor = Arc::from("operator");
    asked.request_id = Some(Arc::from("req-1"));
    let applied = store.commit(vec![asked]).await.remove(0).unwrap();
    for after in [Seq(0), Seq(applied.seq.0 - 1)] {
        let entry = store.feed(after, &[Log::Fleet], 10).await.unwrap().entries.remove(0);
        assert_eq!((&*entry.actor, entry.request_id.as_deref()), ("operator", Some("req-1")));
        assert_eq!((entry.seq, entry.at_unix_ms, entry.table), (applied.seq, WALL, Some(Table::Attempt)));
        assert_eq!((&*entry.kind, &entry.index, entry.body.as_deref()), ("row.put", &index, Some("{}")));
    }
}

async fn a_raised_head_is_never_lowered(store: Arc<dyn Store>) {
    let head = store.snapshot(&[]).await.unwrap().seq;
    let raised = Seq(head.0 + 1_000);
    assert_eq!(store.raise_head(raised).await.unwrap(), raised);
    assert_eq!(store.raise_head(head).await.unwrap(), raised);
    assert!(matches!(store.raise_head(Seq(u64::MAX)).await, Err(Error::ImplausibleSeq { .. })));
    let applied = one(&*store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await.unwrap();
    assert_eq!(applied.seq, Seq(raised.0 + 1));
    assert_eq!(store.feed(head, &[Log::Fleet], 10).await.unwrap().entries.len(), 1);
}

async fn pruning_takes_old_entries_but_never_past_the_slowest_consumer(store: Arc<dyn Store>) {
    let start = store.snapshot(&[]).await.unwrap().seq.0;
    for n in 0..10 {
        one(&*store, Writer::Fleet, vec![put(Table::Attempt, &n.to_string(), Expect::Absent, "{}")]).await.unwrap();
    }
    let nothing = Retention { before_unix_ms: WALL, entries_max: 100, floor: Seq(start + 10) };
    assert_eq!(store.prune(nothing).await.unwrap(), 0, "neither old nor many");
    let many = Retention { entries_max: 7, ..nothing };
    assert_eq!(store.prune(many).await.unwrap(), 3);
    let old = Retention { before_unix_ms: WALL + 1, entries_max: 100, floor: Seq(start + 5) };
    assert_eq!(store.prune(old).await.unwrap(), 2, "up to the floor");
    let expired = store.feed(Seq(0), &[Log::Fleet], 10).await;
    assert!(matches!(expired, Err(Error::CursorExpired { oldest, .. }) if oldest == Seq(start + 5)), "{expired:?}");
    assert_eq!(store.feed(Seq(start + 5), &[Log::Fleet], 10).await.unwrap().entries.len(), 5);
    assert!(store.feed(Seq(0), &[Log::Task], 10).await.is_ok(), "other logs keep their own");
}

async fn a_wake_shows_the_newest_number(store: Arc<dyn Store>) {
    let mut wake = store.wake();
    let before = *wake.borrow_and_update();
    let applied = one(&*store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{}")]).await.unwrap();
    wake.changed().await.unwrap();
    assert!(applied.seq > before);
    assert_eq!(*wake.borrow(), applied.seq);
}

async fn many_rows_of_one_call_are_all_there(store: Arc<dyn Store>) {
    let items = (0..2_300).map(|n| {
        let index = Index { order: Some(n), ..Index::default() };
        item(Writer::Fleet, vec![indexed(Table::Attempt, &format!("a{n:04}"), Expect::Absent, "{}", index)])
    });
    let results = store.commit(items.collect()).await;
    assert!(results.iter().all(Result::is_ok));
    assert_eq!(store.snapshot(&[Table::Attempt]).await.unwrap().rows.len(), 2_300);
    assert_eq!(store.list(Query { limit: 5_000, ..Query::all(Table::Attempt) }).await.unwrap().len(), 1_000);
    let removal = |n: u64| {
        let mut gone = Item::new(Writer::Fleet, "fleet");
        gone.delete(Key::new(Table::Attempt, format!("a{n:04}")), Revision(1), "gone");
        gone
    };
    let results = store.commit((0..1_300).map(removal).collect()).await;
    assert!(results.iter().all(Result::is_ok));
    assert_eq!(store.list(Query::all(Table::Attempt)).await.unwrap().len(), 1_000);
}

async fn ids_are_ordered_by_their_bytes(store: Arc<dyn Store>) {
    let mut ids = ["a", "B", "b", "A", "_", "-", "ä", "a-1", "a1", "Z/9", "z"];
    let rows = ids.iter().map(|id| put(Table::Incident, id, Expect::Absent, "{}"));
    one(&*store, Writer::Fleet, rows.collect()).await.unwrap();
    ids.sort_unstable();
    let listed = store.list(Query::all(Table::Incident)).await.unwrap();
    let snapshot = store.snapshot(&[Table::Incident]).await.unwrap();
    for rows in [listed, snapshot.rows] {
        let read: Vec<&str> = rows.iter().map(|row| &*row.key.id).collect();
        assert_eq!(read, ids);
    }
    let after = Some(Cursor { order: i64::MIN, id: Arc::from("B") });
    let rest = store.list(Query { after, ..Query::all(Table::Incident) }).await.unwrap();
    assert_eq!(rest[0].key.id.as_ref(), "Z/9");
}

async fn a_text_that_an_engine_cannot_hold_is_refused_by_all(store: Arc<dyn Store>) {
    let good = item(Writer::Fleet, vec![put(Table::Attempt, "good", Expect::Absent, "{}")]);
    let mut bad: Vec<Item> = Vec::new();
    bad.push(item(Writer::Fleet, vec![put(Table::Attempt, "a\0", Expect::Absent, "{}")]));
    bad.push(item(Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "{\0}")]));
    let index = Index { parent: Some(Arc::from("\0")), ..Index::default() };
    bad.push(item(Writer::Fleet, vec![indexed(Table::Attempt, "a", Expect::Absent, "{}", index)]));
    bad.push(Item { actor: Arc::from("o\0"), ..good.clone() });
    bad.push(Item { request_id: Some(Arc::from("\0r")), ..good.clone() });
    let count = bad.len();
    bad.push(good);
    let results = store.commit(bad).await;
    assert!(results[..count].iter().all(|r| matches!(r, Err(CommitError::NulByte))), "{results:?}");
    assert!(results[count].is_ok(), "what it was committed with is not spoilt");
    let long = put(Table::Attempt, &"x".repeat(1_025), Expect::Absent, "{}");
    assert!(matches!(one(&*store, Writer::Fleet, vec![long]).await, Err(CommitError::TooLarge)));
    let longest = "ö".repeat(512);
    let index = Index { parent: Some(Arc::from(longest.as_str())), ..Index::default() };
    one(&*store, Writer::Fleet, vec![indexed(Table::Attempt, &longest, Expect::Absent, "{}", index)]).await.unwrap();
    let nul = Key::new(Table::Attempt, "\0");
    assert!(store.get(vec![nul]).await.unwrap().is_empty(), "there is no such row, and to ask is no error");
    assert!(store.list(Query::all(Table::Attempt).of_parent("\0")).await.unwrap().is_empty());
    assert!(store.feed_of(Subjects::Attempts(&[Arc::from("\0")]), Seq(0), 9).await.unwrap().entries.is_empty());
}
