//! Laws L1 to L6 on the robot's side, over each store.

use crate::rig::{Rig, ack, attempt, items, place_id};
use midshift_agent::device::DeviceKey;
use midshift_agent::ledger::{Applied, Holder, PlacesRow, SessionMemory};
use midshift_agent::memory::MemoryStore;
use midshift_agent::ring::{Item, Ring};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::{Op, RobotMemory, Store};
use midshift_core::ids::AttemptId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::robot::WorkState;
use midshift_core::robot::{Lane, Mode, ReportedAttempt, Vitals};
use midshift_core::robot_events::{AttemptReport, Gap, InboxItem, RobotEvent, SampleBody, WorkStats};
use midshift_proto::session::{Downlink, LaneAck};
use std::sync::Arc;

/// Writes through the core's copy into a store and reads the store again, as a restart does.
struct Bench<F: AsyncFn() -> Box<dyn Store>> {
    memory: RobotMemory,
    open: F,
}

impl<F: AsyncFn() -> Box<dyn Store>> Bench<F> {
    async fn new(open: F) -> Self {
        Self { memory: open().await.load("ring-1").await.expect("loads"), open }
    }
    async fn write(&mut self, ops: Vec<Op>) {
        ops.iter().for_each(|op| self.memory.apply(op));
        (self.open)().await.commit(&ops).await.expect("commits");
    }
    async fn append(&mut self, lane: Lane) {
        let body = match lane {
            Lane::Status => SampleBody::Status(Vitals::default()),
            _ => SampleBody::Event(RobotEvent::Mode(Mode::Manual)),
        };
        let ops = self.memory.ring.append(lane, 7, body);
        self.write(ops).await;
    }
    /// Everything survives: what was read back is what was written.
    async fn restart(&mut self) {
        let read = (self.open)().await.load("another").await.expect("loads");
        assert_eq!(read, self.memory);
        self.memory = read;
    }
    fn ring(&self) -> &Ring {
        &self.memory.ring
    }
}

async fn numbers_survive_a_restart(open: impl AsyncFn() -> Box<dyn Store>) {
    let mut bench = Bench::new(open).await;
    for _ in 0..3 {
        bench.append(Lane::Event).await;
        bench.append(Lane::Status).await;
    }
    bench.restart().await;
    bench.append(Lane::Event).await;
    assert_eq!((bench.ring().lane(Lane::Event).produced, bench.ring().lane(Lane::Critical).produced), (4, 0));
    assert_eq!(bench.ring().id, "ring-1");
    let free = bench.ring().ack(Lane::Event, 4).expect("news");
    bench.write(vec![free]).await;
    bench.restart().await;
    assert_eq!(bench.ring().after(Lane::Event, 0), None);
    bench.append(Lane::Event).await;
    assert!(matches!(bench.ring().after(Lane::Event, 4), Some(Item::Sample(s)) if s.seq == 5));
    // An old acknowledgement, and one of numbers that were never given.
    assert_eq!(bench.ring().ack(Lane::Event, 2), None);
    assert_eq!(bench.ring().ack(Lane::Event, 99), Some(Op::Free(Lane::Event, 5)));
}

async fn an_overflow_thins_old_status_with_a_gap_and_nothing_else(open: impl AsyncFn() -> Box<dyn Store>) {
    let mut bench = Bench::new(open).await;
    bench.append(Lane::Critical).await;
    let mut ops = Vec::new();
    for _ in 0..2 * limits::RING_STATUS_MAX {
        let more = bench.memory.ring.append(Lane::Status, 7, SampleBody::Status(Vitals::default()));
        more.iter().for_each(|op| bench.memory.apply(op));
        ops.extend(more);
    }
    (bench.open)().await.commit(&ops).await.expect("commits");
    bench.restart().await;
    let status = bench.ring().lane(Lane::Status);
    assert!(status.samples.len() <= limits::RING_STATUS_MAX);
    let gap = Gap { lane: Lane::Status, from_seq: 1, to_seq: status.samples[0].seq - 1, reason: Code::Overflow.into() };
    assert_eq!(status.gaps, std::slice::from_ref(&gap));
    assert_eq!(bench.ring().after(Lane::Status, 0), Some(Item::Gap(gap)));
    assert_eq!(bench.ring().lane(Lane::Critical).samples.len(), 1);
    assert_eq!(status.produced, 2 * limits::RING_STATUS_MAX as u64);
}

