//! The shell around the core: dials, says hello, carries messages both ways, keeps what must be kept, and waits.
//!
//! Invariant: it decides nothing about work. What comes in is always taken in, whatever the way up does; every queue is
//! bounded; a session that is silent for ten seconds is given up, one that is only observed for longer. One task a
//! robot, whose only timer is the next thing that is due. Called by the binary (one robot a process) and by swarms
//! (thousands in one).

mod greeting;

use crate::body::Body;
use crate::bugs::Bugs;
use crate::core::{AgentCore, CoreConfig, ExitReason, Input, Output};
use crate::sets::Holdings;
use crate::stop::line::{Line, LineEvent, StopLine};
use crate::stop::storage::unreadable;
use crate::stop::{CheckIn, StopNews};
use crate::storage::DeviceKey;
use crate::storage::{Op, Store, store};
use crate::transport::bulk::Bulk;
use crate::transport::dial::Dial;
use crate::transport::repeats::Repeats;
use crate::transport::replay::Replayed;
use crate::update::io::Worker;
use crate::update::{Done, Job, UpdateConfig};
use backon::{BackoffBuilder, ExponentialBackoff, ExponentialBuilder};
use greeting::{Greeted, Open, SILENCE, greet};
use midshift_core::Boxed;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::robot::{Lane, ReportedState};
use midshift_core::time::{Clock, LinkDuration, LinkTime, Now};
use midshift_proto::convert::parse;
use midshift_proto::link::v1;
use midshift_proto::session::{
    Close, CloseCode, FromRobot, Hello, LanePosition, PROTOCOL_VERSION, Previous, StatusReplay, ToRobot, Uplink,
};
use rand::{RngExt, SeedableRng};
use std::future::pending;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

/// What one agent is told at its start.
pub struct AgentConfig {
    /// The robot that the agent is of.
    pub robot_id: RobotId,
    /// New for each start of the process.
    pub boot_id: String,
    /// Random; used if the store has no ring yet.
    pub new_ring_id: String,
    /// Seed of the jitter between attempts to connect. Different for each robot.
    pub seed: u64,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
    /// How its software is changed; none: it is not.
    pub update: Option<Updates>,
    /// Called with each heartbeat's period, whether or not there is a session: tells a launcher that the agent lives.
    pub pulse: Option<Box<dyn FnMut() + Send>>,
    /// Its way to the stop service; none: it has none, and obeys no fleet stop.
    pub stop: Option<StopLine>,
}

/// What an agent needs to change its software.
pub struct Updates {
    /// What it believes.
    pub config: UpdateConfig,
    /// Does the jobs.
    pub worker: Box<dyn Worker>,
}

/// An agent's ways to the server.
#[derive(Clone)]
pub struct Lines {
    /// Makes the connection of each session.
    pub link: Arc<dyn Dial>,
    /// The one for bulk, which its worker uses too.
    pub bulk: Bulk,
}

/// An agent that could not go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Ledger and ring cannot be kept: a robot without a memory must not move.
    #[error(transparent)]
    Store(#[from] store::Error),
}

/// The longest silence of a session that is only observed and so never answered: its end says that this robot may take
/// charge.
const OBSERVED_SILENCE_MAX: LinkDuration = LinkDuration::from_secs(60);
/// Shortest and longest pause between attempts to connect, real time.
const RETRY: std::ops::RangeInclusive<Duration> = Duration::from_millis(200)..=Duration::from_secs(10);
/// A server that moves its robots over or restarts is asked again within this, milliseconds of real time.
const SOON_MS: std::ops::Range<u64> = 50..1_000;
/// The store comes back from each commit.
type Commit = (Box<dyn Store>, Result<(), store::Error>);
/// What came of old STATUS, with the session that it was for.
type Replaying = (u64, Replayed);
/// The worker comes back from each job.
type Worked = (Box<dyn Worker>, Done);

