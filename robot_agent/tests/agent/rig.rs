//! A robot on a bench: the core with a body that does what the test says, a store that keeps, and a server that is the
//! test.

use crate::crowded::CrowdedSets;
use crate::release::Releases;
use crate::test_body::TestBody;
use midshift_agent::bugs::Bugs;
use midshift_agent::core::{AgentCore, CoreConfig, ExitReason, Input, Output};
use midshift_agent::memory::MemoryStore;
use midshift_agent::sets::Sets;
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::stop::storage::Loaded;
use midshift_agent::stop::{CheckIn, StopNews};
use midshift_agent::update::io::{UpdateWorker, Worker};
use midshift_agent::update::{Done, Failure, Job};
use midshift_core::authority::Authority;
use midshift_core::desired_state::{Assignment, DesiredWork, GrantedPlace, RoutePoint};
use midshift_core::ids::{AreaId, AttemptId, PlaceId, RobotId, Subject, TaskId, WaypointId};
use midshift_core::robot::WorkState;
use midshift_core::robot::{Lane, ReportedState};
use midshift_core::robot_events::{AttemptReport, InboxItem, PlaceNews, RobotEvent, SampleBody};
use midshift_core::step::{Effect, StepKind, WorkStep};
use midshift_core::stop::robot::SavedStops;
use midshift_core::time::{LinkTime, Now, SiteTime, Utc};
use midshift_core::update::UpdateState;
use midshift_proto::session::{ClockSample, Downlink, Echo, LaneAck, LaneBatch, StatusReplay, Uplink, Welcome};
use std::sync::Arc;
use tokio_util::sync::CancellationToken;

/// The bench.
pub struct Rig {
    pub core: AgentCore,
    pub body: TestBody,
    pub store: MemoryStore,
    pub ms: u64,
    pub hb: u64,
    pub epoch: u64,
    /// Writes do not become durable while this is set.
    pub slow_disk: bool,
    pub unwritten: Option<(u64, Vec<midshift_agent::store::Op>)>,
    pub events: Vec<RobotEvent>,
    pub messages: Vec<Uplink>,
    /// Old STATUS given to the bulk connection; a test answers.
    pub replays: Vec<StatusReplay>,
    pub reported: Option<ReportedState>,
    pub exit: Option<ExitReason>,
    /// Software that can be changed, and the ends of its jobs.
    pub updates: Option<Updates>,
    /// The stop service, which is the test, and the robot's file of stops.
    pub stop: StopDesk,
    generation: u64,
    heard: [u64; 3],
}

/// The stop service and the file of stops, as the test has them.
#[derive(Clone, Default)]
pub struct StopDesk {
    /// The robot has a stop line.
    pub is_there: bool,
    /// What it said, with the numbers.
    pub check_ins: Vec<(u64, CheckIn)>,
    /// Why it wants another line.
    pub redials: Vec<&'static str>,
    /// Its file refuses every write.
    pub disk_fails: bool,
    /// What its file holds.
    pub saved: SavedStops,
}

/// What a robot needs to change its software, and what happens to it on the way.
#[derive(Clone)]
pub struct Updates {
    pub releases: Releases,
    pub sets: MemorySets,
    /// Used instead of `sets` where a test wants real files.
    pub disk: Option<CrowdedSets>,
    /// Effects (commits and jobs) so far.
    pub effects: usize,
    /// The effect at which the power goes.
    pub cut_at: Option<usize>,
    /// The effect at which it goes was done; else it was not.
    pub last_is_done: bool,
    /// The power is gone: nothing has an effect any more.
    pub dark: bool,
    pub jobs: Vec<Job>,
    /// Calls of programs that migrate do not end well.
    pub migration_fails: bool,
    /// The ledger has no room: an agent that writes to it ends.
    pub ledger_is_full: bool,
    /// How far the wall clock is from the truth, milliseconds.
    pub jumped_ms: i64,
}

impl Updates {
    pub fn for_releases(releases: &Releases) -> Self {
        let (releases, sets) = (releases.clone(), MemorySets::new());
        Self {
            releases,
            sets,
            disk: None,
            effects: 0,
            cut_at: None,
            last_is_done: false,
            dark: false,
            jobs: Vec::new(),
            migration_fails: false,
            ledger_is_full: false,
            jumped_ms: 0,
        }
    }
    fn work(&self, job: Job) -> Done {
        if self.migration_fails && matches!(job, Job::Migrate { .. }) {
            return Done::Failed(Failure::Later("exit status: 1".to_owned()));
        }
        let remote = Arc::new(self.releases.clone());
        let sets: Box<dyn Sets> = match &self.disk {
            Some(disk) => Box::new(disk.clone()),
            None => Box::new(self.sets.clone()),
        };
        let mut worker = UpdateWorker::new(sets, remote);
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
        runtime.block_on(worker.work(job, CancellationToken::new()))
    }
    /// Whether the next effect happens, and whether its doer hears of it.
    fn effect(&mut self) -> (bool, bool) {
        if self.dark {
            return (false, false);
        }
        self.effects += 1;
        if self.cut_at == Some(self.effects) {
            self.dark = true;
            return (self.last_is_done, false);
        }
        (true, true)
    }
}

