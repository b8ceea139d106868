//! What is on disk outlives the process that wrote it, and one process at a time has it.

use crate::support::{at, clock, one, put, site};
use midshift_core::ids::{RobotId, SiteId};
use midshift_core::item::Expect;
use midshift_core::rows::{Key, Log, Revision, Seq, Table, Writer};
use midshift_store::{
    Error, Frame, FrameLog, Gap, MemoryFrames, OpenError, PostgresFrames, SqliteFrames, SqliteStore, Store,
};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use std::path::Path;
use std::sync::Arc;

async fn open(dir: &Path) -> SqliteStore {
    SqliteStore::open(dir, site(), clock()).await.unwrap()
}

#[tokio::test]
async fn a_store_that_was_dropped_without_closing_has_everything_it_acknowledged() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let id = store.id().clone();
    one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await.unwrap();
    let applied = one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", at(1), "2")]).await.unwrap();
    drop(store);
    let store = open(dir.path()).await;
    assert_eq!(store.id(), &id);
    let row = store.get(vec![Key::new(Table::Attempt, "a")]).await.unwrap().remove(0);
    assert_eq!((row.revision, &*row.body), (Revision(2), "2"));
    assert_eq!(store.feed(Seq(0), &[Log::Fleet], 10).await.unwrap().entries.len(), 2);
    let next = one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", at(2), "3")]).await.unwrap();
    assert_eq!(next.seq, Seq(applied.seq.0 + 1));
}

#[tokio::test]
async fn a_closed_store_refuses_and_can_be_opened_again() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    store.close().await;
    let refused = one(&store, Writer::Fleet, vec![put(Table::Attempt, "a", Expect::Absent, "1")]).await;
    assert!(matches!(refused, Err(midshift_store::CommitError::Unavailable(_))), "{refused:?}");
    assert!(matches!(store.snapshot(&[]).await, Err(Error::Unavailable(_))));
    open(dir.path()).await;
}

#[tokio::test]
async fn a_second_server_and_another_site_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await;
    let second = SqliteStore::open(dir.path(), site(), clock()).await;
    assert!(matches!(second, Err(OpenError::Locked { .. })));
    store.close().await;
    let other = SqliteStore::open(dir.path(), SiteId::parse("south").unwrap(), clock()).await;
    assert!(matches!(other, Err(OpenError::OtherSite { .. })));
}

#[cfg(unix)]
#[tokio::test]
async fn a_data_directory_is_made_for_its_owner_alone() {
    use std::os::unix::fs::PermissionsExt;
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    let steps = midshift_store::migrate(&data).await.unwrap();
    assert!(steps.iter().all(|file| file.from == 0 && file.to > 0), "{steps:?}");
    assert_eq!(data.metadata().unwrap().permissions().mode() & 0o777, 0o700);
    let again = midshift_store::migrate(&data).await.unwrap();
    assert!(again.iter().all(|file| file.applied.is_empty()), "{again:?}");
}

/// A frame of so many bytes that do not become fewer by compressing them.
fn frame(robot: &str, first_seq: u64, last_seq: u64, bytes: usize) -> Frame {
    let robot_id = RobotId::parse(robot).unwrap();
    let mut body = vec![0; bytes];
    StdRng::seed_from_u64(first_seq).fill_bytes(&mut body);
    Frame { robot_id, ring: Arc::from("ring"), first_seq, last_seq, bytes: body.into() }
}

fn gap(robot: &str, from_seq: u64) -> Gap {
    Gap {
        robot_id: RobotId::parse(robot).unwrap(),
        ring: Arc::from("ring"),
        lane: Arc::from("STATUS"),
        from_seq,
        to_seq: from_seq + 3,
        reason: Arc::from("thinned"),
        at_unix_ms: 5,
    }
}

async fn marks(log: &dyn FrameLog) -> Vec<(String, u64)> {
    log.marks().await.unwrap().into_iter().map(|mark| (mark.robot_id.to_string(), mark.seq)).collect()
}

async fn the_frame_contract(log: &dyn FrameLog) {
    let backwards = vec![frame("a", 1, 3, 10), frame("a", 9, 8, 10)];
    assert!(matches!(log.append(backwards).await, Err(Error::BadFrame(_))));
    assert!(marks(log).await.is_empty(), "nothing of a refused call is kept");
    log.append(vec![frame("a", 1, 3, 10), frame("b", 1, 9, 10)]).await.unwrap();
    log.append(vec![frame("a", 4, 4, 10)]).await.unwrap();
    // A robot that did not hear the acknowledgement sends again; its mark does not fall.
    log.append(vec![frame("a", 1, 3, 10)]).await.unwrap();
    assert_eq!(marks(log).await, [("a".to_owned(), 4), ("b".to_owned(), 9)]);
    let all = log.read(0, usize::MAX).await.unwrap();
    assert_eq!(all.len(), 4);
    let first = log.read(0, 1).await.unwrap();
    assert_eq!(first, all[..2], "whole groups");
    assert_eq!(log.read(first[1].position, usize::MAX).await.unwrap(), all[2..]);
    assert!(log.read(all[3].position, usize::MAX).await.unwrap().is_empty());
    log.report_gaps(vec![gap("a", 10), gap("b", 20), gap("a", 30)]).await.unwrap();
    let of_a = log.gaps(Some(&RobotId::parse("a").unwrap()), 10).await.unwrap();
    assert_eq!(of_a, [gap("a", 30), gap("a", 10)]);
    assert_eq!(log.gaps(None, 1).await.unwrap(), [gap("a", 30)]);
}

