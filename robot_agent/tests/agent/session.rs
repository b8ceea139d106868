//! The shell against a server that the test plays, over pipes in memory and on tokio's paused clock.

use crate::release::{Releases, component};
use crate::rig::{attempt, desired, goto, point, waypoint, welcome};
use crate::test_body::TestBody;
use async_trait::async_trait;
use hyper_util::rt::TokioIo;
use midshift_agent::body::BodyNews;
use midshift_agent::bugs::Bugs;
use midshift_agent::bulk::Bulk;
use midshift_agent::core::ExitReason;
use midshift_agent::dial::{self, Cut, Dial};
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{AgentConfig, Error, Lines, Updates, run};
use midshift_agent::sets::memory::MemorySets;
use midshift_agent::sets::{FileRef, Sets};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::{Op, Store};
use midshift_agent::update::SoftwareRow;
use midshift_agent::update::io::UpdateWorker;
use midshift_bundle::digest::Digest;
use midshift_bundle::installed;
use midshift_bundle::manifest::ComponentKind;
use midshift_bundle::set::SetManifest;
use midshift_core::authority::Authority;
use midshift_core::desired_state::{Assignment, DesiredWork};
use midshift_core::ids::RobotId;
use midshift_core::reason::{Code, Kind, Refusal};
use midshift_core::robot::WorkState;
use midshift_core::robot::{Lane, Mode, Vitals};
use midshift_core::robot_events::{InboxItem, RobotEvent, SampleBody};
use midshift_core::time::{Clock, LinkDuration, ScaledClock, Utc};
use midshift_proto::convert::parse;
use midshift_proto::link::v1;
use midshift_proto::link::v1::link_service_server::{LinkService, LinkServiceServer};
use midshift_proto::link::v1::replay_service_server::{ReplayService, ReplayServiceServer};
use midshift_proto::session::{
    ClockSample, Close, CloseCode, Downlink, Echo, FromRobot, Hello, LaneAck, StatusReplay, ToRobot, Uplink, Welcome,
};
use std::sync::Arc;
use std::time::Duration;
use tokio::io::DuplexStream;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::{Channel, Server, Uri};
use tonic::{Request, Response, Status, Streaming};

type Down = mpsc::Sender<Result<v1::SessionResponse, Status>>;

/// One session as the server has it.
pub struct Seen {
    up: Streaming<v1::SessionRequest>,
    down: Down,
}

impl Seen {
    /// None: it is over.
    pub async fn next(&mut self) -> Option<FromRobot> {
        let message = self.up.message().await.ok()??;
        Some(parse(message).expect("what a robot says can be read"))
    }
    pub async fn hello(&mut self) -> Hello {
        match self.next().await {
            Some(FromRobot::Hello(hello)) => *hello,
            other => panic!("no hello: {other:?}"),
        }
    }
    async fn uplink(&mut self) -> Uplink {
        match self.next().await {
            Some(FromRobot::Uplink(uplink)) => uplink,
            other => panic!("no uplink: {other:?}"),
        }
    }
    /// The next heartbeat, answered.
    async fn beat(&mut self) -> u64 {
        loop {
            if let Some(heartbeat) = self.uplink().await.heartbeat {
                let hb = heartbeat.reported.hb;
                let echo = Some(Echo { hb, clock: ClockSample::default(), is_clock_doubted: false });
                self.send(ToRobot::Downlink(Box::new(Downlink { echo, ..Downlink::default() }))).await;
                return hb;
            }
        }
    }
    /// The next event.
    async fn event(&mut self) -> RobotEvent {
        loop {
            for item in self.uplink().await.batches.into_iter().filter(|b| b.lane == Lane::Event).flat_map(|b| b.items)
            {
                if let InboxItem::Sample(sample) = item
                    && let SampleBody::Event(event) = sample.body
                {
                    return event;
                }
            }
        }
    }
    pub async fn send(&self, message: ToRobot) {
        self.down.send(Ok(v1::SessionResponse::from(&message))).await.expect("the robot listens");
    }
    pub async fn welcome(&self, session_epoch: u64) {
        self.welcome_as(session_epoch, false).await;
    }
    async fn welcome_as(&self, session_epoch: u64, observed: bool) {
        let session_secret = format!("s{session_epoch}").into();
        self.send(ToRobot::Welcome(Welcome { session_epoch, session_secret, observed, ..welcome() })).await;
    }
    async fn close(&self, code: CloseCode) {
        self.send(ToRobot::Close(Close { code, reason: Code::Fenced.into(), retry_after_ms: 0 })).await;
    }
}