pub const START_MS: u64 = 1_000;

impl Rig {
    /// A robot that stands at `name` and has never worked.
    pub fn at(name: &str) -> Self {
        Self::with(TestBody::at(name), MemoryStore::new(), Bugs::default())
    }
    /// One whose software can be changed.
    pub fn updatable(releases: &Releases) -> Self {
        Self::updatable_with(releases, StopDesk::default())
    }
    /// One with a stop line, if there is one.
    pub fn updatable_with(releases: &Releases, stop: StopDesk) -> Self {
        let updates = Some(Updates::for_releases(releases));
        Self::new(TestBody::at("A"), MemoryStore::new(), Bugs::default(), updates, START_MS, stop)
    }
    pub fn with(body: TestBody, store: MemoryStore, bugs: Bugs) -> Self {
        Self::new(body, store, bugs, None, START_MS, StopDesk::default())
    }
    /// One that stands at `name` and has a stop line.
    pub fn stoppable(name: &str, stop: StopDesk) -> Self {
        Self::new(TestBody::at(name), MemoryStore::new(), Bugs::default(), None, START_MS, stop)
    }
    /// One that stands at A, has a stop line and can change its software, with naive rules.
    pub fn naive(releases: &Releases, bugs: Bugs) -> Self {
        let stop = StopDesk { is_there: true, ..StopDesk::default() };
        Self::new(TestBody::at("A"), MemoryStore::new(), bugs, Some(Updates::for_releases(releases)), START_MS, stop)
    }
    fn new(body: TestBody, store: MemoryStore, bugs: Bugs, updates: Option<Updates>, ms: u64, stop: StopDesk) -> Self {
        let memory = store.load_now("ring-1");
        let update = updates.as_ref().map(|u| u.releases.config());
        let config =
            CoreConfig { robot_id: RobotId::parse("rbt-01").expect("a name"), bugs, update, server_is_proven: true };
        let now = clocks_at(ms, updates.as_ref());
        let mut core = AgentCore::new(config, Box::new(body.clone()), memory, now);
        if stop.is_there {
            core.obeys_stops(Loaded { saved: stop.saved.clone(), is_durable: true }, LinkTime(ms));
        }
        let mut rig = Self {
            core,
            body,
            store,
            ms,
            hb: 0,
            epoch: 0,
            slow_disk: false,
            unwritten: None,
            events: Vec::new(),
            messages: Vec::new(),
            replays: Vec::new(),
            reported: None,
            exit: None,
            updates,
            stop,
            generation: 100,
            heard: [0; 3],
        };
        rig.give(Input::Start);
        rig
    }
    /// The process is killed and started again: what was not durable is gone.
    pub fn restart(self) -> Self {
        let updates = self.updates.map(|u| Updates { dark: false, ..u });
        let stop = StopDesk { check_ins: Vec::new(), redials: Vec::new(), ..self.stop };
        let mut next = Self::new(self.body, self.store, Bugs::default(), updates, self.ms, stop);
        next.generation = self.generation;
        next.heard = self.heard;
        next.epoch = self.epoch;
        next
    }
    pub fn give(&mut self, input: Input) {
        let mut inputs = vec![input];
        while let Some(input) = inputs.pop() {
            let now = clocks_at(self.ms, self.updates.as_ref());
            for output in self.core.step(now, input) {
                match output {
                    Output::Persist(batch, ops) if self.slow_disk => self.unwritten = Some((batch, ops)),
                    Output::Persist(batch, ops) => {
                        let (happens, is_heard) = self.write();
                        if happens {
                            self.store.commit_now(&ops);
                        }
                        inputs.extend(is_heard.then_some(Input::Persisted(batch)));
                    }
                    Output::Job(job) => {
                        if matches!(*job, Job::Migrate { .. }) {
                            let row = self.store.memory().expect("loaded").ledger.software.update;
                            assert_eq!(row.map(|u| u.state), Some(UpdateState::Committed), "it is durable");
                        }
                        let (happens, is_heard) = self.effect();
                        let done = self.updates.as_ref().filter(|_| happens).map(|u| u.work(Job::clone(&job)));
                        self.updates.iter_mut().for_each(|u| u.jobs.push(Job::clone(&job)));
                        inputs.extend(done.filter(|_| is_heard).map(|done| Input::Done(Box::new(done))));
                    }
                    Output::CheckIn(nonce, check_in) => self.stop.check_ins.push((nonce, *check_in)),
                    Output::RedialStop(why) => self.stop.redials.push(why),
                    Output::SaveStops(number, saved) => {
                        let is_durable = !self.stop.disk_fails;
                        if is_durable {
                            self.stop.saved = *saved;
                        }
                        inputs.push(Input::Stop(Box::new(StopNews::Saved { number, is_durable })));
                    }
                    Output::DropJob => {}
                    Output::Send(message) => self.sent(*message),
                    Output::Replay(replay) => self.replays.push(*replay),
                    Output::Exit(reason) => self.exit = Some(reason),
                }
            }
        }
    }
    fn effect(&mut self) -> (bool, bool) {
        self.updates.as_mut().map_or((true, true), Updates::effect)
    }
    /// As [`Rig::effect`], of a write to the ledger.
    fn write(&mut self) -> (bool, bool) {
        if let Some(updates) = &mut self.updates {
            updates.dark |= updates.ledger_is_full;
        }
        self.effect()
    }
    /// Highest number of a lane that was sent.
    pub fn heard(&self, lane: Lane) -> u64 {
        self.heard[lane as usize]
    }
    /// The disk catches up.
    pub fn flush(&mut self) {
        self.slow_disk = false;
        while let Some((batch, ops)) = self.unwritten.take() {
            self.store.commit_now(&ops);
            self.give(Input::Persisted(batch));
        }
    }
    fn sent(&mut self, message: Uplink) {
        if let Some(heartbeat) = &message.heartbeat {
            self.hb = heartbeat.reported.hb;
            self.reported = Some(heartbeat.reported.clone());
        }
        for batch in &message.batches {
            let heard = &mut self.heard[batch.lane as usize];
            for item in &batch.items {
                // As the server: what is known already is dropped.
                if let InboxItem::Sample(sample) = item
                    && sample.seq > *heard
                {
                    *heard = sample.seq;
                    if let SampleBody::Event(event) = &sample.body {
                        self.events.push(event.clone());
                    }
                }
            }
        }
        self.messages.push(message);
    }
    pub fn connect(&mut self) {
        self.epoch += 1;
        self.connect_as(Welcome { session_epoch: self.epoch, ..welcome() });
    }
    pub fn connect_as(&mut self, welcome: Welcome) {
        self.epoch = welcome.session_epoch;
        self.give(Input::Connected(welcome));
        self.echo();
    }
    pub fn down(&mut self, down: Downlink) {
        self.give(Input::Down(Box::new(down)));
    }
    /// The server has processed the newest heartbeat.
    pub fn echo(&mut self) {
        let echo = Some(Echo { hb: self.hb, clock: ClockSample::default(), is_clock_doubted: false });
        self.down(Downlink { echo, ..Downlink::default() });
    }
    /// Time passes without a word from the server.
    pub fn silence(&mut self, ms: u64) {
        for _ in 0..ms / 500 {
            self.ms += 500;
            self.give(Input::Tick);
        }
    }
    /// Time passes; each heartbeat is answered.
    pub fn pass(&mut self, ms: u64) {
        for _ in 0..ms / 500 {
            self.silence(500);
            self.echo();
        }
    }
    /// Permission anchored to the newest heartbeat.
    pub fn authority(&self, valid_ms: u64) -> Authority {
        Authority { session_epoch: self.epoch, hb: self.hb, valid_ms }
    }
    pub fn desired(&self, assignment: Option<Assignment>) -> DesiredWork {
        desired(assignment)
    }
    /// Sends desired work with the next generation.
    pub fn work(&mut self, work: DesiredWork) {
        self.generation += 1;
        let work = DesiredWork { generation: self.generation, ..work };
        self.down(Downlink { work: Some(work), ..Downlink::default() });
    }
    pub fn offer(&self, name: &str, epoch: u64, steps: Vec<WorkStep>, route: Vec<RoutePoint>) -> Assignment {
        Assignment {
            attempt: attempt(name, epoch),
            offer: self.authority(5_000),
            timeout_ms: 600_000,
            steps,
            from_step: 0,
            resume_step: 0,
            route_number: 1,
            released_index: Some(route.len().saturating_sub(1) as u32),
            route,
            stop: false,
            suspend: false,
            speed_limit_mm_s: None,
        }
    }
    pub fn grant(&self, place: &str, grant_id: u64) -> GrantedPlace {
        GrantedPlace { place_id: place_id(place), grant_id, entry: Some(self.authority(10_000)) }
    }
    /// Reports of attempts since the last call.
    pub fn reports(&mut self) -> Vec<AttemptReport> {
        let events = std::mem::take(&mut self.events);
        let (reports, rest): (Vec<_>, Vec<_>) = events.into_iter().partition(|e| matches!(e, RobotEvent::Attempt(_)));
        self.events = rest;
        reports.into_iter().filter_map(|e| if let RobotEvent::Attempt(r) = e { Some(r) } else { None }).collect()
    }
    pub fn states(&mut self) -> Vec<(WorkState, u32)> {
        self.reports().into_iter().map(|r| (r.state, r.step_index)).collect()
    }
    /// Reason codes of refusals since the last call.
    pub fn refusals(&mut self) -> Vec<String> {
        self.reports().into_iter().filter_map(|r| r.refusal).map(|r| r.code.to_string()).collect()
    }
    /// News of places since the last call.
    pub fn places(&mut self) -> Vec<(String, u64, PlaceNews)> {
        let events = std::mem::take(&mut self.events);
        let place = |e: &RobotEvent| match e {
            RobotEvent::Place { place_id, grant_id, news } => Some((place_id.to_string(), *grant_id, *news)),
            _ => None,
        };
        let found = events.iter().filter_map(place).collect();
        self.events = events.into_iter().filter(|e| place(e).is_none()).collect();
        found
    }
    pub fn stale(&self) -> usize {
        self.events.iter().filter(|e| matches!(e, RobotEvent::StaleAuthority { .. })).count()
    }
}

