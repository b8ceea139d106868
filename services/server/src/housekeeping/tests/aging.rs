//! Nothing that goes by age gets older than it may, on every engine, and positions are as precise as they may be.

use super::super::oldest::{Oldest, find_oldest};
use super::super::{Turn, audit};
use crate::postgres_server::PostgresServer;
use midshift_core::fleet::rows::FleetMark;
use midshift_core::ids::{RobotId, SiteId, StopId};
use midshift_core::item::{Expect, Fact, Item, RowChange, Write};
use midshift_core::privacy::{self, Place, Retention};
use midshift_core::robot::StopLevel;
use midshift_core::rollout::rows::OtaMark;
use midshift_core::rows::{Index, Key, Log, Record, Revision, Seq, Table, Writer};
use midshift_core::site::text;
use midshift_core::stop::record::{StopRecord, copy};
use midshift_core::stop::{Latch, Reset, Scope, Stop};
use midshift_core::task::{Phase, TaskState};
use midshift_core::time::{Clock, Now, Utc};
use midshift_proto::common::v1::Pose;
use midshift_proto::link::v1::{LaneBatch, Sample, Vitals, sample};
use midshift_store::{
    Error, Frame, FrameLog, MemoryFrames, MemoryStore, PostgresConfig, PostgresFrames, PostgresStore, SqliteFrames,
    SqliteStore, Store, StoreId,
};
use midshift_task::TaskService;
use prost::Message;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};
use tokio_util::sync::CancellationToken;

const BEGIN: i64 = 1_780_000_000_000;
const HOUR_MS: i64 = 3_600_000;
/// Hours between turns: around each age that something has, and far beyond the longest.
const HOURS: [i64; 16] = [1, 22, 1, 1, 24, 24 * 5, 1, 24, 24 * 22, 24, 24 * 60, 24 * 308, 24, 24, 24 * 30, 1];

/// A wall that stands still until it is moved, and a site clock that runs with it.
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

fn site() -> SiteId {
    SiteId::parse("north").expect("an id")
}

struct World {
    wall: Arc<Wall>,
    store: Arc<dyn Store>,
    frames: Arc<dyn FrameLog>,
    task: TaskService,
    written: u64,
    /// What a stop service would keep.
    latch: Latch,
    marked: [Revision; 2],
}