/// A server's end of sessions.
pub struct Desk(pub mpsc::Sender<Seen>);

#[async_trait]
impl LinkService for Desk {
    type SessionStream = ReceiverStream<Result<v1::SessionResponse, Status>>;
    async fn session(
        &self,
        request: Request<Streaming<v1::SessionRequest>>,
    ) -> Result<Response<Self::SessionStream>, Status> {
        let (down, queue) = mpsc::channel(16);
        let seen = Seen { up: request.into_inner(), down };
        self.0.send(seen).await.map_err(|_| Status::unavailable("the test is over"))?;
        Ok(Response::new(ReceiverStream::new(queue)))
    }
}

/// Old STATUS that a robot wants to have stored; the test answers.
struct Asked {
    replay: StatusReplay,
    answer: oneshot::Sender<LaneAck>,
}

struct Shelf(mpsc::Sender<Asked>);

#[async_trait]
impl ReplayService for Shelf {
    async fn replay_status(
        &self,
        request: Request<v1::ReplayStatusRequest>,
    ) -> Result<Response<v1::ReplayStatusResponse>, Status> {
        let replay = parse(request.into_inner()).expect("what a robot says can be read");
        let (answer, answered) = oneshot::channel();
        let over = || Status::unavailable("the test is over");
        self.0.send(Asked { replay, answer }).await.map_err(|_| over())?;
        let ack = answered.await.map_err(|_| over())?;
        Ok(Response::new((&ack).into()))
    }
}

/// Pipes instead of a network.
pub struct Pipes {
    pub ends: mpsc::Sender<Result<DuplexStream, std::io::Error>>,
    pub network: watch::Receiver<bool>,
}

#[async_trait]
impl Dial for Pipes {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let (ends, network) = (self.ends.clone(), self.network.clone());
        let connect = tower::service_fn(move |_: Uri| {
            let (ends, network) = (ends.clone(), network.clone());
            async move {
                let mut up = network.clone();
                up.wait_for(|up| *up).await.map_err(std::io::Error::other)?;
                let (near, far) = tokio::io::duplex(64 * 1024);
                ends.send(Ok(far)).await.map_err(std::io::Error::other)?;
                Ok::<_, std::io::Error>(TokioIo::new(Cut::new(near, Some(network))))
            }
        });
        let endpoint = dial::endpoint("http://server")?;
        endpoint.connect_with_connector(connect).await.map_err(|e| dial::Error(e.into()))
    }
}

/// A robot at work and the desk of its server.
struct Bench {
    sessions: mpsc::Receiver<Seen>,
    replays: mpsc::Receiver<Asked>,
    network: watch::Sender<bool>,
    body: TestBody,
    shutdown: CancellationToken,
    agent: JoinHandle<Result<ExitReason, Error>>,
}

/// The agent of `rbt-01`, with no line to a stop service.
pub fn config(update: Option<Updates>) -> AgentConfig {
    AgentConfig {
        stop: None,
        update,
        robot_id: RobotId::parse("rbt-01").expect("a name"),
        boot_id: "boot-1".into(),
        new_ring_id: "ring-1".into(),
        seed: 7,
        bugs: Bugs::default(),
        pulse: None,
    }
}

/// A clock that goes with tokio's time and shows this now.
pub fn clock(now: Utc) -> Arc<dyn Clock> {
    let start = tokio::time::Instant::now();
    Arc::new(ScaledClock::new(move || start.elapsed().as_micros() as u64, now, 1_000))
}

