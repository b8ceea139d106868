//! The line to the stop service, over pipes in memory and tokio's paused clock, and over loopback; and the file of
//! stops.

use crate::session::{Pipes, clock, config};
use crate::stops::{reset, stop, stop_id};
use crate::test_body::TestBody;
use async_trait::async_trait;
use midshift_agent::bulk::Bulk;
use midshift_agent::core::ExitReason;
use midshift_agent::dial::{self, Dial, TcpDial};
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{AgentConfig, Error, Lines, run};
use midshift_agent::stop::line::StopLine;
use midshift_agent::stop::storage::{FileStops, Loaded, MemoryStops, STOP_FILE, StopStorage, unreadable};
use midshift_agent::store::{self, Op, Store};
use midshift_core::ids::{AreaId, RobotId};
use midshift_core::limits;
use midshift_core::robot::StopLevel;
use midshift_core::stop::region::Bounds;
use midshift_core::stop::robot::SavedStops;
use midshift_core::stop::{Region, Scope, Stop};
use midshift_core::time::Utc;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::stop_link_service_server::{StopLinkService, StopLinkServiceServer};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tokio_stream::wrappers::{ReceiverStream, TcpListenerStream};
use tokio_util::sync::CancellationToken;
use tonic::transport::{Channel, Server};
use tonic::{Request, Response, Status, Streaming};

type Down = mpsc::Sender<Result<v1::AttendResponse, Status>>;

/// One line as the stop service has it.
struct Seen {
    up: Streaming<v1::AttendRequest>,
    down: Down,
}

impl Seen {
    /// None: it is over.
    async fn next(&mut self) -> Option<v1::attend_request::Message> {
        self.up.message().await.ok()??.message
    }
    async fn attend(&mut self) -> v1::Attend {
        match self.next().await {
            Some(v1::attend_request::Message::Attend(attend)) => attend,
            other => panic!("no attend: {other:?}"),
        }
    }
    async fn check_in(&mut self) -> v1::CheckIn {
        match self.next().await {
            Some(v1::attend_request::Message::CheckIn(check_in)) => check_in,
            other => panic!("no check-in: {other:?}"),
        }
    }
    async fn send(&self, message: v1::attend_response::Message) {
        let said = v1::AttendResponse { message: Some(message), facts_generation: 0 };
        self.down.send(Ok(said)).await.expect("the robot listens");
    }
    async fn send_facts(&self, facts: v1::StopFacts, facts_generation: u64) {
        let message = Some(v1::attend_response::Message::Facts(facts));
        self.down.send(Ok(v1::AttendResponse { message, facts_generation })).await.expect("the robot listens");
    }
    async fn tell_stops(&self, stops: &[Stop], generation: u64) {
        let stops = stops.iter().map(Into::into).collect();
        self.send_facts(v1::StopFacts { stops, resets: vec![] }, generation).await;
    }
    async fn synced(&self, generation: u64) {
        self.send(v1::attend_response::Message::Synced(v1::Synced { generation, ..Default::default() })).await;
    }
    async fn answer(&self, check_in: &v1::CheckIn, generation: u64) {
        let nonce = check_in.nonce;
        self.send(v1::attend_response::Message::CheckInAnswer(v1::CheckInAnswer { nonce, generation })).await;
    }
    /// Check-ins are answered until one is as it should be.
    async fn until(&mut self, generation: u64, is_it: impl Fn(&v1::CheckIn) -> bool) -> v1::CheckIn {
        loop {
            let check_in = self.check_in().await;
            self.answer(&check_in, generation).await;
            if is_it(&check_in) {
                return check_in;
            }
        }
    }
}

struct Desk(mpsc::Sender<Seen>);

#[async_trait]
impl StopLinkService for Desk {
    type AttendStream = ReceiverStream<Result<v1::AttendResponse, Status>>;
    async fn attend(
        &self,
        request: Request<Streaming<v1::AttendRequest>>,
    ) -> Result<Response<Self::AttendStream>, Status> {
        let (down, queue) = mpsc::channel(16);
        let seen = Seen { up: request.into_inner(), down };
        self.0.send(seen).await.map_err(|_| Status::unavailable("the test is over"))?;
        Ok(Response::new(ReceiverStream::new(queue)))
    }
}

/// A server that is never there.
struct Nowhere;

#[async_trait]
impl Dial for Nowhere {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        std::future::pending().await
    }
}

/// A disk that takes a first write and then hangs.
struct Hung(MemoryStore);

