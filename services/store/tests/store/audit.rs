//! The chains of the audit, the same on every engine: in the item, in commit order over all processes, and whole after whatever ends them.

use crate::support::{at, clock, database, number, one, postgres_at, put, say, site, stranger};
use midshift_core::audit::{AuditRow, Broken, Chain, Head, Mark, Note, Verified};
use midshift_core::item::{Expect, Item, RowChange, Write};
use midshift_core::rows::{Log, Seq, Table, Writer};
use midshift_core::time::Utc;
use midshift_store::{CommitError, Cursor, Query, SqliteStore, Store};
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
    a_row_of_the_audit_is_there_with_its_item_or_not_at_all
    rows_of_one_call_and_of_many_are_one_chain
    nobody_writes_an_audit_but_by_a_note
    a_note_alone_is_kept_and_says_nothing_to_the_feed
    an_anchor_quotes_the_others_as_they_are_when_it_is_committed
    what_is_cut_is_a_beginning_and_the_rest_holds
    who_writes_at_the_same_moment_is_in_one_chain
    admissions_that_come_together_share_rows_and_none_is_left_out
}

fn noted(writer: Writer, action: &'static str, rows: Vec<RowChange>) -> Item {
    let mut item = Item { rows, ..Item::new(writer, "anna") };
    item.audit(Note::new(action).about("robot", "r1").because("it is \"time\""));
    item
}

/// An item with a row of its own.
fn decision(id: &str) -> Item {
    noted(Writer::Fleet, "robot.cordon", vec![put(Table::RobotControl, id, Expect::Absent, "{}")])
}

async fn commit(store: &dyn Store, items: Vec<Item>) -> Vec<bool> {
    store.commit(items).await.iter().map(Result::is_ok).collect()
}

/// The chain as it is read page by page, held against what the store noted of it.
async fn verify(store: &dyn Store, writer: Writer) -> Result<Verified, Broken> {
    let (table, service) = (Table::audit_of(writer).unwrap(), writer.as_str());
    let head = store.audit_heads().await.unwrap().remove(&writer).unwrap_or_default();
    let noted = Mark { service: service.to_owned(), head, by: "the store".to_owned(), at_unix_ms: None };
    let mut chain = Chain::new(service, [noted], Utc(i64::MAX));
    let mut after = None;
    loop {
        let page = store.list(Query { after, limit: 100, ..Query::all(table) }).await.unwrap();
        let Some(last) = page.last() else { return chain.finish() };
        after = Some(Cursor::of_row(last));
        for row in &page {
            chain.take_row(row)?;
        }
    }
}

async fn holds(store: &dyn Store, writer: Writer) -> (u64, u64) {
    let held = verify(store, writer).await.unwrap();
    (held.first, held.rows)
}

async fn a_row_of_the_audit_is_there_with_its_item_or_not_at_all(store: Arc<dyn Store>) {
    let stale = noted(Writer::Fleet, "robot.drain", vec![put(Table::RobotControl, "r1", at(7), "{}")]);
    assert_eq!(commit(&*store, vec![decision("r1"), stale, decision("r2")]).await, [true, false, true]);
    assert_eq!(holds(&*store, Writer::Fleet).await, (1, 2));
    let rows = store.list(Query::all(Table::FleetAudit)).await.unwrap();
    assert!(rows.iter().all(|row| row.body.contains("robot.cordon") && row.body.contains("anna")), "{rows:?}");
}

async fn rows_of_one_call_and_of_many_are_one_chain(store: Arc<dyn Store>) {
    for call in 0..3 {
        let items = (0..400).map(|n| decision(&format!("r{call}-{n}"))).collect();
        assert!(commit(&*store, items).await.iter().all(|applied| *applied));
    }
    assert_eq!(holds(&*store, Writer::Fleet).await, (1, 1_200));
    assert_eq!(holds(&*store, Writer::Task).await, (0, 0), "each service has its own");
}