impl Bench {
    fn new(store: Box<dyn Store>) -> Self {
        Self::with(store, None)
    }
    fn with(store: Box<dyn Store>, update: Option<Updates>) -> Self {
        let (ends, incoming) = mpsc::channel(4);
        let (seen, sessions) = mpsc::channel(4);
        let (asked, replays) = mpsc::channel(4);
        let (network, up) = watch::channel(true);
        let (desk, shelf) = (LinkServiceServer::new(Desk(seen)), ReplayServiceServer::new(Shelf(asked)));
        let server = Server::builder().add_service(desk).add_service(shelf);
        tokio::spawn(server.serve_with_incoming(ReceiverStream::new(incoming)));
        let (config, clock) = (config(update), clock(Utc(1_700_000_000_000)));
        let (body, shutdown) = (TestBody::at("A"), CancellationToken::new());
        let link = Arc::new(Pipes { ends, network: up });
        let lines = Lines { bulk: Bulk::new(link.clone()), link };
        let agent = tokio::spawn(run(config, Box::new(body.clone()), store, clock, lines, shutdown.clone()));
        Self { sessions, replays, network, body, shutdown, agent }
    }
    async fn session(&mut self) -> Seen {
        self.sessions.recv().await.expect("the robot dials")
    }
    async fn end(self) -> ExitReason {
        self.shutdown.cancel();
        self.agent.await.expect("no panic").expect("no error")
    }
}

#[tokio::test(start_paused = true)]
async fn a_robot_says_hello_beats_each_second_and_proves_its_succession_after_a_break() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut first = bench.session().await;
    let hello = first.hello().await;
    assert_eq!((hello.robot_id.as_str(), hello.ring.as_str(), hello.previous), ("rbt-01", "ring-1", None));
    first.welcome(5).await;
    let begin = tokio::time::Instant::now();
    for hb in 1..=4 {
        assert_eq!(first.beat().await, hb);
    }
    let seconds = begin.elapsed().as_secs_f64();
    assert!((2.5..3.5).contains(&seconds), "four beats take three seconds of the clock, not {seconds}");
    drop(first);
    let mut second = bench.session().await;
    let previous = second.hello().await.previous.expect("a proof");
    assert_eq!((previous.session_epoch, previous.secret.reveal()), (5, "s5"));
    second.welcome(6).await;
    assert_eq!(second.beat().await, 1);
    assert_eq!(bench.end().await, ExitReason::Shutdown);
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_fenced_twice_ends() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let begin = tokio::time::Instant::now();
    for epoch in [5, 6] {
        let mut session = bench.session().await;
        session.hello().await;
        session.welcome(epoch).await;
        session.beat().await;
        session.close(CloseCode::Fenced).await;
    }
    assert_eq!(bench.agent.await.expect("no panic").expect("no error"), ExitReason::FencedTwice);
    assert!(begin.elapsed() >= Duration::from_secs(60), "it came back at once");
}