/// How far the agent is with its next session.
enum ConnectState {
    /// Nothing under way.
    Idle,
    /// Not yet.
    Waiting(Pin<Box<tokio::time::Sleep>>),
    /// A connection is being made.
    Dialing(Boxed<'static, Result<Channel, String>>),
    /// Hello was said.
    Greeting(Boxed<'static, Greeted>),
}

/// What ended a wait.
enum Woken {
    Due,
    Shutdown,
    Committed(Box<dyn Store>, Result<(), store::Error>),
    Worked(Box<dyn Worker>, Box<Done>),
    Replayed(u64, Replayed),
    Channel(Result<Channel, String>),
    DialNow,
    Greeted(Greeted),
    Down(Option<Box<v1::SessionResponse>>),
    Stop(LineEvent),
}

/// One agent.
pub struct Agent {
    config: AgentConfig,
    core: AgentCore,
    clock: Arc<dyn Clock>,
    lines: Lines,
    stop: Option<Line>,
    open: Option<Open>,
    connect_state: ConnectState,
    retry: ExponentialBackoff,
    /// The least pauses where the server says when to come again.
    sent_away: ExponentialBackoff,
    /// How long the next session may be silent if it is only observed.
    patience: LinkDuration,
    /// Why there is no session, as the log was told.
    refused: Repeats,
    rng: rand::rngs::StdRng,
    store: Option<Box<dyn Store>>,
    batch: u64,
    committing: Option<Boxed<'static, Commit>>,
    worker: Option<Box<dyn Worker>>,
    working: Option<Boxed<'static, Worked>>,
    /// Ends with the session that it is for.
    replaying: Option<Boxed<'static, Replaying>>,
    leave: CancellationToken,
    pulsed: LinkTime,
    exit: Option<ExitReason>,
}

/// Runs one agent until `shutdown`, or until the agent ends by itself.
pub fn run(
    mut config: AgentConfig,
    body: Box<dyn Body>,
    mut store: Box<dyn Store>,
    clock: Arc<dyn Clock>,
    lines: Lines,
    shutdown: CancellationToken,
) -> Boxed<'static, Result<ExitReason, Error>> {
    Box::pin(async move {
        let mut memory = store.load(&config.new_ring_id).await?;
        if memory.ledger.device.is_none() {
            let made = Op::Device(DeviceKey::draw());
            store.commit(std::slice::from_ref(&made)).await?;
            memory.apply(&made);
        }
        let holdings = look_at_disk(config.update.as_mut()).await;
        let core = CoreConfig {
            robot_id: config.robot_id.clone(),
            bugs: config.bugs,
            update: config.update.as_ref().map(|u| u.config.clone()),
            server_is_proven: lines.link.proves_server(),
        };
        let mut core = AgentCore::new(core, body, memory, clock.now());
        core.saw(holdings);
        let mut stop = None;
        if let Some(line) = config.stop.take() {
            let now = clock.now();
            let (line, loaded) = Line::begin(line, unreadable(&config.robot_id, now.wall), config.seed).await;
            core.obeys_stops(loaded, now.link);
            stop = Some(line);
        }
        let agent = Agent {
            retry: retries(config.seed),
            sent_away: retries(config.seed),
            patience: SILENCE,
            refused: Repeats::default(),
            rng: rand::rngs::StdRng::seed_from_u64(config.seed),
            core,
            clock,
            lines,
            stop,
            open: None,
            connect_state: ConnectState::Idle,
            store: Some(store),
            batch: 0,
            committing: None,
            worker: config.update.take().map(|update| update.worker),
            working: None,
            replaying: None,
            leave: CancellationToken::new(),
            pulsed: LinkTime(0),
            exit: None,
            config,
        };
        agent.run(shutdown).await
    })
}

/// What is on the disk, for the first Hello: the core looks for itself, and that may come after it.
async fn look_at_disk(updates: Option<&mut Updates>) -> Option<Holdings> {
    match updates?.worker.work(Job::Look, CancellationToken::new()).await {
        Done::Holdings(holdings) => Some(*holdings),
        _ => None,
    }
}

/// Jitter makes each pause up to twice as long.
fn retries(seed: u64) -> ExponentialBackoff {
    ExponentialBuilder::default()
        .with_min_delay(*RETRY.start())
        .with_max_delay(*RETRY.end() / 2)
        .with_factor(2.0)
        .without_max_times()
        .with_jitter()
        .with_jitter_seed(seed)
        .build()
}

impl Agent {
    async fn run(mut self, shutdown: CancellationToken) -> Result<ExitReason, Error> {
        self.dial_now();
        self.step(Input::Start);
        loop {
            if let Some(reason) = self.exit {
                return self.end(reason).await;
            }
            match self.wait(&shutdown).await {
                Woken::Due => self.due(),
                Woken::Shutdown => self.exit = Some(ExitReason::Shutdown),
                Woken::Committed(store, done) => {
                    if let Err(error) = done {
                        self.core.halt(self.clock.now());
                        return Err(error.into());
                    }
                    self.store = Some(store);
                    self.step(Input::Persisted(self.batch));
                }
                Woken::Worked(worker, done) => {
                    self.worker = Some(worker);
                    self.step(Input::Done(done));
                }
                Woken::Replayed(session_epoch, replayed) => self.step(Input::Replayed(session_epoch, replayed)),
                Woken::DialNow => self.dial_now(),
                Woken::Channel(Ok(channel)) => self.greet(channel),
                Woken::Channel(Err(why)) => self.failed(&why),
                Woken::Greeted(greeted) => self.greeted(greeted),
                Woken::Down(message) => self.heard(message),
                Woken::Stop(event) => self.handle_line_event(event),
            }
        }
    }

