//! A world for the reconciler: a store, a board, a clock, scripted robots, and somebody who plays task and telemetry.
//!
//! Every step of a world lets 250 ms pass, moves each robot, and looks whether a body is where it may not be.

mod laws;
mod robot;
mod seen;
mod shaky;

pub use laws::hold;
pub use robot::{Answer, Robot, jam, obstacle};
pub use seen::Seen;
pub use shaky::Shaky;

use midshift_core::fleet::bugs::Bugs;
use midshift_core::fleet::maps::MapChange;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::{RobotId, SiteId, TaskId};
use midshift_core::item::{Expect, Item};
use midshift_core::rows::{Entry, Record, Seq, Table, Writer};
use midshift_core::session::{LaneMark, Session};
use midshift_core::site::{Site, text};
use midshift_core::stop::record::StopRecord;
use midshift_core::task::forms::Transport;
use midshift_core::task::{Ask, Phase, RawTask, TaskIntake, TaskRequest, TaskState};
use midshift_core::time::{Clock, ScaledClock, Utc};
use midshift_fleet::{FleetService, MapOutdated, Parts};
use midshift_store::{LiveBoard, MemoryStore, Store, StoreId};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

/// UTC when every world begins.
pub const BEGIN: Utc = Utc(1_780_000_000_000);
const STEP: Duration = Duration::from_millis(250);
/// Steps until a condition is given up: an hour.
const STEPS_MAX: usize = 4 * 3600;

/// One reconciler at work.
struct Running {
    /// A reconciler whose face is gone ends.
    _face: FleetService,
    shutdown: CancellationToken,
    task: JoinHandle<Result<(), MapOutdated>>,
}

pub struct World {
    pub store: Arc<dyn Store>,
    /// The store as fleet sees it.
    pub shaky: Arc<Shaky>,
    pub board: Arc<LiveBoard<NewestHeartbeat>>,
    pub clock: Arc<dyn Clock>,
    pub site: Arc<Site>,
    pub fleet: FleetService,
    /// What became of the map when fleet starts next.
    pub map: MapChange,
    text: &'static str,
    bugs: Bugs,
    robots: BTreeMap<String, Robot>,
    running: Vec<Running>,
    submitted: u64,
    asked: u64,
}

impl World {
    /// A world on `site` with one reconciler, past the time in which no timer fires.
    pub async fn on(site: &'static str) -> Self {
        let mut world = Self::at_start(site).await;
        world.pass(11).await;
        world
    }

    /// A world whose reconciler has just started.
    pub async fn at_start(site_text: &'static str) -> Self {
        Self::with(site_text, Bugs::default()).await
    }

    /// As [`World::at_start`], with naive rules.
    pub async fn with(site_text: &'static str, bugs: Bugs) -> Self {
        Self::over(site_text, bugs, alone).await
    }

    /// As [`World::on`], where other processes may come.
    pub async fn shared(site_text: &'static str) -> Self {
        let mut world = Self::over(site_text, Bugs::default(), in_company).await;
        world.pass(11).await;
        world
    }

    /// A world over a store of the caller's.
    pub async fn over(
        site_text: &'static str,
        bugs: Bugs,
        store: impl AsyncFnOnce(SiteId, Arc<dyn Clock>) -> Arc<dyn Store>,
    ) -> Self {
        let begun = Instant::now();
        let monotonic = move || begun.elapsed().as_micros() as u64;
        let clock: Arc<dyn Clock> = Arc::new(ScaledClock::new(monotonic, BEGIN, 1000));
        let site = Arc::new(text::parse(site_text).expect("a site"));
        let (store, board) = (store(site.site_id().clone(), clock.clone()).await, LiveBoard::new());
        let shaky = Shaky::over(store.clone());
        let parts = Parts {
            store: shaky.clone(),
            board: board.clone(),
            site: site.clone(),
            site_text: site_text.to_owned(),
            map: MapChange::Taken,
            clock: clock.clone(),
            bugs,
        };
        let (fleet, running) = start(parts);
        let robots = BTreeMap::new();
        let running = vec![running];
        let (text, submitted, asked) = (site_text, 0, 0);
        let mut world = Self {
            store,
            shaky,
            board,
            clock,
            site,
            fleet,
            map: MapChange::Taken,
            text,
            bugs,
            robots,
            running,
            submitted,
            asked,
        };
        world.step().await;
        world
    }