#[tokio::test(start_paused = true)]
async fn a_server_that_falls_silent_is_given_up_and_dialed_again() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut first = bench.session().await;
    first.hello().await;
    first.welcome(5).await;
    first.beat().await;
    let begin = tokio::time::Instant::now();
    let mut second = bench.session().await;
    let waited = begin.elapsed().as_secs();
    assert!((10..25).contains(&waited), "{waited} s");
    assert!(second.hello().await.previous.is_some());
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_robot_that_is_only_observed_dials_ever_more_rarely_and_soon_when_it_may_take_charge() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut held = vec![bench.session().await];
    let mut waits = Vec::new();
    for epoch in 5..10 {
        let session = held.last_mut().expect("a session");
        session.hello().await;
        session.welcome_as(epoch, true).await;
        let begin = tokio::time::Instant::now();
        held.push(bench.session().await);
        waits.push(begin.elapsed().as_secs());
    }
    let is_about = |(waited, wanted): (&u64, u64)| (wanted..wanted + 3).contains(waited);
    assert!(waits.iter().zip([10, 20, 40, 60, 60]).all(is_about), "{waits:?}");
    let session = held.last_mut().expect("a session");
    session.hello().await;
    session.welcome_as(10, true).await;
    session.close(CloseCode::MoveOver).await;
    let begin = tokio::time::Instant::now();
    let mut in_charge = bench.session().await;
    assert!(begin.elapsed() < Duration::from_secs(2), "{:?}", begin.elapsed());
    in_charge.hello().await;
    in_charge.welcome(11).await;
    in_charge.beat().await;
    let begin = tokio::time::Instant::now();
    bench.session().await;
    assert!(begin.elapsed() < Duration::from_secs(15), "one that is in charge hears silence as soon as ever");
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_server_that_is_overloaded_is_asked_again_when_it_says_and_not_sooner() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut refused = bench.session().await;
    refused.hello().await;
    let overloaded = Refusal::new(Kind::Exhausted, Code::Overloaded).again_after(LinkDuration::from_secs(5));
    refused.down.send(Err(midshift_proto::status(&overloaded, None))).await.expect("the robot listens");
    let begin = tokio::time::Instant::now();
    let mut second = bench.session().await;
    let waited = begin.elapsed();
    assert!((Duration::from_secs(5)..Duration::from_secs(7)).contains(&waited), "{waited:?}");
    second.hello().await;
    // Nobody can send a robot away for long.
    let for_ever = Refusal::new(Kind::Exhausted, Code::Overloaded).again_after(LinkDuration::from_secs(86_400));
    second.down.send(Err(midshift_proto::status(&for_ever, None))).await.expect("the robot listens");
    let begin = tokio::time::Instant::now();
    let mut third = bench.session().await;
    assert!(begin.elapsed() < Duration::from_secs(12), "{:?}", begin.elapsed());
    third.hello().await;
    third.welcome(5).await;
    assert_eq!(third.beat().await, 1);
    bench.end().await;
}

/// Sends the robot away, so many times, and tells how long it was away the last time.
async fn is_away(bench: &mut Bench, session: &mut Seen, again_after: Option<LinkDuration>, times: usize) -> Duration {
    let mut away = Duration::ZERO;
    for _ in 0..times {
        session.hello().await;
        let overloaded = Refusal::new(Kind::Exhausted, Code::Overloaded);
        let asked = again_after.map(|after| midshift_proto::status(&overloaded.again_after(after), None));
        let status = asked.unwrap_or_else(|| Status::unavailable("no server here"));
        session.down.send(Err(status)).await.expect("the robot listens");
        let begin = tokio::time::Instant::now();
        *session = bench.session().await;
        away = begin.elapsed();
    }
    away
}