    /// The body is told to stand: nobody drives it any more. What was being written is finished.
    async fn end(mut self, reason: ExitReason) -> Result<ExitReason, Error> {
        self.core.halt(self.clock.now());
        if let Some(committing) = self.committing.take() {
            committing.await.1?;
        }
        Ok(reason)
    }

    async fn wait(&mut self, shutdown: &CancellationToken) -> Woken {
        let now = self.clock.now();
        let due = tokio::time::sleep(self.until_due(&now));
        let Self { committing, working, replaying, connect_state, open, stop, .. } = self;
        tokio::select! {
            biased;
            event = stopping(stop) => Woken::Stop(event),
            (store, done) = ready(committing) => { *committing = None; Woken::Committed(store, done) }
            () = shutdown.cancelled() => Woken::Shutdown,
            (worker, done) = ready(working) => { *working = None; Woken::Worked(worker, Box::new(done)) }
            woken = progress(connect_state) => { *connect_state = ConnectState::Idle; woken }
            message = next(open) => Woken::Down(message.map(Box::new)),
            (epoch, replayed) = ready(replaying) => { *replaying = None; Woken::Replayed(epoch, replayed) }
            () = due => Woken::Due,
        }
    }

    /// Real time until the core wants to be called. Never zero, so that nothing spins.
    fn until_due(&self, now: &Now) -> Duration {
        let wake = self.core.next_wake(now);
        let link_ms = wake.link.since(now.link).as_ms();
        let rate = u64::from(self.clock.rate_permille()).max(1);
        let site_ms = wake.site.map_or(u64::MAX, |at| (at.since(now.site).as_ms().saturating_mul(1000)).div_ceil(rate));
        Duration::from_millis(link_ms.min(site_ms).max(1))
    }

    fn due(&mut self) {
        let now = self.clock.now();
        let patient = self.config.bugs.patient_session();
        if !patient && self.open.as_ref().is_some_and(|o| now.link.since(o.heard) > o.patience) {
            self.lost("the server is silent");
        }
        if now.link.since(self.pulsed) >= limits::HEARTBEAT {
            self.pulsed = now.link;
            if let Some(pulse) = &mut self.config.pulse {
                pulse();
            }
        }
        self.step(Input::Tick);
    }

    fn step(&mut self, input: Input) {
        let now = self.clock.now();
        for output in self.core.step(now, input) {
            match output {
                Output::Persist(batch, ops) => self.persist(batch, ops),
                Output::Send(message) => self.send(*message),
                Output::Replay(replay) => self.replay(*replay),
                Output::CheckIn(nonce, check_in) => self.check_in(nonce, &check_in),
                Output::RedialStop(why) => self.stop.iter_mut().for_each(|line| line.redial(why)),
                Output::SaveStops(number, saved) => {
                    self.stop.iter_mut().for_each(|line| line.save_stops(number, &saved))
                }
                Output::Job(job) => self.work_on(*job),
                Output::DropJob => self.leave.cancel(),
                Output::Exit(reason) => self.exit = Some(reason),
            }
        }
    }

    fn persist(&mut self, batch: u64, ops: Vec<Op>) {
        let Some(mut store) = self.store.take() else { return };
        self.batch = batch;
        self.committing = Some(Box::pin(async move {
            let done = store.commit(&ops).await;
            (store, done)
        }));
    }

    fn check_in(&mut self, nonce: u64, check_in: &CheckIn) {
        if self.stop.as_mut().is_some_and(|line| !line.check_in(nonce, check_in)) {
            self.step(Input::Stop(Box::new(StopNews::LineLost)));
        }
    }

    fn handle_line_event(&mut self, event: LineEvent) {
        let Some(line) = &mut self.stop else { return };
        if matches!(event, LineEvent::DialNow) {
            return line.dial_now(&self.config.robot_id, &self.config.boot_id, self.core.known_stops());
        }
        if let Some(news) = line.take_in(&self.config.robot_id, event) {
            self.step(Input::Stop(Box::new(news)));
        }
    }