impl World {
    async fn new(wall: Arc<Wall>, store: Arc<dyn Store>, frames: Arc<dyn FrameLog>) -> Self {
        let site = Arc::new(text::parse(include_str!("../../../../../sites/demo.site.toml")).expect("a site"));
        let parts = midshift_task::Parts { store: store.clone(), site, clock: wall.clone(), bugs: Default::default() };
        let task = TaskService::open(parts, CancellationToken::new()).await.expect("intake");
        Self { wall, store, frames, task, written: 0, latch: Latch::default(), marked: Default::default() }
    }
    async fn commit(&self, item: Item) {
        self.store.commit(vec![item]).await.remove(0).expect("applied");
    }
    /// One more of everything, written now.
    async fn write(&mut self) {
        self.written += 1;
        let (n, now) = (self.written, self.wall.now().wall.0);
        let row = |table: Table| {
            let write = Write::Put { body: Arc::from("{}"), index: Index { order: Some(now), ..Index::default() } };
            RowChange { key: Key::new(table, format!("row-{n}")), expect: Expect::Absent, write, kind: "row.put" }
        };
        for table in [Table::RequestKey, Table::TaskRequest, Table::CommandKey, Table::OtaCommandKey, Table::Token] {
            self.commit(Item { rows: vec![row(table)], ..Item::new(table.writer(), "test") }).await;
        }
        let stop_id = StopId::parse(&format!("STOP-{n}")).expect("an id");
        let (at, actor) = (Utc(now), "anna".to_owned());
        let stop = Stop::new(stop_id.clone(), Scope::Fleet, StopLevel::Halt, at);
        self.latch.engage(Stop { actor: actor.clone(), ..stop });
        self.latch.reset(Reset { actor, ..Reset::new(stop_id, at) });
        self.copy_stops().await;
        let mut telemetry = Item { rows: vec![row(Table::Presence)], ..Item::new(Writer::Telemetry, "test") };
        let fact = Fact { log: Log::RobotInbox, subject: Arc::from("r1"), kind: "event", body: Arc::from("{}") };
        telemetry.facts.push(fact);
        self.commit(telemetry).await;
        let mut ended = Item::new(Writer::Task, "test");
        ended.create(&self.ended(n), "task.admitted");
        self.commit(ended).await;
        for (writer, _) in Table::audits() {
            let mut noted = Item::new(*writer, "anna");
            noted.audit(midshift_core::audit::Note::new("test.done"));
            self.commit(noted).await;
        }
        let pose = Some(Pose { x_mm: 12_345, y_mm: 6_789, theta_mrad: 1_000 });
        let vitals = Vitals { pose, waypoint: "A01".into(), odometer_mm: n, ..Vitals::default() };
        let sample = Sample { seq: n, robot_unix_ms: now, body: Some(sample::Body::Status(vitals)) };
        let bytes = LaneBatch { lane: 3, samples: vec![sample], gaps: Vec::new() }.encode_to_vec();
        let (robot_id, ring) = (RobotId::parse("r1").expect("an id"), Arc::from("ring"));
        let frame = Frame { robot_id, ring, first_seq: n, last_seq: n, bytes: bytes.into() };
        self.frames.append(vec![frame]).await.expect("kept");
    }
    fn ended(&self, n: u64) -> TaskState {
        let now = self.wall.now().utc;
        let state = serde_json::json!({
            "task_id": format!("task-{n}"), "number": n, "phase": "succeeded", "reason": null, "then": null, "holds": [], "epoch": 0,
            "robot_id": null, "opened_robot_id": null, "next_step": 0, "failures": 0, "refusals_in_row": 0, "failed_robots": [],
            "semantic_refusers": [], "queued_since": now, "retry_at": null, "cancel_requested": null, "started": null, "ended": now,
            "changed": now, "stats": midshift_core::robot_events::WorkStats::default(),
        });
        let state: TaskState = serde_json::from_value(state).expect("a state");
        assert!(state.phase == Phase::Succeeded);
        state
    }
    /// Fleet and ota have read all there is.
    async fn consume_all(&mut self) {
        let mark = Seq(self.store.wake().borrow().0);
        self.consume(Writer::Fleet, &FleetMark { seq: mark }, 0).await;
        self.consume(Writer::Ota, &OtaMark { seq: mark }, 1).await;
    }
    /// What fleet and ota have read, which they note in rows: nothing after it goes.
    async fn consume<R: Record>(&mut self, writer: Writer, mark: &R, at: usize) {
        let expect = if self.marked[at] == Revision(0) { Expect::Absent } else { Expect::At(self.marked[at]) };
        let mut item = Item::new(writer, "test");
        item.put_row(mark, expect, "mark");
        self.marked[at] = self.marked[at].next();
        self.commit(item).await;
    }
    /// As whoever follows a stop service does.
    async fn copy_stops(&self) {
        let snapshot = self.store.snapshot(&[Table::StopRecord]).await.expect("read");
        let known = snapshot.rows.iter().map(|row| {
            let record: StopRecord = row.decode().expect("a stop");
            (record.stop.stop_id.clone(), (record, row.revision))
        });
        for applied in self.store.commit(copy(&self.latch, &known.collect())).await {
            applied.expect("applied");
        }
    }
    async fn purge(&mut self) {
        self.purge_down_to(u64::MAX).await;
    }
    /// Keeps at most so many entries of each log.
    async fn purge_down_to(&mut self, log_entries_max: u64) {
        self.latch.forget(self.wall.now().wall, midshift_core::limits::RESETS_MAX);
        self.copy_stops().await;
        let (store, frames, clock) = (self.store.as_ref(), self.frames.as_ref(), self.wall.as_ref());
        Turn { store, frames, clock, task: Some(&self.task), log_entries_max }.prune_all(|_| true).await;
        for (writer, _) in Table::audits() {
            audit::maintain_chain(store, clock, *writer).await.expect("kept");
        }
    }
    async fn ages(&self) -> Vec<Oldest> {
        find_oldest(self.store.as_ref(), self.frames.as_ref(), self.wall.as_ref()).await.expect("read")
    }
    /// Every position that is kept, with how old it is.
    async fn positions(&self) -> Vec<(Vitals, u64)> {
        let (mut found, now) = (Vec::new(), self.wall.now().wall);
        for stored in self.frames.read(0, usize::MAX).await.expect("read") {
            let batch = LaneBatch::decode(&*stored.frame.bytes).expect("a batch");
            for sample in batch.samples {
                let Some(sample::Body::Status(vitals)) = sample.body else { panic!("another sample") };
                found.push((vitals, now.ms_since(Utc(stored.at_unix_ms))));
            }
        }
        found
    }
}