#[async_trait]
impl Store for Hung {
    async fn load(&mut self, new_ring_id: &str) -> Result<store::RobotMemory, store::Error> {
        self.0.load(new_ring_id).await
    }
    async fn commit(&mut self, ops: &[Op]) -> Result<(), store::Error> {
        if matches!(ops, [Op::Device(_)]) { self.0.commit(ops).await } else { std::future::pending().await }
    }
}

struct Bench {
    lines: mpsc::Receiver<Seen>,
    body: TestBody,
    shutdown: CancellationToken,
    agent: JoinHandle<Result<ExitReason, Error>>,
}

fn robot() -> RobotId {
    RobotId::parse("rbt-01").expect("a name")
}

impl Bench {
    fn new() -> Self {
        Self::with(Box::new(MemoryStore::new()), Box::new(MemoryStops::default()))
    }
    fn with(store: Box<dyn Store>, storage: Box<dyn StopStorage>) -> Self {
        let (ends, incoming) = mpsc::channel(4);
        let (seen, lines) = mpsc::channel(4);
        let server = Server::builder().add_service(StopLinkServiceServer::new(Desk(seen)));
        tokio::spawn(server.serve_with_incoming(ReceiverStream::new(incoming)));
        let dial = Arc::new(Pipes { ends, network: watch::channel(true).1 });
        Self::over(dial, lines, store, storage)
    }
    fn over(
        dial: Arc<dyn Dial>,
        lines: mpsc::Receiver<Seen>,
        store: Box<dyn Store>,
        storage: Box<dyn StopStorage>,
    ) -> Self {
        let config = AgentConfig { stop: Some(StopLine { dial, storage }), ..config(None) };
        let clock = clock(Utc(1_700_000_000_000));
        let (body, shutdown) = (TestBody::at("A"), CancellationToken::new());
        // The link and bulk are as bad as they can be in all of these.
        let lines_of_work = Lines { bulk: Bulk::new(Arc::new(Nowhere)), link: Arc::new(Nowhere) };
        let agent = run(config, Box::new(body.clone()), store, clock, lines_of_work, shutdown.clone());
        Self { lines, body, shutdown, agent: tokio::spawn(agent) }
    }
    async fn line(&mut self) -> Seen {
        self.lines.recv().await.expect("the robot dials")
    }
    /// A line on which it was told of nothing and is free to go.
    async fn free(&mut self) -> Seen {
        let mut line = self.line().await;
        line.attend().await;
        line.synced(1).await;
        line.until(1, |c| c.obeys == NO_STOP).await;
        line
    }
    async fn end(self) {
        self.shutdown.cancel();
        assert_eq!(self.agent.await.expect("no panic").expect("no error"), ExitReason::Shutdown);
    }
}

const NO_STOP: i32 = midshift_proto::common::v1::StopLevel::None as i32;
const HALT: i32 = midshift_proto::common::v1::StopLevel::Halt as i32;