    fn parts(&self) -> Parts {
        Parts {
            store: self.shaky.clone(),
            board: self.board.clone(),
            site: self.site.clone(),
            site_text: self.text.to_owned(),
            map: self.map.clone(),
            clock: self.clock.clone(),
            bugs: self.bugs,
        }
    }

    /// One more reconciler over the same store.
    pub fn second_reconciler(&mut self) {
        let (_, running) = start(self.parts());
        self.running.push(running);
    }

    /// One more reconciler as another process has it: with its own face and its own way to the store.
    pub fn other_process(&mut self) -> (FleetService, Arc<Shaky>) {
        self.other_process_on(self.store.clone())
    }

    /// As [`World::other_process`], started with another map than this world's.
    pub fn other_process_by(&mut self, site_text: &str) -> (FleetService, Arc<Shaky>) {
        let (site, site_text) = (Arc::new(text::parse(site_text).expect("a site")), site_text.to_owned());
        let shaky = Shaky::over(self.store.clone());
        let (fleet, running) = start(Parts { store: shaky.clone(), site, site_text, ..self.parts() });
        self.running.push(running);
        (fleet, shaky)
    }

    /// As [`World::other_process`], on a handle of its own.
    pub fn other_process_on(&mut self, store: Arc<dyn Store>) -> (FleetService, Arc<Shaky>) {
        let shaky = Shaky::over(store);
        let (fleet, running) = start(Parts { store: shaky.clone(), ..self.parts() });
        self.running.push(running);
        (fleet, shaky)
    }

    /// The oldest reconciler is gone, as if its process had been killed.
    pub async fn kill_first(&mut self) {
        let running = self.running.remove(0);
        running.task.abort();
        assert!(running.task.await.is_err_and(|e| e.is_cancelled()), "it ran");
    }

    /// The oldest reconciler ends as it is asked to.
    pub async fn end_first(&mut self) {
        let running = self.running.remove(0);
        running.shutdown.cancel();
        running.task.await.expect("the reconciler ends").expect("as it was asked to");
    }

    /// The newest reconciler has ended by itself: why.
    pub async fn last_outdated(&mut self) -> MapOutdated {
        let running = self.running.pop().expect("a reconciler");
        running.task.await.expect("it ends").expect_err("nobody asked it to")
    }

    /// Ends every reconciler; rows stay, the projection goes.
    pub async fn stop_fleet(&mut self) {
        for running in self.running.drain(..) {
            running.shutdown.cancel();
            running.task.await.expect("the reconciler ends").expect("as it was asked to");
        }
    }

    pub fn start_fleet(&mut self) {
        let (fleet, running) = start(self.parts());
        self.fleet = fleet;
        self.running.push(running);
    }

    /// As on another machine, from a backup of this moment: nobody is heard, and no robot has come yet.
    pub async fn restore(&mut self) {
        self.stop_fleet().await;
        self.robots.values_mut().for_each(Robot::cut);
        self.board = LiveBoard::new();
        self.start_fleet();
    }

    // --- robots and telemetry

    /// A robot that stands at `waypoint`, is heard, and does what it is told.
    pub async fn robot(&mut self, id: &str, waypoint: &str) {
        self.robots.insert(id.to_owned(), Robot::new(id, waypoint, &self.site));
        self.connect(id).await;
    }

    /// A new session of the robot, with its first heartbeat.
    pub async fn connect(&mut self, id: &str) {
        let wall = self.clock.now().wall.0 as u64;
        let robot = self.robots.get_mut(id).expect("a robot");
        robot.new_session(wall);
        let session = robot.session();
        let mark = robot.lane_mark();
        let known = midshift_store::load::<Session>(&*self.store, id).await.expect("a session").map(|(_, r)| r);
        let marked =
            midshift_store::load::<LaneMark>(&*self.store, &format!("{id}/{}", mark.ring)).await.expect("a mark");
        let mut item = Item::new(Writer::Telemetry, id);
        item.put_row(&session, known.map_or(Expect::Absent, Expect::At), "session.opened");
        if marked.is_none() {
            item.create(&mark, "lane.marked");
        }
        self.commit(item).await;
        self.beat(id);
    }

    /// The robot, to change what it does from now on.
    pub fn r(&mut self, id: &str) -> &mut Robot {
        self.robots.get_mut(id).expect("a robot")
    }

    /// Telemetry has met a second machine with the robot's name.
    pub async fn clone_seen(&self, id: &str) {
        self.told_by_telemetry(id, midshift_core::fleet::CLONE_SEEN, "{}").await;
    }

