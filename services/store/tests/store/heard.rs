//! The log of newest heartbeats: one contract over its engines, and what relies on a robot's silence.

use crate::support::{
    Bench, clock, database, item, memory, postgres_at, put, say, site, stranger, until_a_writer_waits,
};
use midshift_core::heartbeat::{ClockOffset, NewestHeartbeat};
use midshift_core::ids::RobotId;
use midshift_core::item::{Expect, Item, Silent};
use midshift_core::robot::ReportedState;
use midshift_core::rows::{Seq, Table, Writer};
use midshift_store::{
    Applied, CommitError, HeartbeatLog, LiveBoard, MemoryHeartbeats, PostgresHeartbeats, PostgresStore, Store,
    StoredHeartbeat, follow_heartbeats,
};
use std::sync::Arc;
use std::time::Duration;

const OFFSET: ClockOffset = ClockOffset { clock_offset_ms: 3, clock_error_ms: 1 };

fn robot(id: &str) -> RobotId {
    RobotId::parse(id).expect("a robot id")
}

fn heard(id: &str, session_epoch: u64, hb: u64) -> StoredHeartbeat {
    StoredHeartbeat { robot_id: robot(id), session_epoch, hb, body: Arc::from(format!("{session_epoch}.{hb}")) }
}

async fn contract(store: Arc<dyn Store>, log: &dyn HeartbeatLog) {
    assert_eq!(log.position().await.unwrap(), 0);
    assert_eq!(log.read(0).await.unwrap(), (Vec::new(), 0));
    let kept = log.save_newest(vec![heard("a", 2, 1), heard("b", 1, 7)]).await.unwrap();
    assert_eq!(kept.fenced, []);
    let first = log.position().await.unwrap();
    let (mut all, read) = log.read(0).await.unwrap();
    all.sort_by(|a, b| a.robot_id.cmp(&b.robot_id));
    assert_eq!((all, read), (vec![heard("a", 2, 1), heard("b", 1, 7)], first));
    assert_eq!(log.read(read).await.unwrap(), (Vec::new(), read));
    // Of an older session nothing is kept; others of the batch are.
    let kept = log.save_newest(vec![heard("a", 1, 99), heard("b", 1, 8)]).await.unwrap();
    assert_eq!(kept.fenced, [robot("a")]);
    let (newer, read) = log.read(read).await.unwrap();
    assert_eq!(newer, [heard("b", 1, 8)]);
    // Whoever was away sees each robot once, with its newest.
    log.save_newest(vec![heard("a", 2, 2)]).await.unwrap();
    log.save_newest(vec![heard("a", 3, 1)]).await.unwrap();
    assert_eq!(log.read(read).await.unwrap().0, [heard("a", 3, 1)]);
    // What was decided before is up to the head that it tells.
    let decided = store.commit(vec![item(Writer::Fleet, vec![put(Table::Attempt, "x", Expect::Absent, "{}")])]).await;
    let kept = log.save_newest(vec![heard("a", 3, 2)]).await.unwrap();
    assert_eq!(kept.head, decided[0].as_ref().unwrap().seq);
}

#[tokio::test]
async fn in_memory_newest_heartbeats_are_kept_and_read_as_the_contract_says() {
    let Bench { store, .. } = memory();
    contract(store.clone(), &MemoryHeartbeats::new(store)).await;
}

#[tokio::test]
async fn in_postgresql_newest_heartbeats_are_kept_and_read_as_the_contract_says() {
    let config = database().await;
    let store = Arc::new(postgres_at(&config).await);
    let log = PostgresHeartbeats::open(&config, site()).await.unwrap();
    contract(store, &log).await;
}

async fn commit(store: &PostgresStore, id: &str, robot_id: &str, position: u64) -> Result<Applied, CommitError> {
    let silent = Some(Silent { robot_id: robot(robot_id), position });
    let rows = item(Writer::Fleet, vec![put(Table::Attempt, id, Expect::Absent, "{}")]);
    store.commit(vec![Item { silent, ..rows }]).await.remove(0)
}

#[tokio::test]
async fn what_relies_on_a_robots_silence_is_not_applied_once_it_was_heard_anywhere() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let log = PostgresHeartbeats::open(&config, site()).await.unwrap();
    commit(&store, "never-heard", "a", 0).await.unwrap();
    log.save_newest(vec![heard("a", 1, 1)]).await.unwrap();
    let known = log.position().await.unwrap();
    commit(&store, "known", "a", known).await.unwrap();
    log.save_newest(vec![heard("b", 1, 1)]).await.unwrap();
    commit(&store, "another-robot", "a", known).await.unwrap();
    log.save_newest(vec![heard("a", 1, 2)]).await.unwrap();
    let refused = commit(&store, "heard", "a", known).await.expect_err("it was heard");
    assert!(matches!(refused, CommitError::Heard { robot_id } if robot_id == robot("a")));
}