#[tokio::test(start_paused = true)]
async fn what_a_robot_waited_while_nobody_said_when_to_come_does_not_keep_it_from_its_turn() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut session = bench.session().await;
    let unasked = is_away(&mut bench, &mut session, None, 9).await;
    assert!((Duration::from_secs(5)..=Duration::from_secs(10)).contains(&unasked), "{unasked:?}");
    let asked = is_away(&mut bench, &mut session, Some(LinkDuration::from_secs(1)), 1).await;
    assert!((Duration::from_secs(1)..Duration::from_millis(2_100)).contains(&asked), "{asked:?}");
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_server_that_sends_a_robot_away_again_and_again_is_asked_less_and_less_often() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut session = bench.session().await;
    let asked = is_away(&mut bench, &mut session, Some(LinkDuration(1)), 9).await;
    assert!((Duration::from_secs(5)..=Duration::from_secs(10)).contains(&asked), "{asked:?}");
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn asked_to_move_over_it_opens_the_next_session_before_the_old_one_closes() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut old = bench.session().await;
    old.hello().await;
    old.welcome(5).await;
    old.beat().await;
    old.send(ToRobot::MoveOver { within_ms: 30_000 }).await;
    let mut next = bench.session().await;
    next.hello().await;
    // Meanwhile the old one lives.
    old.beat().await;
    // The server closes the old one as fenced before it welcomes the new one: that is no clone.
    old.close(CloseCode::Fenced).await;
    next.welcome(6).await;
    assert_eq!(next.beat().await, 1);
    assert!(!bench.agent.is_finished());
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn over_a_cut_network_nothing_passes_and_afterwards_what_happened_is_told() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    let mut first = bench.session().await;
    first.hello().await;
    first.welcome(5).await;
    first.beat().await;
    bench.network.send(false).expect("the robot looks");
    bench.body.says(BodyNews::Mode(Mode::Manual));
    let nothing = tokio::time::timeout(Duration::from_secs(20), async {
        loop {
            if let Some(FromRobot::Uplink(uplink)) = first.next().await {
                assert_eq!(uplink.batches, [], "nothing of the cut arrives");
            } else {
                std::future::pending::<()>().await;
            }
        }
    });
    assert!(nothing.await.is_err());
    assert!(bench.sessions.try_recv().is_err(), "nobody dials over a cut network");
    bench.network.send(true).expect("the robot looks");
    let mut second = bench.session().await;
    second.hello().await;
    second.welcome(6).await;
    assert_eq!(second.event().await, RobotEvent::Mode(Mode::Manual));
    bench.end().await;
}

#[tokio::test]
async fn a_robot_on_its_file_takes_work_over_the_wire_and_does_it() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("robot.db");
    let mut bench = Bench::new(Box::new(SqliteStore::open(&path).await.expect("opens")));
    let mut session = bench.session().await;
    session.hello().await;
    session.welcome(5).await;
    let hb = session.beat().await;
    let route = vec![point("A", None, false, &[]), point("B", Some(0), false, &[])];
    let assignment = Assignment {
        attempt: attempt("T1", 1),
        offer: Authority { session_epoch: 5, hb, valid_ms: 5_000 },
        timeout_ms: 60_000,
        steps: vec![goto("B")],
        from_step: 0,
        resume_step: 0,
        route_number: 1,
        route,
        released_index: Some(1),
        stop: false,
        suspend: false,
        speed_limit_mm_s: None,
    };
    let work = DesiredWork { generation: 1, ..desired(Some(assignment)) };
    session.send(ToRobot::Downlink(Box::new(Downlink { work: Some(work), ..Downlink::default() }))).await;
    let mut states = Vec::new();
    while states.last() != Some(&WorkState::Succeeded) {
        let RobotEvent::Attempt(report) = session.event().await else { continue };
        states.push(report.state);
        if report.state == WorkState::Navigating {
            bench.body.reach();
        }
    }
    assert_eq!(states, [WorkState::Accepted, WorkState::Navigating, WorkState::Succeeded]);
    assert_eq!(bench.body.log().waypoint, Some(waypoint("B")));
    bench.end().await;
    let kept = SqliteStore::open(&path).await.expect("opens").load("other").await.expect("loads");
    assert!(kept.ledger.finished(&attempt("T1", 1).subject).is_some());
}

/// Sets of a robot that committed one beside what it came with.
fn one_set() -> MemorySets {
    let mut sets = MemorySets::new();
    let content = b"settings 1.1.0";
    let wanted = FileRef { digest: Digest::of_content(content), length: content.len() as u64 };
    sets.write(&wanted, 0, content).expect("writes");
    sets.sync(&wanted).expect("syncs");
    sets.seal(&wanted).expect("seals");
    let part = component("behaviour", "1.1.0", ComponentKind::Config, content);
    let set = SetManifest {
        bundle: Some(Digest::of_content(b"bundle")),
        version: "walk 1.1.0".to_owned(),
        components: [(part.name.clone(), part)].into(),
    };
    sets.stage(&set).expect("stages");
    let mut switch = sets.holdings().expect("tells").switch;
    switch.try_out(&set.id().to_string());
    switch.commit();
    sets.write_switch(&mut switch).expect("switches");
    sets
}