async fn what_was_freed_and_is_expected_again_becomes_a_gap(open: impl AsyncFn() -> Box<dyn Store>) {
    let mut bench = Bench::new(open).await;
    for _ in 0..5 {
        bench.append(Lane::Event).await;
    }
    let free = bench.ring().ack(Lane::Event, 3).expect("news");
    bench.write(vec![free]).await;
    assert_eq!(bench.ring().expected(Lane::Event, 4), None);
    let gap = bench.ring().expected(Lane::Event, 2).expect("freed");
    assert!(matches!(&gap, Op::Gap(g) if (g.from_seq, g.to_seq, g.reason.code) == (2, 3, Code::FreedAfterAck)));
    bench.write(vec![gap]).await;
    bench.restart().await;
    assert!(matches!(bench.ring().after(Lane::Event, 1), Some(Item::Gap(g)) if g.to_seq == 3));
    assert!(matches!(bench.ring().after(Lane::Event, 3), Some(Item::Sample(s)) if s.seq == 4));
    let free = bench.ring().ack(Lane::Event, 3).expect("the gap is stored");
    bench.write(vec![free]).await;
    bench.restart().await;
    assert!(bench.ring().lane(Lane::Event).gaps.is_empty());
    // Everything was freed: the gap reaches to the end.
    let free = bench.ring().ack(Lane::Event, 5).expect("news");
    bench.write(vec![free]).await;
    let gap = bench.ring().expected(Lane::Event, 1).expect("freed");
    assert!(matches!(gap, Op::Gap(g) if (g.from_seq, g.to_seq) == (1, 5)));
}

async fn a_ring_behind_its_server_moves_on_and_loses_nothing(open: impl AsyncFn() -> Box<dyn Store>) {
    let mut bench = Bench::new(open).await;
    bench.append(Lane::Event).await;
    bench.append(Lane::Event).await;
    assert_eq!(bench.ring().jump(Lane::Event, 2), []);
    let jump = bench.ring().jump(Lane::Event, 10);
    bench.write(jump).await;
    bench.restart().await;
    let kept = bench.ring().lane(Lane::Event);
    assert_eq!((kept.produced, kept.samples.iter().map(|s| s.seq).collect::<Vec<_>>()), (12, vec![11, 12]));
}

/// An attempt that is executed.
pub fn holder(attempt: AttemptId) -> Holder {
    Holder {
        attempt,
        step: 1,
        opened: true,
        intent: None,
        unknown: false,
        elapsed_ms: 5,
        duration_ms: 6,
        base_odometer_mm: 7,
        base_loaded_mm: 8,
        base_energy_mwh: 9,
        hottest_joint_decidegrees: 300,
    }
}

/// How an attempt that succeeded is answered and listed.
pub fn succeeded(attempt: &AttemptId) -> (AttemptReport, ReportedAttempt) {
    let (state, step_index, opened) = (WorkState::Succeeded, 2, true);
    let stats = WorkStats::default();
    let report =
        AttemptReport { attempt: attempt.clone(), state, step_index, opened, refusal: None, fault: None, stats };
    let listed = ReportedAttempt { attempt: attempt.clone(), state, step_index, progress: 9, route_index: 1, opened };
    (report, listed)
}

async fn the_ledger_is_read_back_as_it_was_written(open: impl AsyncFn() -> Box<dyn Store>) {
    let mut bench = Bench::new(open).await;
    let done = attempt("T1", 4);
    let (report, listed) = succeeded(&done);
    let holder = holder(attempt("T2", 1));
    let places = PlacesRow {
        inside: [(place_id("door"), 3)].into(),
        committed: [(place_id("D"), 4)].into(),
        used: [1, 2].into(),
    };
    bench
        .write(vec![
            Op::Session(SessionMemory { session_epoch: 3, secret: "s".into(), store_id: "store".into() }),
            Op::Applied(Applied { work: 4, policy: 5, update: 6 }),
            Op::Holder(Some(Box::new(holder))),
            Op::Places(places),
            Op::Epoch(done.subject.clone(), 4, 1_000),
            Op::Finish(Arc::new(report), listed, 2_000),
            Op::Epoch(attempt("T3", 1).subject, 8, 3_000),
            Op::Epoch(attempt("T3", 1).subject, 2, 4_000),
            Op::Device(DeviceKey::of_seed([9; 32])),
        ])
        .await;
    bench.restart().await;
    let ledger = &bench.memory.ledger;
    assert_eq!((ledger.highest_epoch(&done.subject), ledger.highest_epoch(&attempt("T3", 1).subject)), (4, 8));
    assert!(ledger.finished(&done.subject).is_some());
    assert_eq!(ledger.device, Some(DeviceKey::of_seed([9; 32])));
    assert!(ledger.forgettable(i64::MAX / 2).is_empty(), "few subjects are kept whatever their age");
    bench.write(vec![Op::Closed(done.clone()), Op::Holder(None), Op::Forget(attempt("T3", 1).subject)]).await;
    bench.restart().await;
    assert_eq!((bench.memory.ledger.unclosed.len(), bench.memory.ledger.subjects().len()), (0, 1));
}