    /// Telemetry states this about a machine with the robot's name.
    pub async fn told_by_telemetry(&self, id: &str, kind: &'static str, body: &str) {
        let mut item = Item::new(Writer::Telemetry, id);
        item.facts.push(midshift_core::item::Fact {
            log: midshift_core::rows::Log::Telemetry,
            subject: Arc::from(id),
            kind,
            body: body.into(),
        });
        self.commit(item).await;
    }

    /// What the robot says now, beside its usual heartbeat.
    pub fn beat(&mut self, id: &str) {
        let now = self.clock.now();
        let live = self.r(id).heartbeat(&now);
        self.board.publish(&RobotId::parse(id).expect("an id"), Arc::new(live));
    }

    /// Telemetry stores what the robot has written and not yet delivered.
    pub async fn deliver(&mut self, id: &str) {
        let robot = self.robots.get_mut(id).expect("a robot");
        let entries = robot.undelivered();
        for (seq, entry) in entries {
            let mut mark = robot.lane_mark();
            mark.event = seq;
            let found = midshift_store::load::<LaneMark>(&*self.store, &format!("{id}/{}", mark.ring)).await;
            let (known, revision) = found.expect("a store").expect("a mark");
            assert_eq!(known.event + 1, seq, "events arrive in order, none twice");
            let mut item = Item::new(Writer::Telemetry, id);
            item.update(&mark, revision, "lane.marked");
            item.facts.push(midshift_core::item::Fact {
                log: midshift_core::rows::Log::RobotInbox,
                subject: Arc::from(id),
                kind: "robot.event",
                body: serde_json::to_string(&entry).expect("JSON").into(),
            });
            for result in self.store.commit(vec![item]).await {
                result.expect("telemetry's item");
            }
        }
    }

    // --- tasks, as the task service writes them

    /// A transport as the article's short form says it, with a retry limit of none.
    pub async fn submit(&mut self, id: &str, from: &str, to: &str) {
        self.submit_with(id, from, to, |_| {}).await;
    }

    pub async fn submit_with(&mut self, id: &str, from: &str, to: &str, change: impl FnOnce(&mut RawTask)) {
        let transport = Transport {
            kind: "transport".to_owned(),
            from_waypoint: from.to_owned(),
            to_waypoint: to.to_owned(),
            timeout_ms: Some(3_600_000),
            ..Transport::default()
        };
        let mut raw = transport.into_raw();
        change(&mut raw);
        let site = self.site.clone();
        let spec = raw.check("task", &|w| site.find(w).is_some()).expect("a good task");
        self.submitted += 1;
        let intake = TaskIntake {
            task_id: TaskId::parse(id).expect("an id"),
            spec,
            actor: "tests".to_owned(),
            request_id: String::new(),
            payload_hash: String::new(),
            created: self.clock.now().utc,
            number: self.submitted,
            type_revision: None,
        };
        let mut item = Item::new(Writer::Task, "tests");
        item.create(&intake, "task.admitted").create(&TaskState::born(&intake), "task.queued");
        self.commit(item).await;
    }

    /// What is submitted next comes from a process that began to count its admissions at `number`.
    pub fn number_from(&mut self, number: u64) {
        self.submitted = number - 1;
    }

    /// A request as the task service stores it.
    pub async fn ask(&mut self, ask: Ask) {
        self.asked += 1;
        let request = TaskRequest {
            id: format!("ask-{}", self.asked),
            ask,
            reason: "a test asks".to_owned(),
            actor: "tests".to_owned(),
            at_unix_ms: self.clock.now().wall.0,
        };
        let mut item = Item::new(Writer::Task, "tests");
        item.create(&request, "task.requested");
        self.commit(item).await;
    }

    pub async fn cancel(&mut self, id: &str, force: bool) {
        self.ask(Ask::Cancel { task_id: TaskId::parse(id).expect("an id"), force }).await;
    }

    pub async fn resume(&mut self, robot: &str) {
        let robot_ids = vec![RobotId::parse(robot).expect("an id")];
        self.ask(Ask::ResumeHeld { stop_id: None, area_id: None, task_ids: Vec::new(), robot_ids }).await;
    }

    /// The copy of a stop, as it stands now.
    pub async fn stop(&self, record: &StopRecord) {
        let known = midshift_store::load::<StopRecord>(&*self.store, &record.id()).await.expect("a store");
        let mut item = Item::new(Writer::Stop, "tests");
        item.put_row(record, known.map_or(Expect::Absent, |(_, revision)| Expect::At(revision)), "stop.copied");
        self.commit(item).await;
    }