    fn work_on(&mut self, job: Job) {
        let Some(mut worker) = self.worker.take() else { return };
        self.leave = CancellationToken::new();
        let leave = self.leave.clone();
        self.working = Some(Box::pin(async move {
            let done = worker.work(job, leave).await;
            (worker, done)
        }));
    }

    fn replay(&mut self, replay: StatusReplay) {
        let bulk = self.lines.bulk.clone();
        self.replaying = Some(Box::pin(async move { (replay.session_epoch, bulk.replay(&replay).await) }));
    }

    /// The session is over, and what was sent beside it.
    fn leave_session(&mut self) {
        (self.open, self.replaying) = (None, None);
    }

    fn send(&mut self, message: Uplink) {
        let Some(open) = &self.open else { return };
        let only_heartbeat = message.batches.is_empty();
        let wire = v1::SessionRequest::from(&FromRobot::Uplink(message));
        if open.up.try_send(wire).is_err() && !only_heartbeat {
            self.lost("the way up is stuck");
        }
    }

    fn lost(&mut self, why: &str) {
        tracing::info!(robot_id = %self.config.robot_id, why, "session lost");
        self.leave_session();
        self.step(Input::Disconnected);
        if matches!(self.connect_state, ConnectState::Idle) {
            self.wait_to_dial(None);
        }
    }

    fn failed(&mut self, why: &str) {
        self.log_refusal(why);
        self.wait_to_dial(None);
    }

    /// It is tried again for as long as it takes, and told about once a minute.
    fn log_refusal(&mut self, why: &str) {
        if let Some(times) = self.refused.count(why) {
            tracing::warn!(robot_id = %self.config.robot_id, why, times, "no session");
        }
    }

    fn wait_to_dial(&mut self, at_least: Option<Duration>) {
        let pause = at_least.or_else(|| self.retry.next()).unwrap_or(*RETRY.end());
        self.connect_state = ConnectState::Waiting(Box::pin(tokio::time::sleep(pause)));
    }

    fn soon(&mut self) -> Duration {
        Duration::from_millis(self.rng.random_range(SOON_MS))
    }

    fn dial_now(&mut self) {
        let dial = self.lines.link.clone();
        self.connect_state = ConnectState::Dialing(Box::pin(async move { dial.dial().await.map_err(|e| e.causes()) }));
    }

    fn greet(&mut self, channel: Channel) {
        let now = self.clock.now();
        let hello = FromRobot::Hello(Box::new(self.hello(&now)));
        let greeting = greet(channel, v1::SessionRequest::from(&hello), self.clock.clone());
        let limit = Duration::from_millis(SILENCE.as_ms());
        self.connect_state = ConnectState::Greeting(Box::pin(async move {
            tokio::time::timeout(limit, greeting).await.unwrap_or_else(|_| Greeted::Failed("no welcome".to_owned()))
        }));
    }

    fn hello(&self, now: &Now) -> Hello {
        let memory = self.core.memory();
        let session = &memory.ledger.session;
        let position = |lane: Lane| {
            let buffer = memory.ring.lane(lane);
            (lane, LanePosition { first_seq: buffer.first(), next_seq: buffer.produced + 1 })
        };
        Hello {
            robot_id: self.config.robot_id.clone(),
            boot_id: self.config.boot_id.clone(),
            previous: (session.session_epoch > 0)
                .then(|| Previous { session_epoch: session.session_epoch, secret: session.secret.clone() }),
            inventory: self.core.inventory().clone(),
            reported: ReportedState { hb: 0, session_epoch: 0, ..self.core.reported(now) },
            ring: memory.ring.id.clone(),
            lanes: Lane::ALL.into_iter().map(position).collect(),
            store_id: session.store_id.clone(),
            sent_unix_ms: now.wall.0,
            clock_rate_permille: self.clock.rate_permille(),
            protocol_versions: vec![PROTOCOL_VERSION],
            installed: self.core.installed(&self.config.boot_id).unwrap_or_default(),
        }
    }