#[tokio::test(start_paused = true)]
async fn a_robot_signs_what_it_has_installed_in_its_first_hello_with_a_key_that_it_keeps() {
    let (store, releases) = (MemoryStore::new(), Releases::new());
    store.load_now("ring-1");
    // An agent that kept no documents has committed it.
    let software = SoftwareRow { directive_generation: 1, ..SoftwareRow::default() };
    store.commit_now(&[Op::Software(Box::new(software))]);
    let mut keys = Vec::new();
    for _ in 0..2 {
        let worker = UpdateWorker::new(Box::new(one_set()), Arc::new(releases.clone()));
        let update = Updates { config: releases.config(), worker: Box::new(worker) };
        let mut bench = Bench::with(Box::new(store.clone()), Some(update));
        let hello = bench.session().await.hello().await;
        let said = installed::open(&hello.installed, &hello.robot_id, &hello.boot_id).expect("is believed");
        let running = said.running_set().expect("is listed");
        assert_eq!((running.version.as_str(), said.running == said.current), ("walk 1.1.0", true));
        assert_eq!(running.components.get("behaviour").map(String::as_str), Some("1.1.0"));
        assert_eq!(said.previous.map(|set| set.to_string()).as_deref(), Some("factory"));
        keys.push(said.device_key);
        bench.end().await;
    }
    assert_eq!(keys[0], keys[1]);
    assert_eq!(store.memory().and_then(|kept| kept.ledger.device).map(|key| key.public()), Some(keys.remove(0)));
}

#[tokio::test(start_paused = true)]
async fn a_robot_whose_software_is_not_changed_says_nothing_of_it() {
    let mut bench = Bench::new(Box::new(MemoryStore::new()));
    assert_eq!(bench.session().await.hello().await.installed, "");
    bench.end().await;
}

/// A robot that has so many samples of STATUS from before.
fn with_old_status(many: u64) -> MemoryStore {
    let store = MemoryStore::new();
    let mut kept = store.load_now("ring-1");
    for _ in 0..many {
        let ops = kept.ring.append(Lane::Status, 7, SampleBody::Status(Vitals::default()));
        ops.iter().for_each(|op| kept.apply(op));
        store.commit_now(&ops);
    }
    store
}

fn seqs(items: &[InboxItem]) -> Vec<u64> {
    items.iter().filter_map(|item| if let InboxItem::Sample(s) = item { Some(s.seq) } else { None }).collect()
}

#[tokio::test(start_paused = true)]
async fn old_status_goes_over_bulk_ends_with_its_session_and_begins_again_in_the_next() {
    let mut bench = Bench::new(Box::new(with_old_status(40)));
    let mut first = bench.session().await;
    first.hello().await;
    first.welcome(5).await;
    let asked = bench.replays.recv().await.expect("old status");
    assert_eq!((asked.replay.session_epoch, asked.replay.session_secret.reveal()), (5, "s5"));
    assert_eq!(seqs(&asked.replay.batch.items)[..40], (1..=40).collect::<Vec<_>>());
    for hb in 1..=4 {
        assert_eq!(first.beat().await, hb, "it holds no heartbeat up");
    }
    drop(first);
    let mut answer = asked.answer;
    answer.closed().await;
    let mut second = bench.session().await;
    second.hello().await;
    second.welcome(6).await;
    let asked = bench.replays.recv().await.expect("old status again");
    let went = seqs(&asked.replay.batch.items);
    assert_eq!((asked.replay.session_epoch, went[0]), (6, 1));
    let last = went[went.len() - 1];
    asked.answer.send(LaneAck { lane: Lane::Status, seq: last, expect: None }).expect("the robot waits");
    let live = loop {
        let uplink = second.uplink().await;
        if let Some(batch) = uplink.batches.iter().find(|b| b.lane == Lane::Status) {
            break seqs(&batch.items);
        }
    };
    assert_eq!(live[0], last + 1, "and then it is live");
    bench.end().await;
}