    /// Fleet's own rows, as an earlier fleet has left them.
    pub async fn left_behind<R: midshift_core::rows::Record>(&self, rows: &[R]) {
        for some in rows.chunks(100) {
            let mut item = Item::new(Writer::Fleet, "tests");
            some.iter().for_each(|row| {
                item.create(row, "tests.left_behind");
            });
            self.commit(item).await;
        }
    }

    async fn commit(&self, item: Item) {
        for result in self.store.commit(vec![item]).await {
            result.expect("an item of nobody else's rows");
        }
    }

    // --- time

    /// 250 ms: robots read what they should do, do it, tell it and beat.
    pub async fn step(&mut self) {
        tokio::time::sleep(STEP).await;
        let now = self.clock.now();
        let ids: Vec<String> = self.robots.keys().cloned().collect();
        for id in &ids {
            let desired = midshift_store::load(&*self.store, id).await.expect("desired work").map(|(row, _)| row);
            let robot = self.robots.get_mut(id).expect("a robot");
            robot.step(desired, &now);
            if robot.tells {
                self.deliver(id).await;
            }
            if self.robots[id].due(&now) {
                self.beat(id);
            }
        }
        self.nobody_where_it_may_not_be();
    }

    fn nobody_where_it_may_not_be(&self) {
        let mut inside: BTreeMap<&str, u32> = BTreeMap::new();
        for robot in self.robots.values() {
            for place in robot.inside() {
                *inside.entry(place).or_default() += 1;
            }
        }
        for place in self.site.places() {
            let bodies = inside.get(place.place_id.as_str()).copied().unwrap_or(0);
            assert!(bodies <= place.capacity, "{bodies} robots in {}", place.place_id);
        }
    }

    pub async fn pass(&mut self, secs: u64) {
        for _ in 0..secs * 4 {
            self.step().await;
        }
    }

    /// Lets time pass while `holds` is true of every moment.
    pub async fn pass_while(&mut self, secs: u64, what: &str, holds: impl Fn(&Seen) -> bool) {
        for _ in 0..secs * 4 {
            self.step().await;
            let seen = self.seen().await;
            assert!(holds(&seen), "not any more: {what}\n{}", seen.told());
        }
    }

    /// Lets time pass until `holds`.
    pub async fn until(&mut self, what: &str, holds: impl Fn(&Seen) -> bool) -> Seen {
        for _ in 0..STEPS_MAX {
            let seen = self.seen().await;
            if holds(&seen) {
                return seen;
            }
            self.step().await;
        }
        panic!("never: {what}\n{}", self.seen().await.told());
    }

    pub async fn until_phase(&mut self, id: &str, phase: Phase) -> Seen {
        self.until(&format!("{id} is {}", phase.as_str()), |s| s.task(id).phase == phase).await
    }

    /// All rows as they are now.
    pub async fn seen(&self) -> Seen {
        let snapshot = self.store.snapshot(Table::ALL).await.expect("a snapshot");
        Seen::of(snapshot.rows)
    }

    /// The end of a test: what was written from the beginning keeps the laws.
    pub async fn lawful(self) {
        laws::hold(&self.written().await);
    }

    /// All that was ever written.
    pub async fn written(&self) -> Vec<Entry> {
        let mut after = Seq(0);
        let mut entries = Vec::new();
        loop {
            let page = self.store.feed(after, &midshift_core::rows::Log::ALL, 5_000).await.expect("the feed");
            after = page.next;
            entries.extend(page.entries);
            if page.next >= page.head {
                break;
            }
        }
        entries
    }

    /// Every robot's id.
    pub fn robot_ids(&self) -> Vec<String> {
        self.robots.keys().cloned().collect()
    }
}

fn in_memory(site_id: SiteId, clock: Arc<dyn Clock>) -> MemoryStore {
    MemoryStore::new(site_id, StoreId(Arc::from("world")), clock)
}

async fn alone(site_id: SiteId, clock: Arc<dyn Clock>) -> Arc<dyn Store> {
    Arc::new(in_memory(site_id, clock))
}

/// A store that says of itself that other processes have it too.
async fn in_company(site_id: SiteId, clock: Arc<dyn Clock>) -> Arc<dyn Store> {
    Arc::new(in_memory(site_id, clock).shared())
}

fn start(parts: Parts) -> (FleetService, Running) {
    let (fleet, reconciler) = FleetService::new(parts);
    let shutdown = CancellationToken::new();
    let token = shutdown.clone();
    let task = tokio::spawn(reconciler.run(token));
    (fleet.clone(), Running { _face: fleet, shutdown, task })
}