    fn greeted(&mut self, greeted: Greeted) {
        match greeted {
            Greeted::Welcome(welcome) => {
                let (mut open, welcome) = *welcome;
                // The server ends an observed session once its robot may take charge: what is held dials no sooner than
                // that.
                open.patience = if welcome.observed { self.patience } else { SILENCE };
                let next_ms = if welcome.observed { 2 * open.patience.as_ms() } else { SILENCE.as_ms() };
                self.patience = LinkDuration(next_ms.min(OBSERVED_SILENCE_MAX.as_ms()));
                tracing::info!(robot_id = %self.config.robot_id, session_epoch = welcome.session_epoch, "session open");
                self.leave_session();
                self.refused.forget();
                self.open = Some(open);
                self.retry = retries(self.rng.random());
                self.sent_away = retries(self.rng.random());
                self.step(Input::Connected(welcome));
            }
            Greeted::Closed(close) => self.closed(&close),
            Greeted::Failed(why) => self.greeting_failed(&why, None),
            Greeted::Refused(why, again_after) => self.greeting_failed(&why, again_after),
            Greeted::Revoked(why) => self.revoked(&why),
        }
    }

    /// Only a person can change that, and this program will hear of it with another key: there is no hurry.
    fn revoked(&mut self, why: &str) {
        if let Some(times) = self.refused.count(why) {
            tracing::error!(robot_id = %self.config.robot_id, why, times, "this robot was revoked");
        }
        let pause = Duration::from_millis(limits::REVOKED_RETRY.as_ms()) + self.soon();
        self.wait_to_dial(Some(pause));
    }

    fn greeting_failed(&mut self, why: &str, again_after: Option<Duration>) {
        self.log_refusal(why);
        // As the server asks, and apart from others that it asked the same; a server cannot send it away for long. One that asks again and again is asked
        // less often.
        let asked = again_after.map(|after| {
            let own = self.sent_away.next().unwrap_or(*RETRY.end());
            (after.min(*RETRY.end()) + self.soon()).max(own)
        });
        self.wait_to_dial(asked);
    }

    fn heard(&mut self, message: Option<Box<v1::SessionResponse>>) {
        let Some(message) = message else { return self.lost("the stream ended") };
        let now = self.clock.now().link;
        if let Some(open) = &mut self.open {
            open.heard = now;
        }
        match parse(*message) {
            Ok(ToRobot::Downlink(down)) => self.step(Input::Down(down)),
            Ok(ToRobot::Close(close)) => self.closed(&close),
            Ok(ToRobot::MoveOver { .. }) => {
                if matches!(self.connect_state, ConnectState::Idle) {
                    let pause = self.soon();
                    self.wait_to_dial(Some(pause));
                }
            }
            Ok(ToRobot::Welcome(_)) => self.lost("a second welcome"),
            Err(refusal) => {
                tracing::error!(robot_id = %self.config.robot_id, code = refusal.reason.name(), "message cannot be read");
                self.lost("a message cannot be read");
            }
        }
    }

    fn closed(&mut self, close: &Close) {
        tracing::info!(robot_id = %self.config.robot_id, code = ?close.code, reason = close.reason.name(), "closed by server");
        let had_next = !matches!(self.connect_state, ConnectState::Idle);
        self.leave_session();
        if close.code == CloseCode::Fenced && had_next {
            // Its own next session proved the succession: nobody else has this robot's id.
            return self.step(Input::Disconnected);
        }
        self.step(if close.code == CloseCode::Fenced { Input::Fenced } else { Input::Disconnected });
        let asked = Duration::from_millis(u64::from(close.retry_after_ms));
        let pause = match close.code {
            CloseCode::Fenced => Some(asked.max(Duration::from_millis(limits::FENCED_RETRY.as_ms()))),
            CloseCode::Shutdown | CloseCode::MoveOver if had_next => return,
            CloseCode::Shutdown | CloseCode::MoveOver => Some(asked + self.soon()),
            CloseCode::Protocol | CloseCode::TooSlow => self.retry.next().map(|pause| pause.max(asked)),
        };
        self.wait_to_dial(pause);
    }
}

async fn ready<T>(future: &mut Option<Boxed<'static, T>>) -> T {
    match future {
        Some(future) => future.await,
        None => pending().await,
    }
}

async fn stopping(line: &mut Option<Line>) -> LineEvent {
    match line {
        Some(line) => line.next().await,
        None => pending().await,
    }
}

async fn next(open: &mut Option<Open>) -> Option<v1::SessionResponse> {
    match open {
        Some(open) => open.down.message().await.ok().flatten(),
        None => pending().await,
    }
}

async fn progress(connect_state: &mut ConnectState) -> Woken {
    match connect_state {
        ConnectState::Idle => pending().await,
        ConnectState::Waiting(sleep) => {
            sleep.await;
            Woken::DialNow
        }
        ConnectState::Dialing(dialing) => Woken::Channel(dialing.await),
        ConnectState::Greeting(greeting) => Woken::Greeted(greeting.await),
    }
}