async fn nothing_gets_too_old(mut world: World) {
    let (mut too_old, mut coarse, mut precise) = (BTreeSet::new(), 0, 0);
    for hours in HOURS {
        world.write().await;
        world.wall.0.fetch_add(hours * HOUR_MS, Ordering::Relaxed);
        world.consume_all().await;
        let before = world.ages().await;
        too_old.extend(before.iter().filter(|o| o.age_ms > o.age_max_ms).map(|o| o.place.as_str()));
        world.purge().await;
        for after in world.ages().await {
            assert!(after.age_ms <= after.age_max_ms, "after {hours} h: {after:?}");
        }
        for (vitals, age_ms) in world.positions().await {
            let is_precise = vitals.pose.is_some_and(|p| (p.x_mm, p.y_mm, p.theta_mrad) == (12_345, 6_789, 1_000));
            assert_eq!(is_precise, age_ms < privacy::PRECISE_MS, "{age_ms} ms: {vitals:?}");
            assert_eq!(is_precise, vitals.waypoint == "A01", "{vitals:?}");
            assert!(
                vitals.pose.is_some() && vitals.odometer_mm > 0,
                "what was driven stays, and the square: {vitals:?}"
            );
            if is_precise { precise += 1 } else { coarse += 1 }
        }
        assert_eq!(world.frames.coarsen(|_| panic!("once is enough")).await.expect("nothing to do"), 0);
    }
    let looked_at: BTreeSet<&str> = world.ages().await.iter().map(|o| o.place.as_str()).collect();
    assert_eq!(too_old, looked_at, "each of them was too old before a purge, or this proves nothing");
    assert!(coarse > 5 && precise > 5, "{coarse} {precise}");
}

/// Entries that the inbox of robots has.
async fn told(world: &World) -> usize {
    let page = async |after| world.store.feed(after, &[Log::RobotInbox], 100).await;
    let page = match page(Seq(0)).await {
        Err(Error::CursorExpired { oldest, .. }) => page(oldest).await,
        first => first,
    };
    page.expect("read").entries.len()
}

#[tokio::test]
async fn a_mark_that_nobody_moves_any_more_holds_entries_back_for_a_month_and_no_longer() {
    let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
    let dir = tempfile::tempdir().expect("a folder");
    let store = SqliteStore::open(dir.path(), site(), wall.clone()).await.expect("a store");
    let frames = MemoryFrames::new(wall.clone(), u64::MAX);
    let mut world = World::new(wall, Arc::new(store), Arc::new(frames)).await;
    world.write().await;
    world.consume_all().await;
    // From here on only fleet reads on.
    let mut left = Vec::new();
    for hours in [0, 24 * 8, 24 * 23] {
        world.wall.0.fetch_add(hours * HOUR_MS, Ordering::Relaxed);
        world.write().await;
        let mark = Seq(world.store.wake().borrow().0);
        world.consume(Writer::Fleet, &FleetMark { seq: mark }, 0).await;
        world.purge().await;
        left.push(told(&world).await);
    }
    assert_eq!(left, [2, 2, 1], "what both have read, then what roll-outs have not read for a month");
}