/// Desired work of generation 0 with this assignment, and nothing else.
pub fn desired(assignment: Option<Assignment>) -> DesiredWork {
    DesiredWork {
        robot_id: RobotId::parse("rbt-01").expect("a name"),
        generation: 0,
        assignment,
        grants: Vec::new(),
        held: false,
        resume: None,
        closed: Vec::new(),
        maintenance: None,
        resumed: Vec::new(),
        load_word: None,
    }
}

pub fn welcome() -> Welcome {
    Welcome {
        session_epoch: 1,
        session_secret: "secret".into(),
        store_id: "store-1".into(),
        acks: Vec::new(),
        heartbeat_period_ms: 1_000,
        status_period_ms: 2_000,
        authority_ms: 30_000,
        status_credit_bytes: 64 * 1024,
        protocol_version: 1,
        clock_rate_permille: 1_000,
        observed: false,
    }
}

pub fn now_at(ms: u64) -> Now {
    Now {
        site: SiteTime(ms),
        link: LinkTime(ms),
        utc: Utc(ms as i64),
        wall: Utc(1_700_000_000_000 + ms as i64),
        jump: None,
    }
}
/// As the clocks of a machine say it whose wall may have jumped.
fn clocks_at(ms: u64, updates: Option<&Updates>) -> Now {
    let (now, jumped_ms) = (now_at(ms), updates.map_or(0, |updates| updates.jumped_ms));
    Now { utc: Utc(now.utc.0 + jumped_ms), wall: Utc(now.wall.0 + jumped_ms), ..now }
}
pub fn ack(lane: Lane, seq: u64) -> LaneAck {
    LaneAck { lane, seq, expect: None }
}
pub fn items(messages: &[Uplink], lane: Lane) -> Vec<InboxItem> {
    let of = |b: &LaneBatch| if b.lane == lane { b.items.clone() } else { Vec::new() };
    messages.iter().flat_map(|m| m.batches.iter().flat_map(of)).collect()
}
pub fn waypoint(name: &str) -> WaypointId {
    WaypointId::parse(name).expect("a name")
}
pub fn place_id(name: &str) -> PlaceId {
    PlaceId::parse(name).expect("a name")
}
pub fn attempt(name: &str, epoch: u64) -> AttemptId {
    AttemptId { subject: Subject::Task(TaskId::parse(name).expect("a name")), epoch }
}
/// Waypoints lie on a line, by their first letter.
pub fn x_of(name: &str) -> i32 {
    i32::from(name.as_bytes()[0] - b'A') * 5_000
}
pub fn point(name: &str, ends_step: Option<u32>, standing: bool, passages: &[&str]) -> RoutePoint {
    RoutePoint {
        waypoint: waypoint(name),
        x_mm: x_of(name),
        y_mm: 0,
        ends_step,
        standing: standing.then(|| place_id(name)),
        passages: passages.iter().map(|p| place_id(p)).collect(),
        speed_limit_mm_s: None,
        area_id: AreaId::parse("hall").expect("a name"),
    }
}
pub fn step(kind: StepKind, effect: Effect) -> WorkStep {
    WorkStep { kind, effect, pause_allowed: true, cancel_allowed: true, timeout_ms: None, continue_on_fail: false }
}
pub fn goto(name: &str) -> WorkStep {
    step(StepKind::Goto { waypoint: waypoint(name) }, Effect::Repeatable)
}
pub fn action(name: &str, effect: Effect) -> WorkStep {
    step(StepKind::Action { name: name.into(), params: serde_json::Map::new() }, effect)
}