#[tokio::test]
async fn a_heartbeat_that_is_being_kept_is_waited_for_by_what_relies_on_silence() {
    let config = database().await;
    let store = Arc::new(postgres_at(&config).await);
    let _log = PostgresHeartbeats::open(&config, site()).await.unwrap();
    let mut gateway = stranger(&config).await;
    say(&mut gateway, "BEGIN; UPDATE robot_last_head SET position = position + 1 WHERE site_id = 'north'").await;
    say(&mut gateway, "INSERT INTO robot_last VALUES ('north', 'a', 1, 1, 1, '')").await;
    let waiting = tokio::spawn(async move { commit(&store, "x", "a", 0).await });
    until_a_writer_waits(&mut gateway).await;
    say(&mut gateway, "COMMIT").await;
    assert!(matches!(waiting.await.unwrap(), Err(CommitError::Heard { .. })));
}

#[tokio::test]
async fn a_heartbeat_waits_for_what_relies_on_silence_and_tells_how_far_decisions_went() {
    let config = database().await;
    let store = postgres_at(&config).await;
    let log = Arc::new(PostgresHeartbeats::open(&config, site()).await.unwrap());
    let head = store.snapshot(&[]).await.unwrap().seq.0;
    let mut fleet = stranger(&config).await;
    say(&mut fleet, "BEGIN; SELECT seq FROM store_head WHERE site_id = 'north' FOR UPDATE").await;
    say(&mut fleet, "SELECT position FROM robot_last_head WHERE site_id = 'north' FOR SHARE").await;
    let keeping = log.clone();
    let waiting = tokio::spawn(async move { keeping.save_newest(vec![heard("a", 1, 1)]).await });
    until_a_writer_waits(&mut fleet).await;
    say(&mut fleet, &format!("UPDATE store_head SET seq = {}; COMMIT", head + 5)).await;
    assert_eq!(waiting.await.unwrap().unwrap().head, Seq(head + 5));
}

#[tokio::test]
async fn two_gateways_that_keep_at_once_are_read_without_a_hole() {
    const EACH: u64 = 60;
    let config = database().await;
    let _store = postgres_at(&config).await;
    let mut tasks = tokio::task::JoinSet::new();
    for gateway in ["a", "b"] {
        let log = PostgresHeartbeats::open(&config, site()).await.unwrap();
        tasks.spawn(async move {
            for hb in 1..=EACH {
                assert_eq!(log.save_newest(vec![heard(gateway, 1, hb)]).await.unwrap().fenced, []);
            }
        });
    }
    let reader = PostgresHeartbeats::open(&config, site()).await.unwrap();
    let (mut position, mut newest) = (0, std::collections::BTreeMap::new());
    while newest.values().copied().sum::<u64>() < 2 * EACH {
        let (page, read) = reader.read(position).await.unwrap();
        assert!(read >= position);
        position = read;
        newest.extend(page.into_iter().map(|one| (one.robot_id, one.hb)));
    }
    tasks.join_all().await;
}

fn live(id: &str, hb: u64) -> NewestHeartbeat {
    NewestHeartbeat {
        robot_id: robot(id),
        report: ReportedState { hb, session_epoch: 1, ..ReportedState::default() },
        processed_at: midshift_core::time::LinkTime(77),
        processed_site: midshift_core::time::SiteTime(77),
        received_unix_ms: 5,
        progress_at: midshift_core::time::SiteTime(77),
        clock: Some(OFFSET),
    }
}

#[tokio::test(start_paused = true)]
async fn what_a_gateway_keeps_comes_onto_the_boards_of_others_by_their_own_clocks() {
    let Bench { store, .. } = memory();
    let log: Arc<dyn HeartbeatLog> = Arc::new(MemoryHeartbeats::new(store));
    log.save_newest(vec![StoredHeartbeat::from(&live("old", 1))]).await.unwrap();
    let board = LiveBoard::new();
    let following = tokio::spawn(follow_heartbeats(log.clone(), board.clone(), clock()));
    let mut changed = board.changed();
    while board.read_up_to() == 0 {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    log.save_newest(vec![StoredHeartbeat::from(&live("a", 4))]).await.unwrap();
    changed.changed().await.unwrap();
    let seen = board.get(&robot("a")).expect("it is on the board");
    assert_eq!((seen.report.hb, seen.received_unix_ms, seen.clock), (4, 5, Some(OFFSET)));
    assert_eq!(seen.processed_at, clock().now().link, "by the clock of whoever reads");
    assert!(board.get(&robot("old")).is_none(), "who was heard before is waited for");
    // What its own sessions put there is not replaced by what was read meanwhile.
    board.publish(&robot("a"), Arc::new(live("a", 9)));
    log.save_newest(vec![StoredHeartbeat::from(&live("a", 5)), StoredHeartbeat::from(&live("b", 1))]).await.unwrap();
    while board.get(&robot("b")).is_none() {
        changed.changed().await.unwrap();
    }
    assert_eq!(board.get(&robot("a")).expect("it stays").report.hb, 9);
    following.abort();
}