async fn nobody_writes_an_audit_but_by_a_note(store: Arc<dyn Store>) {
    assert_eq!(commit(&*store, vec![decision("r1")]).await, [true]);
    let row = store.list(Query::all(Table::FleetAudit)).await.unwrap().remove(0);
    let change = |write, expect| RowChange { key: row.key.clone(), expect, write, kind: "x" };
    let put = || Write::Put { index: row.index.clone(), body: row.body.clone() };
    for change in [change(put(), at(1)), change(Write::Delete, at(1)), change(Write::Keep, at(1))] {
        let refused = one(&*store, Writer::Fleet, vec![change]).await;
        assert!(matches!(refused, Err(CommitError::NotTheWriter { owned: "fleet_audit", .. })), "{refused:?}");
    }
    let foreign = store.commit(vec![noted(Writer::Telemetry, "x", Vec::new())]).await.remove(0);
    assert!(matches!(foreign, Err(CommitError::NotTheWriter { .. })), "it has no audit: {foreign:?}");
    assert_eq!(holds(&*store, Writer::Fleet).await, (1, 1));
}

async fn a_note_alone_is_kept_and_says_nothing_to_the_feed(store: Arc<dyn Store>) {
    let before = store.snapshot(&[]).await.unwrap().seq;
    assert_eq!(commit(&*store, vec![noted(Writer::Ota, "rollout.start", Vec::new())]).await, [true]);
    assert_eq!(commit(&*store, vec![decision("r1")]).await, [true]);
    let page = store.feed(Seq(0), &Log::ALL, 100).await.unwrap();
    assert_eq!((page.entries.len(), page.head), (1, Seq(before.0 + 1)), "a decision has the entries of its rows");
    assert_eq!((holds(&*store, Writer::Ota).await, holds(&*store, Writer::Fleet).await), ((1, 1), (1, 1)));
}

async fn an_anchor_quotes_the_others_as_they_are_when_it_is_committed(store: Arc<dyn Store>) {
    let mut anchor = Item::new(Writer::Task, "task");
    anchor.audit(Note::anchor());
    let items = vec![decision("r1"), decision("r2"), anchor.clone(), decision("r3"), anchor];
    assert_eq!(commit(&*store, items).await, [true; 5]);
    let anchors = store.list(Query::all(Table::TaskAudit)).await.unwrap();
    let quoted =
        |i: usize| Mark::in_line(&anchors[i].body).into_iter().map(|m| (m.service, m.head)).collect::<Vec<_>>();
    let fleet = store.list(Query::all(Table::FleetAudit)).await.unwrap();
    let head =
        |n: usize| Head { n: n as u64, hash: midshift_core::audit::open(&fleet[n - 1].body).unwrap().hash.to_owned() };
    assert_eq!(quoted(0), [("fleet".to_owned(), head(2))], "the row before it in the same call");
    assert_eq!(quoted(1), [("fleet".to_owned(), head(3))]);
    assert_eq!(store.audit_heads().await.unwrap()[&Writer::Fleet], head(3));
}

async fn what_is_cut_is_a_beginning_and_the_rest_holds(store: Arc<dyn Store>) {
    commit(&*store, (0..10).map(|n| decision(&format!("r{n}"))).collect()).await;
    let rows = store.list(Query::all(Table::FleetAudit)).await.unwrap();
    let head = Head { n: 6, hash: midshift_core::audit::open(&rows[5].body).unwrap().hash.to_owned() };
    let mut cut = Item::new(Writer::Fleet, "fleet");
    cut.audit(Note::cut(head));
    assert_eq!(commit(&*store, vec![cut, decision("later")]).await, [true, true]);
    assert_eq!(holds(&*store, Writer::Fleet).await, (7, 6));
    assert_eq!(commit(&*store, vec![decision("latest")]).await, [true]);
    assert_eq!(holds(&*store, Writer::Fleet).await, (7, 7));
}

async fn who_writes_at_the_same_moment_is_in_one_chain(store: Arc<dyn Store>) {
    let mut tasks = tokio::task::JoinSet::new();
    for writer in 0..16 {
        let store = store.clone();
        tasks.spawn(async move { commit(&*store, (0..8).map(|n| decision(&format!("{writer}-{n}"))).collect()).await });
    }
    assert!(tasks.join_all().await.into_iter().flatten().all(|applied| applied));
    assert_eq!(holds(&*store, Writer::Fleet).await, (1, 128));
}