#[tokio::test]
async fn frames_in_memory_keep_the_contract() {
    let log = MemoryFrames::new(clock(), 1_000);
    the_frame_contract(&log).await;
    log.append(vec![frame("c", 1, 1, 990)]).await.unwrap();
    assert_eq!(log.read(0, usize::MAX).await.unwrap().len(), 2, "the oldest are gone");
}

#[tokio::test]
async fn frames_on_postgresql_keep_the_contract_for_every_process_that_has_them_open() {
    let config = crate::support::database().await;
    let open = async || PostgresFrames::open(&config, site(), clock(), 300_000).await.unwrap();
    let (log, other) = (open().await, open().await);
    the_frame_contract(&log).await;
    assert_eq!(marks(&other).await, [("a".to_owned(), 4), ("b".to_owned(), 9)], "a robot may go on elsewhere");
    let last = log.read(0, usize::MAX).await.unwrap().last().unwrap().position;
    let (one, two) = tokio::join!(log.append(vec![frame("a", 5, 5, 10)]), other.append(vec![frame("b", 10, 12, 10)]));
    assert!(one.is_ok() && two.is_ok());
    let read = other.read(last, usize::MAX).await.unwrap();
    assert_eq!(read.iter().map(|f| f.position).collect::<Vec<_>>(), [last + 1, last + 2]);
    for _ in 0..5 {
        other.append(vec![frame("c", 1, 1, 100_000)]).await.unwrap();
    }
    assert!(log.prune().await.unwrap() > 200_000);
    assert_eq!(other.prune().await.unwrap(), 0);
    assert_eq!(log.read(0, usize::MAX).await.unwrap().len(), 2);
    for _ in 0..5 {
        other.append(vec![frame("c", 1, 1, 100_000)]).await.unwrap();
    }
    let (one, two) = tokio::join!(log.prune(), other.prune());
    assert!(one.unwrap() + two.unwrap() > 200_000);
    assert_eq!(log.read(0, usize::MAX).await.unwrap().len(), 2, "two that prune at once take no more than one");
    assert_eq!(marks(&open().await).await, [("a".to_owned(), 5), ("b".to_owned(), 12), ("c".to_owned(), 1)]);
    let nul = Frame { ring: Arc::from("r\0"), ..frame("a", 6, 6, 1) };
    assert!(matches!(log.append(vec![nul]).await, Err(Error::BadFrame(_))));
    log.close().await;
    assert!(log.append(vec![frame("a", 6, 6, 1)]).await.is_err());
}

/// The mark of one ring is forgotten as it was read, and that of another has moved since.
async fn forgets(log: &dyn FrameLog) {
    log.append(vec![frame("a", 1, 3, 10), frame("b", 1, 9, 10)]).await.unwrap();
    let read = log.marks().await.unwrap();
    log.append(vec![frame("b", 10, 12, 10)]).await.unwrap();
    assert_eq!(log.forget(read.clone()).await.unwrap(), 1);
    assert_eq!(marks(log).await, [("b".to_owned(), 12)]);
    assert_eq!(log.mark(&RobotId::parse("a").unwrap(), "ring").await.unwrap(), 0);
    assert_eq!(log.forget(read).await.unwrap(), 0, "once");
    assert_eq!(log.read(0, usize::MAX).await.unwrap().len(), 3, "frames stay");
}

#[tokio::test]
async fn a_mark_is_forgotten_on_every_engine_also_over_a_start_unless_it_has_moved_since() {
    forgets(&MemoryFrames::new(clock(), 1_000_000)).await;
    let config = crate::support::database().await;
    forgets(&PostgresFrames::open(&config, site(), clock(), 1_000_000).await.unwrap()).await;
    let dir = tempfile::tempdir().unwrap();
    let open = async || SqliteFrames::open(dir.path(), site(), clock(), 1_000_000).await.unwrap();
    let log = open().await;
    forgets(&log).await;
    drop(log);
    assert_eq!(marks(&open().await).await, [("b".to_owned(), 12)], "it is not folded from the log's tail again");
}

#[tokio::test]
async fn frames_on_disk_keep_the_contract_and_their_marks_over_a_start() {
    let dir = tempfile::tempdir().unwrap();
    let open = async || SqliteFrames::open(dir.path(), site(), clock(), 300_000).await.unwrap();
    let log = open().await;
    the_frame_contract(&log).await;
    drop(log);
    let log = open().await;
    let before = [("a".to_owned(), 4), ("b".to_owned(), 9)];
    assert_eq!(marks(&log).await, before, "folded from the log's tail");
    for _ in 0..5 {
        log.append(vec![frame("c", 1, 1, 100_000)]).await.unwrap();
    }
    assert!(log.prune().await.unwrap() > 200_000);
    assert_eq!(log.prune().await.unwrap(), 0);
    drop(log);
    let log = open().await;
    assert_eq!(marks(&log).await[..2], before, "written down before their frames went");
    let left = log.read(0, usize::MAX).await.unwrap();
    assert_eq!(left.len(), 2);
    log.close().await;
    assert!(log.append(vec![frame("a", 5, 5, 1)]).await.is_err());
}