#[tokio::test(start_paused = true)]
async fn it_attends_is_told_and_checks_in_each_second_with_numbers_that_never_come_again() {
    let mut bench = Bench::new();
    let mut line = bench.line().await;
    let attend = line.attend().await;
    assert_eq!((attend.robot_id.as_str(), attend.boot_id.as_str(), attend.stops.len()), ("rbt-01", "boot-1", 0));
    line.synced(1).await;
    let first = line.check_in().await;
    assert_eq!((first.generation, first.obeys, first.durable, first.standstill), (1, HALT, true, true));
    line.answer(&first, 1).await;
    let begin = Instant::now();
    let mut nonces = BTreeSet::from([first.nonce]);
    for _ in 0..10 {
        let check_in = line.check_in().await;
        line.answer(&check_in, 1).await;
        assert!(nonces.insert(check_in.nonce));
    }
    let seconds = begin.elapsed().as_secs_f64();
    assert!((7.0..11.0).contains(&seconds), "ten check-ins, some at once with a change, took {seconds} s");
    let stopped = Instant::now();
    line.tell_stops(&[stop(1, StopLevel::Halt)], 2).await;
    let said = line.until(2, |c| c.generation == 2).await;
    assert_eq!((said.obeys, said.inside), (HALT, vec!["STOP-1".to_owned()]));
    assert!(stopped.elapsed() < Duration::from_millis(20), "at once");
    // Another start draws other numbers.
    bench.end().await;
    let mut bench = Bench::new();
    let mut line = bench.line().await;
    line.attend().await;
    line.synced(1).await;
    assert!(!nonces.contains(&line.check_in().await.nonce));
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_ledger_whose_disk_hangs_and_a_link_that_is_not_there_do_not_hold_a_stop_up() {
    let mut bench = Bench::with(Box::new(Hung(MemoryStore::new())), Box::new(MemoryStops::default()));
    let mut line = bench.free().await;
    assert_eq!(bench.body.log().levels.last(), Some(&StopLevel::None));
    line.tell_stops(&[stop(1, StopLevel::Halt)], 2).await;
    line.until(2, |c| c.obeys == HALT && c.standstill && c.durable).await;
    assert_eq!(bench.body.log().levels.last(), Some(&StopLevel::Halt));
    bench.agent.abort();
}

/// A file of stops whose disk hangs.
struct HungStops;

#[async_trait]
impl StopStorage for HungStops {
    async fn load(&mut self, _: SavedStops) -> Loaded {
        Loaded { saved: SavedStops::default(), is_durable: true }
    }
    async fn save(&mut self, _: SavedStops) -> Result<(), midshift_agent::stop::storage::Error> {
        std::future::pending().await
    }
}

#[tokio::test(start_paused = true)]
async fn a_file_of_stops_whose_disk_hangs_holds_nothing_up_either_and_that_is_said() {
    let mut bench = Bench::with(Box::new(MemoryStore::new()), Box::new(HungStops));
    let mut line = bench.free().await;
    line.tell_stops(&[stop(1, StopLevel::Halt)], 2).await;
    let said = line.until(2, |c| c.obeys == HALT).await;
    assert!(said.standstill && !said.durable);
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_service_that_reads_and_never_answers_is_left_after_three_seconds_and_dialed_again() {
    let mut bench = Bench::new();
    let mut hung = bench.line().await;
    hung.attend().await;
    hung.synced(1).await;
    let begin = Instant::now();
    let mut next = bench.line().await;
    let waited = begin.elapsed();
    assert!((Duration::from_secs(3)..Duration::from_secs(5)).contains(&waited), "{waited:?}");
    while hung.next().await.is_some() {}
    next.attend().await;
    next.synced(1).await;
    next.until(1, |c| c.obeys == NO_STOP).await;
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_service_that_is_not_there_is_dialed_each_second_for_ten_and_then_with_growing_pauses() {
    let (tries, mut tried) = mpsc::channel(64);
    struct Refused(mpsc::Sender<Instant>);
    #[async_trait]
    impl Dial for Refused {
        async fn dial(&self) -> Result<Channel, dial::Error> {
            let _ = self.0.try_send(Instant::now());
            Err(dial::Error("refused".into()))
        }
    }
    let (store, storage) = (Box::new(MemoryStore::new()), Box::new(MemoryStops::default()));
    let bench = Bench::over(Arc::new(Refused(tries)), mpsc::channel(1).1, store, storage);
    let mut pauses = Vec::new();
    let begun = tried.recv().await.expect("dials");
    let (mut before, mut early) = (begun, Vec::new());
    for _ in 0..40 {
        let at = tried.recv().await.expect("dials again");
        let pause = at.duration_since(before).as_millis();
        pauses.push(pause);
        if before.duration_since(begun) < Duration::from_secs(10) {
            early.push(pause);
        }
        before = at;
    }
    assert!(early.len() >= 10 && early.iter().all(|ms| *ms <= 1_010), "{early:?}");
    assert!(pauses.iter().all(|ms| (200..=5_010).contains(ms)), "{pauses:?}");
    assert!(pauses[0] <= 410 && pauses[early.len()..].iter().any(|ms| *ms > 2_000), "{pauses:?}");
    assert!(pauses[5..].iter().collect::<BTreeSet<_>>().len() > 10, "they differ");
    bench.end().await;
}

/// A way that is there, and gone when the test says so; each dial is told.
struct Flaky(Pipes, mpsc::Sender<Instant>);

#[async_trait]
impl Dial for Flaky {
    async fn dial(&self) -> Result<Channel, dial::Error> {
        let _ = self.1.try_send(Instant::now());
        let is_there = *self.0.network.borrow();
        match is_there {
            true => self.0.dial().await,
            false => Err(dial::Error("refused".into())),
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_line_that_worked_for_long_and_is_lost_is_dialed_each_second_again() {
    let (ends, incoming) = mpsc::channel(4);
    let (seen, lines) = mpsc::channel(4);
    let server = Server::builder().add_service(StopLinkServiceServer::new(Desk(seen)));
    tokio::spawn(server.serve_with_incoming(ReceiverStream::new(incoming)));
    let (network, is_there) = watch::channel(true);
    let (tries, mut tried) = mpsc::channel(64);
    let dial = Arc::new(Flaky(Pipes { ends, network: is_there }, tries));
    let mut bench = Bench::over(dial, lines, Box::new(MemoryStore::new()), Box::new(MemoryStops::default()));
    let mut line = bench.free().await;
    let begun = Instant::now();
    line.until(1, |_| begun.elapsed() > Duration::from_secs(60)).await;
    while tried.try_recv().is_ok() {}
    network.send_replace(false);
    drop(line);
    // Nothing comes any more, which it finds out by itself.
    let lost = tried.recv().await.expect("dials again");
    let mut before = lost;
    while lost.elapsed() < Duration::from_secs(9) {
        let at = tried.recv().await.expect("dials again");
        assert!(at.duration_since(before) <= Duration::from_millis(1_010), "{:?}", at.duration_since(before));
        before = at;
    }
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn stops_that_find_no_room_are_brought_by_name_and_their_resets_reach_it() {
    let column = |i: i32| (i * 10_000 - 2_000_000_000, i * 10_000 - 1_999_995_000);
    let row = |(x0_mm, x1_mm)| Bounds { x0_mm, y0_mm: -2_000_000_000, x1_mm, y1_mm: -1_999_000_000 };
    let boxes = (0..128).map(|i| row(column(i)));
    let region = Some(Region::new(boxes));
    let mut bench = Bench::new();
    let mut line = bench.line().await;
    line.attend().await;
    let hall = Scope::Area(AreaId::parse("hall").expect("an id"));
    let large = |n: u64| Stop { scope: hall.clone(), region: region.clone(), ..stop(n, StopLevel::Slow) };
    let all: Vec<Stop> = (0..200).map(large).collect();
    for some in all.chunks(10) {
        line.tell_stops(some, 0).await;
    }
    line.tell_stops(&[Stop { level: StopLevel::Halt, ..large(250) }], 0).await;
    line.synced(1).await;
    line.until(1, |c| c.durable).await;
    drop(line);
    let mut next = bench.line().await;
    let attend = next.attend().await;
    let bytes: usize = attend.stops.iter().map(prost::Message::encoded_len).sum();
    assert!(bytes <= limits::STOP_ATTEND_BYTES && attend.stops.len() > 14, "{bytes}, {}", attend.stops.len());
    assert_eq!(attend.stops[0].stop_id, stop_id(250).as_str(), "the most restrictive first");
    let whole: BTreeSet<&String> = attend.stops.iter().map(|stop| &stop.stop_id).collect();
    let more: BTreeSet<&String> = attend.more_stop_ids.iter().collect();
    assert!(whole.is_disjoint(&more) && !more.is_empty());
    assert_eq!(whole.len() + more.len(), 201, "every one of them");
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn asked_to_move_over_it_has_the_next_line_before_it_leaves_this_one() {
    let mut bench = Bench::new();
    let mut old = bench.free().await;
    old.send(v1::attend_response::Message::MoveOver(v1::MoveOver {})).await;
    let mut next = loop {
        tokio::select! {
            biased;
            next = bench.lines.recv() => break next.expect("the robot dials"),
            message = old.next() => assert!(message.is_some(), "it left before it had the next one"),
        }
    };
    next.attend().await;
    next.synced(4).await;
    let said = next.until(4, |c| c.generation == 4).await;
    assert_eq!(said.obeys, NO_STOP, "nothing moved over but the line");
    while old.next().await.is_some() {}
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_message_that_cannot_be_read_ends_the_line_and_what_was_told_before_stands() {
    let mut bench = Bench::new();
    let mut line = bench.free().await;
    line.tell_stops(&[stop(1, StopLevel::Halt)], 2).await;
    line.until(2, |c| c.obeys == HALT).await;
    line.send_facts(v1::StopFacts { stops: vec![v1::Stop::default()], resets: vec![] }, 3).await;
    while line.next().await.is_some() {}
    let mut next = bench.line().await;
    let attend = next.attend().await;
    assert_eq!(attend.stops.iter().map(|s| s.stop_id.as_str()).collect::<Vec<_>>(), ["STOP-1"]);
    next.synced(3).await;
    assert_eq!(next.check_in().await.obeys, HALT);
    bench.end().await;
}

#[tokio::test(start_paused = true)]
async fn a_stop_that_is_answered_for_and_not_told_within_two_seconds_has_it_dial_again() {
    let mut bench = Bench::new();
    let mut line = bench.free().await;
    let begin = Instant::now();
    loop {
        tokio::select! {
            Some(v1::attend_request::Message::CheckIn(check_in)) = line.next() => line.answer(&check_in, 2).await,
            mut next = bench.lines.recv() => {
                next.as_mut().expect("the robot dials").attend().await;
                break;
            }
        }
    }
    let waited = begin.elapsed();
    assert!((Duration::from_secs(2)..Duration::from_secs(5)).contains(&waited), "{waited:?}");
    bench.end().await;
}

#[tokio::test]
async fn over_loopback_an_engaged_stop_is_kept_in_its_file_and_stands_the_robot_after_it_was_killed() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(STOP_FILE);
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("binds");
    let uri = format!("http://{}", listener.local_addr().expect("an address"));
    let (seen, mut lines) = mpsc::channel(4);
    let server = Server::builder().add_service(StopLinkServiceServer::new(Desk(seen)));
    tokio::spawn(server.serve_with_incoming(TcpListenerStream::new(listener)));
    let begin = |lines| {
        let dial = Arc::new(TcpDial::new(&uri, None).expect("an address"));
        Bench::over(dial, lines, Box::new(MemoryStore::new()), Box::new(FileStops::new(&path)))
    };
    let mut bench = begin(lines);
    let mut line = bench.free().await;
    line.tell_stops(&[stop(1, StopLevel::Halt)], 2).await;
    let said = line.until(2, |c| c.obeys == HALT && c.durable).await;
    assert_eq!(said.awaiting_resume, ["STOP-1"]);
    bench.agent.abort();
    let _ = bench.agent.await;
    lines = bench.lines;
    let (_, saved): (u64, SavedStops) = midshift_latch::read(&path).expect("reads");
    assert!(saved.latch.is_effective(&stop_id(1)));
    let mut bench = begin(lines);
    let mut line = bench.line().await;
    assert_eq!(line.attend().await.stops.len(), 1);
    line.synced(2).await;
    for _ in 0..4 {
        let check_in = line.check_in().await;
        assert_eq!((check_in.obeys, check_in.inside.len()), (HALT, 1));
        line.answer(&check_in, 2).await;
    }
    bench.end().await;
}

#[tokio::test]
async fn a_file_that_cannot_be_read_stands_the_robot_until_a_person_resumes_that_and_stays_beside() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(STOP_FILE);
    std::fs::write(&path, "nothing of ours").expect("writes");
    let first = unreadable(&robot(), Utc(7));
    let name = first.awaiting.first().expect("a name").to_string();
    assert_eq!(name, "LATCH-rbt-01-7");
    let loaded = FileStops::new(&path).load(first.clone()).await;
    assert_eq!(loaded, Loaded { saved: first.clone(), is_durable: true });
    assert_eq!(std::fs::read_to_string(folder.path().join("stops.latch.broken")).expect("reads"), "nothing of ours");
    // It is so after the next start too, under the same name.
    let again = FileStops::new(&path).load(unreadable(&robot(), Utc(8))).await;
    assert_eq!(again.saved, first);
    // A folder in its place is neither read nor put away.
    let odd = folder.path().join("odd");
    std::fs::create_dir(&odd).expect("makes");
    let mut stops = FileStops::new(&odd);
    assert_eq!(stops.load(first.clone()).await, Loaded { saved: first.clone(), is_durable: false });
    assert!(stops.save(first).await.is_err());
}

#[tokio::test]
async fn more_resets_than_the_file_holds_give_way_to_stops() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(STOP_FILE);
    let mut stops = FileStops::new(&path);
    stops.load(SavedStops::default()).await;
    let mut saved = SavedStops::default();
    for n in 0..6_000 {
        saved.latch.engage(stop(n, StopLevel::Halt));
        saved.latch.reset(reset(n));
    }
    saved.latch.engage(stop(9_999, StopLevel::Halt));
    saved.awaiting = [stop_id(3), stop_id(9_999)].into();
    stops.save(saved.clone()).await.expect("keeps");
    drop(stops);
    let loaded = FileStops::new(&path).load(SavedStops::default()).await;
    assert!(loaded.is_durable);
    assert_eq!(loaded.saved.awaiting, saved.awaiting);
    assert_eq!(loaded.saved.latch.effective().collect::<Vec<_>>(), saved.latch.effective().collect::<Vec<_>>());
    assert_eq!(loaded.saved.latch.resets().count(), 0);
}
