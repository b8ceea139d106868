//! Frames are made coarser once, whoever does it and however often it is begun, and nothing else of them changes.

use crate::support::{WALL, database, site};
use midshift_core::ids::RobotId;
use midshift_core::privacy::PRECISE_MS;
use midshift_core::time::{Clock, Now, Utc};
use midshift_store::{Frame, FrameLog, FramesOldest, MemoryFrames, PostgresFrames, SqliteFrames};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

/// More than two slices.
const FRAMES: u64 = 40;
const DAY_MS: i64 = PRECISE_MS as i64;

/// A wall that stands still until it is moved.
struct Wall(AtomicI64);

impl Clock for Wall {
    fn now(&self) -> Now {
        let wall = Utc(self.0.load(Ordering::Relaxed));
        Now { wall, utc: wall, ..Now::default() }
    }
    fn rate_permille(&self) -> u32 {
        1_000
    }
}

impl Wall {
    fn new() -> Arc<Self> {
        Arc::new(Self(AtomicI64::new(WALL)))
    }
    fn pass(&self, ms: i64) {
        self.0.fetch_add(ms, Ordering::Relaxed);
    }
}

/// Done twice it would show: not what telemetry does, but what proves that it is done once.
fn counted(bytes: &[u8]) -> Option<Vec<u8>> {
    let [first, rest @ ..] = bytes else { return None };
    (*first != 0).then(|| [&[first + 1], rest].concat())
}

fn frame(seq: u64, byte: u8) -> Frame {
    let robot_id = RobotId::parse("a").unwrap();
    Frame { robot_id, ring: Arc::from("ring"), first_seq: seq, last_seq: seq, bytes: vec![byte, 7, 7].into() }
}

async fn fill(log: &dyn FrameLog) {
    for seq in 1..=FRAMES {
        log.append(vec![frame(seq, if seq == 5 { 0 } else { 1 })]).await.unwrap();
    }
}

/// First byte of each frame by its number; 0: it has none any more.
async fn bytes(log: &dyn FrameLog) -> Vec<(u64, u8)> {
    let all = log.read(0, usize::MAX).await.unwrap();
    assert!(all.windows(2).all(|two| two[0].position < two[1].position), "the order stays");
    all.iter().map(|f| (f.frame.first_seq, f.frame.bytes.first().copied().unwrap_or_default())).collect()
}

/// Those up to `last` have been made coarser once; the one that cannot be read is empty.
fn once_up_to(last: u64, all: u64) -> Vec<(u64, u8)> {
    let byte = |seq| match seq {
        5 => 0,
        _ if seq <= last => 2,
        _ => 1,
    };
    (1..=all).map(|seq| (seq, byte(seq))).collect()
}

async fn made_coarser_once(log: &dyn FrameLog, wall: &Wall) {
    fill(log).await;
    wall.pass(DAY_MS - 1);
    assert_eq!(log.coarsen(counted).await.unwrap(), 0, "not a day yet");
    log.append(vec![frame(FRAMES + 1, 1)]).await.unwrap();
    let before = FramesOldest { any: Some(WALL), precise: Some(WALL) };
    assert_eq!(log.oldest().await.unwrap(), before);
    wall.pass(1);
    assert_eq!(log.coarsen(counted).await.unwrap(), FRAMES);
    assert_eq!(bytes(log).await, once_up_to(FRAMES, FRAMES + 1));
    let after = FramesOldest { any: Some(WALL), precise: Some(WALL + DAY_MS - 1) };
    assert_eq!(log.oldest().await.unwrap(), after);
    assert_eq!(log.coarsen(counted).await.unwrap(), 0, "once");
    assert_eq!(log.marks().await.unwrap()[0].seq, FRAMES + 1, "what is durable stays so");
}

#[tokio::test]
async fn frames_in_memory_are_made_coarser_once() {
    let wall = Wall::new();
    let log = MemoryFrames::new(wall.clone(), u64::MAX);
    made_coarser_once(&log, &wall).await;
}

#[tokio::test]
async fn frames_on_disk_are_made_coarser_once_also_over_a_start() {
    let (wall, dir) = (Wall::new(), tempfile::tempdir().unwrap());
    let open = async || SqliteFrames::open(dir.path(), site(), wall.clone(), u64::MAX).await.unwrap();
    let log = open().await;
    made_coarser_once(&log, &wall).await;
    log.close().await;
    let log = open().await;
    assert_eq!(log.coarsen(counted).await.unwrap(), 0, "it is known how far it was");
    wall.pass(DAY_MS);
    assert_eq!(log.coarsen(counted).await.unwrap(), 1);
    assert_eq!(bytes(&log).await, once_up_to(FRAMES + 1, FRAMES + 1));
}

#[tokio::test]
async fn frames_on_postgresql_are_made_coarser_once_whichever_process_does_it() {
    let (wall, config) = (Wall::new(), database().await);
    let open = async || PostgresFrames::open(&config, site(), wall.clone(), u64::MAX).await.unwrap();
    let (log, other) = (open().await, open().await);
    made_coarser_once(&log, &wall).await;
    for seq in FRAMES + 2..=2 * FRAMES {
        log.append(vec![frame(seq, 1)]).await.unwrap();
    }
    wall.pass(DAY_MS);
    let (one, two) = tokio::join!(log.coarsen(counted), other.coarsen(counted));
    assert_eq!(one.unwrap() + two.unwrap(), FRAMES);
    assert_eq!(bytes(&other).await, once_up_to(2 * FRAMES, 2 * FRAMES));
}

#[tokio::test]
async fn frames_that_a_wrong_clock_stamped_ahead_are_coarse_at_once_and_keep_nobody_waiting() {
    let wall = Wall::new();
    let log = MemoryFrames::new(wall.clone(), u64::MAX);
    wall.pass(400 * DAY_MS);
    log.append(vec![frame(1, 1)]).await.unwrap();
    wall.pass(-400 * DAY_MS);
    log.append(vec![frame(2, 1)]).await.unwrap();
    assert_eq!(log.coarsen(counted).await.unwrap(), 1);
    assert_eq!(bytes(&log).await, [(1, 2), (2, 1)]);
    assert_eq!(log.prune().await.unwrap(), 0, "it is not old enough to go");
}

#[tokio::test]
async fn frames_go_after_their_days_whatever_room_there_is() {
    let (wall, dir) = (Wall::new(), tempfile::tempdir().unwrap());
    let disk = SqliteFrames::open(dir.path(), site(), wall.clone(), u64::MAX).await.unwrap();
    let postgres = PostgresFrames::open(&database().await, site(), wall.clone(), u64::MAX).await.unwrap();
    let memory = MemoryFrames::new(wall.clone(), u64::MAX);
    let logs: [&dyn FrameLog; 3] = [&disk, &postgres, &memory];
    for log in logs {
        log.append(vec![frame(1, 1)]).await.unwrap();
    }
    wall.pass(30 * DAY_MS - 1);
    for log in logs {
        assert_eq!(log.prune().await.unwrap(), 0);
        log.append(vec![frame(2, 1)]).await.unwrap();
    }
    wall.pass(1);
    for log in logs {
        assert!(log.prune().await.unwrap() > 0);
        assert_eq!(bytes(log).await, [(2, 1)]);
        assert_eq!(log.marks().await.unwrap()[0].seq, 2, "how far the robot has come is known all the same");
    }
}