async fn admissions_that_come_together_share_rows_and_none_is_left_out(store: Arc<dyn Store>) {
    let admission = |n: usize, actor: &str| {
        let mut item = Item::new(Writer::Task, actor);
        item.rows.push(put(Table::TaskIntake, &format!("T{n}"), Expect::Absent, "{}"));
        item.request_id = Some(format!("q{n}").into());
        item.audit(Note::new("task.submit").about("task", format!("T{n}")).with("sha256", format!("{n:064}")).shared());
        item
    };
    // One that is there already, and one of somebody else in the middle.
    let actor = |n| if n == 100 { "bert" } else { "anna" };
    let items: Vec<Item> = (0..200).chain([7]).map(|n| admission(n, actor(n))).collect();
    assert_eq!(commit(&*store, items).await.iter().filter(|applied| **applied).count(), 200);
    holds(&*store, Writer::Task).await;
    let rows = store.list(Query::all(Table::TaskAudit)).await.unwrap();
    assert!(rows.len() >= 3 && rows.len() < 100, "{} rows", rows.len());
    let read: Vec<AuditRow> = rows.iter().map(|row| serde_json::from_str(&row.body).unwrap()).collect();
    let mut told = 0;
    for row in &read {
        let (digests, requests) = (row.with["sha256"].split(' '), row.request_id.split(' '));
        for ((about, digest), request) in row.about.iter().zip(digests).zip(requests) {
            assert_eq!((about.as_str(), request), (&*format!("task:T{told}"), &*format!("q{told}")));
            assert_eq!((digest, row.actor.as_str()), (&*format!("{told:064}"), actor(told)));
            told += 1;
        }
    }
    assert_eq!(told, 200, "in their order, each once");
}

#[tokio::test]
async fn two_processes_on_one_database_write_one_chain() {
    let config = database().await;
    let stores = [Arc::new(postgres_at(&config).await), Arc::new(postgres_at(&config).await)];
    let mut tasks = tokio::task::JoinSet::new();
    for (process, store) in stores.iter().enumerate() {
        for n in 0..40 {
            let (store, id) = (store.clone(), format!("{process}-{n}"));
            tasks.spawn(async move { commit(&*store, vec![decision(&id), decision(&format!("{id}b"))]).await });
        }
    }
    assert!(tasks.join_all().await.into_iter().flatten().all(|applied| applied));
    for store in stores {
        assert_eq!(holds(&*store, Writer::Fleet).await, (1, 160));
    }
}

#[tokio::test]
async fn a_chain_goes_on_where_a_process_left_it_without_a_word() {
    let config = database().await;
    let first = postgres_at(&config).await;
    assert_eq!(commit(&first, vec![decision("r1")]).await, [true]);
    drop(first);
    let second = postgres_at(&config).await;
    assert_eq!(commit(&second, vec![decision("r2")]).await, [true]);
    assert_eq!(holds(&second, Writer::Fleet).await, (1, 2));
    let dir = tempfile::tempdir().unwrap();
    for n in 1..4 {
        let store = SqliteStore::open(dir.path(), site(), clock()).await.unwrap();
        assert_eq!(commit(&store, vec![decision(&format!("r{n}"))]).await, [true]);
        assert_eq!(holds(&store, Writer::Fleet).await, (1, n));
        store.close().await;
    }
}

#[tokio::test]
async fn whatever_is_taken_from_the_database_nothing_that_is_left_is_written_over_and_it_shows() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let mut stranger = stranger(&config).await;
    commit(&store, (0..4).map(|n| decision(&format!("r{n}"))).collect()).await;
    // The note of the newest row goes: the next one stands behind the last that is there.
    say(&mut stranger, "DELETE FROM audit_head").await;
    assert_eq!(commit(&store, vec![decision("r5")]).await, [true]);
    assert_eq!(holds(&store, Writer::Fleet).await, (1, 5));
    say(&mut stranger, "UPDATE audit_head SET n = 2").await;
    assert_eq!(commit(&store, vec![decision("r6")]).await, [true]);
    assert_eq!(holds(&store, Writer::Fleet).await, (1, 6));
    // The newest row goes: before and after the next one it is missed.
    say(&mut stranger, "DELETE FROM fleet_audit WHERE ord = 6").await;
    assert!(matches!(verify(&store, Writer::Fleet).await, Err(Broken::Truncated { last: 5, known: 6, .. })));
    assert_eq!(commit(&store, vec![decision("r7")]).await, [true]);
    assert_eq!(verify(&store, Writer::Fleet).await, Err(Broken::Order { expected: 6, found: 7 }));
    assert_eq!(number(&mut stranger, "SELECT COUNT(*) FROM fleet_audit").await, 6);
}