macro_rules! contract {
    ($($law:ident)*) => {
        mod in_memory {
            $(#[tokio::test]
            async fn $law() {
                let store = super::MemoryStore::new();
                super::$law(async || Box::new(store.clone()) as Box<dyn super::Store>).await;
            })*
        }
        mod in_sqlite {
            $(#[tokio::test]
            async fn $law() {
                let dir = tempfile::tempdir().expect("a folder");
                let path = dir.path().join("robot.db");
                super::$law(async || {
                    Box::new(super::SqliteStore::open(&path).await.expect("opens")) as Box<dyn super::Store>
                })
                .await;
            })*
        }
    };
}

contract! {
    numbers_survive_a_restart
    an_overflow_thins_old_status_with_a_gap_and_nothing_else
    what_was_freed_and_is_expected_again_becomes_a_gap
    a_ring_behind_its_server_moves_on_and_loses_nothing
    the_ledger_is_read_back_as_it_was_written
}

#[tokio::test]
async fn two_agents_never_open_one_file() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("robot.db");
    let first = SqliteStore::open(&path).await.expect("opens");
    let second = SqliteStore::open(&path).await.expect_err("is locked");
    assert!(second.to_string().contains("another agent"), "{second}");
    drop(first);
    SqliteStore::open(&path).await.expect("opens");
}

fn seqs(rig: &Rig, lane: Lane) -> Vec<u64> {
    let seq = |item: &InboxItem| match item {
        InboxItem::Sample(sample) => Some(sample.seq),
        _ => None,
    };
    items(&rig.messages, lane).iter().filter_map(seq).collect()
}

#[test]
fn nothing_is_sent_before_it_is_durable() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.slow_disk = true;
    rig.body.says(midshift_agent::body::BodyNews::Mode(Mode::Manual));
    rig.pass(1_000);
    assert_eq!((seqs(&rig, Lane::Event), rig.core.memory().ring.lane(Lane::Event).produced), (vec![], 1));
    rig.flush();
    assert_eq!(seqs(&rig, Lane::Event), [1]);
}

#[test]
fn a_hole_that_the_server_saw_is_sent_again_and_what_was_freed_is_said() {
    let mut rig = Rig::at("A");
    rig.connect();
    for mode in [Mode::Manual, Mode::Automatic, Mode::Service, Mode::Automatic] {
        rig.body.says(midshift_agent::body::BodyNews::Mode(mode));
        rig.pass(500);
    }
    rig.down(Downlink { acks: vec![ack(Lane::Event, 2)], ..Downlink::default() });
    rig.messages.clear();
    let expect = |seq, expect| vec![LaneAck { lane: Lane::Event, seq, expect: Some(expect) }];
    rig.down(Downlink { acks: expect(2, 3), ..Downlink::default() });
    assert_eq!(seqs(&rig, Lane::Event), [3, 4]);
    rig.messages.clear();
    rig.down(Downlink { acks: expect(0, 1), ..Downlink::default() });
    let all = items(&rig.messages, Lane::Event);
    assert!(matches!(&all[0], InboxItem::Gap(g) if (g.from_seq, g.to_seq) == (1, 2)), "{all:?}");
    assert_eq!(seqs(&rig, Lane::Event), [3, 4]);
}

#[test]
fn the_heartbeat_says_what_was_written_and_ends_at_once_with_the_session() {
    let mut rig = Rig::at("A");
    rig.connect();
    rig.body.says(midshift_agent::body::BodyNews::Mode(Mode::Manual));
    rig.pass(1_500);
    let reported = rig.reported.clone().expect("a heartbeat");
    assert_eq!((reported.produced[&Lane::Event], reported.mode), (1, Mode::Manual));
    rig.give(midshift_agent::core::Input::Disconnected);
    rig.messages.clear();
    rig.silence(5_000);
    assert_eq!(rig.messages.len(), 0);
}