#[tokio::test]
async fn of_a_log_so_many_entries_stay_as_are_kept_and_all_that_a_service_has_not_read() {
    let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
    let dir = tempfile::tempdir().expect("a folder");
    let store = SqliteStore::open(dir.path(), site(), wall.clone()).await.expect("a store");
    let frames = MemoryFrames::new(wall.clone(), u64::MAX);
    let mut world = World::new(wall, Arc::new(store), Arc::new(frames)).await;
    for _ in 0..5 {
        world.write().await;
    }
    world.purge_down_to(2).await;
    assert_eq!(told(&world).await, 5, "fleet has read nothing");
    world.consume_all().await;
    world.write().await;
    world.purge_down_to(2).await;
    assert_eq!(told(&world).await, 2);
    world.purge().await;
    assert_eq!(told(&world).await, 2, "they are young");
}

#[test]
fn every_place_that_goes_by_age_is_looked_at_or_has_its_reason() {
    // These go with their task, or are looked after by the stop service and the robot. Of counters and marks the newest of a robot stays,
    // however old it is; that the others go is tested where they are taken away, in fleet and in telemetry.
    let others = ["task_intake", "attempt", "robot_counter", "lane_mark", "stop/latch", "ledger"];
    let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
    let looked_at = runtime.block_on(async {
        let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
        let store = MemoryStore::new(site(), StoreId(Arc::from("memory")), wall.clone());
        let frames = MemoryFrames::new(wall.clone(), u64::MAX);
        find_oldest(&store, &frames, wall.as_ref()).await.expect("read")
    });
    let by_age =
        privacy::RETENTION_RULES.iter().filter(|rule| rule.age_max_ms().is_some()).map(|rule| rule.place.as_str());
    let looked_at: Vec<&str> = looked_at.iter().map(|o| o.place.as_str()).collect();
    let left: Vec<&str> = by_age.filter(|place| !looked_at.contains(place)).collect();
    assert_eq!(left, others);
    assert_eq!(privacy::retention_of(Table::FleetAudit), Retention::Year);
    assert!(looked_at.contains(&Place::Samples.as_str()));
}

#[tokio::test]
async fn nothing_gets_too_old_in_memory() {
    let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
    let store = MemoryStore::new(site(), StoreId(Arc::from("memory")), wall.clone());
    let frames = MemoryFrames::new(wall.clone(), u64::MAX);
    nothing_gets_too_old(World::new(wall, Arc::new(store), Arc::new(frames)).await).await;
}

#[tokio::test]
async fn nothing_gets_too_old_on_disk() {
    let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
    let dir = tempfile::tempdir().expect("a folder");
    let store = SqliteStore::open(dir.path(), site(), wall.clone()).await.expect("a store");
    let frames = SqliteFrames::open(dir.path(), site(), wall.clone(), u64::MAX).await.expect("a log");
    nothing_gets_too_old(World::new(wall, Arc::new(store), Arc::new(frames)).await).await;
}

#[tokio::test]
async fn nothing_gets_too_old_on_postgresql() {
    let wall = Arc::new(Wall(AtomicI64::new(BEGIN)));
    let config = PostgresConfig::new(PostgresServer::shared().database());
    let store = PostgresStore::open(&config, site(), wall.clone()).await.expect("a store");
    let frames = PostgresFrames::open(&config, site(), wall.clone(), u64::MAX).await.expect("a log");
    nothing_gets_too_old(World::new(wall, Arc::new(store), Arc::new(frames)).await).await;
}
