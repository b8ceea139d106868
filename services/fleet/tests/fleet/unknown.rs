//! Rows with a value of a newer version: left as they are, not acted on, explained; everything else goes on.

use crate::explain::why;
use crate::harness::World;
use midshift_core::item::{Expect, Item, RowChange, Write};
use midshift_core::reason::Code;
use midshift_core::rows::{Index, Key, Table, Writer};
use midshift_core::site::CORRIDOR;
use midshift_core::task::Phase;
use midshift_proto::access::local;
use midshift_proto::fleet::v1;
use midshift_proto::fleet::v1::fleet_service_server::FleetService;
use midshift_proto::refusal_of;

/// A newer version writes `new` for `old` into a row; its state becomes one that no build here lists.
pub async fn rewritten(w: &World, table: Table, id: &str, (old, new): (&str, &str), state: Option<i64>) {
    let row = w.store.get(vec![Key::new(table, id)]).await.expect("a store").pop().expect("the row");
    assert!(row.body.contains(old), "{}", row.body);
    let mut index = row.index.clone();
    index.state = state.or(index.state);
    let write = Write::Put { index, body: row.body.replace(old, new).into() };
    let mut item = Item::new(Writer::Fleet, "tests");
    item.rows.push(RowChange { key: row.key, expect: Expect::At(row.revision), write, kind: "tests.rewritten" });
    w.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
}

async fn body(w: &World, table: Table, id: &str) -> String {
    w.store.get(vec![Key::new(table, id)]).await.expect("a store").pop().expect("the row").body.to_string()
}

const QUEUED: &str = "\"phase\":\"queued\"";
const FLOATING: &str = "\"phase\":\"floating\"";

#[tokio::test(start_paused = true)]
async fn a_task_in_a_state_of_a_newer_version_is_left_as_it_is_and_explained_and_the_others_go_on() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("T1", "A", "B").await;
    w.pass(1).await;
    rewritten(&w, Table::TaskState, "T1", (QUEUED, FLOATING), Some(99)).await;
    let kept = body(&w, Table::TaskState, "T1").await;
    w.robot("r1", "park-a").await;
    w.submit("T2", "A", "B").await;
    w.pass(120).await;
    for is_restarted in [false, true] {
        if is_restarted {
            w.stop_fleet().await;
            w.start_fleet();
            w.pass(60).await;
        }
        assert_eq!(why(&w, "T1").await.0, "ROW_UNKNOWN", "restarted: {is_restarted}");
        assert_eq!(body(&w, Table::TaskState, "T1").await, kept, "restarted: {is_restarted}");
        assert!(body(&w, Table::TaskState, "T2").await.contains("succeeded"), "restarted: {is_restarted}");
    }
    rewritten(&w, Table::TaskState, "T1", (FLOATING, QUEUED), Some(Phase::Queued.number())).await;
    w.stop_fleet().await;
    w.start_fleet();
    w.until_phase("T1", Phase::Succeeded).await;
}

#[tokio::test(start_paused = true)]
async fn a_command_about_a_row_of_a_newer_version_is_refused_with_the_row_and_leaves_it_as_it_is() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    let cordon = || v1::CordonRobotRequest { robot_id: "r1".into(), reason: "look".into(), ..Default::default() };
    w.fleet.cordon_robot(local(cordon())).await.expect("cordoned");
    rewritten(&w, Table::RobotControl, "r1", ("\"robot_id\":\"r1\"", "\"robot_id\":7"), None).await;
    let kept = body(&w, Table::RobotControl, "r1").await;
    w.pass(2).await;
    let uncordon = v1::UncordonRobotRequest { robot_id: "r1".into(), ..Default::default() };
    let refused = w.fleet.uncordon_robot(local(uncordon)).await.expect_err("nobody may change it");
    assert_eq!(refusal_of(&refused).code, Some(Code::RowUnknown), "{refused}");
    assert_eq!(body(&w, Table::RobotControl, "r1").await, kept);
}

#[tokio::test(start_paused = true)]
async fn a_robot_with_a_row_of_a_newer_version_gets_no_work_and_says_which_row_and_value() {
    let mut w = World::on(CORRIDOR).await;
    w.robot("r1", "park-a").await;
    w.pass(2).await;
    rewritten(&w, Table::RobotAuthority, "r1", ("\"none\"", "\"adrift\""), None).await;
    let kept = body(&w, Table::RobotAuthority, "r1").await;
    w.submit("T1", "A", "B").await;
    w.pass(30).await;
    assert_eq!(w.seen().await.phase("T1"), Phase::Queued);
    let ask = v1::ExplainRobotRequest { robot_id: "r1".into() };
    let told = w.fleet.explain_robot(local(ask)).await.expect("an explanation").into_inner();
    let why = told.explanation.and_then(|e| e.verdict).expect("a reason");
    assert_eq!((why.code.as_str(), why.metadata["row"].as_str()), ("ROW_UNKNOWN", "robot_authority/r1"));
    assert_eq!(why.metadata["value"], "unknown variant `adrift`");
    assert_eq!(w.seen().await.open_incidents("ROW_UNKNOWN").len(), 1);
    assert_eq!(body(&w, Table::RobotAuthority, "r1").await, kept);
    rewritten(&w, Table::RobotAuthority, "r1", ("\"adrift\"", "\"none\""), None).await;
    w.until_phase("T1", Phase::Succeeded).await;
}

#[tokio::test(start_paused = true)]
async fn a_presence_of_a_newer_version_keeps_no_robot_from_work() {
    let mut w = World::on(CORRIDOR).await;
    let body = r#"{"robot_id":"r1","presence":"dreaming","since_unix_ms":1}"#;
    let write = Write::Put { index: Index::default(), body: body.into() };
    let key = Key::new(Table::Presence, "r1");
    let mut item = Item::new(Writer::Telemetry, "tests");
    item.rows.push(RowChange { key, expect: Expect::Absent, write, kind: "tests.written" });
    w.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    w.robot("r1", "park-a").await;
    w.submit("T1", "A", "B").await;
    w.until_phase("T1", Phase::Succeeded).await;
}

#[tokio::test(start_paused = true)]
async fn a_task_of_which_a_newer_version_asks_something_is_left_alone_and_a_person_is_told() {
    let mut w = World::on(CORRIDOR).await;
    w.submit("T1", "A", "B").await;
    w.submit("T2", "A", "B").await;
    w.pass(1).await;
    let body = r#"{"id":"q1","ask":{"lend":{"task_id":"T1"}},"reason":"wait","actor":"anna","at_unix_ms":1}"#;
    let write = Write::Put { index: Index::default(), body: body.into() };
    let mut item = Item::new(Writer::Task, "tests");
    let key = Key::new(Table::TaskRequest, "q1");
    item.rows.push(RowChange { key, expect: Expect::Absent, write, kind: "task.hold_requested" });
    w.store.commit(vec![item]).await.pop().expect("a result").expect("applied");
    w.pass(1).await;
    w.robot("r1", "park-a").await;
    w.until_phase("T2", Phase::Succeeded).await;
    assert_eq!(w.seen().await.phase("T1"), Phase::Queued);
    assert_eq!(why(&w, "T1").await.0, "ROW_UNKNOWN");
    assert_eq!(w.seen().await.open_incidents("ROW_UNKNOWN").len(), 1);
}
