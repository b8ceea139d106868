//! One robot of a shift: the agent's real core around a simulated body, and a shell that opens its sessions.
//!
//! What the shell of a real agent does beside that is left out: it dials nobody, its ledger is durable at once, and its
//! software is not changed.

use super::clock::VirtualClock;
use super::link::RobotLink;
use midshift_agent::core::{AgentCore, CoreConfig, Input, Output};
use midshift_agent::memory::MemoryStore;
use midshift_agent::replay::Replayed;
use midshift_core::robot::{Lane, ReportedState};
use midshift_core::time::Clock;
use midshift_proto::link::v1::SessionResponse;
use midshift_proto::session::{Hello, LanePosition, PROTOCOL_VERSION, Previous, ToRobot};
use midshift_sim::handle::SimHandle;
use midshift_telemetry::TelemetryService;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;
use tokio_stream::StreamExt;

/// A session that was refused or has ended is opened again after this.
const RETRY: Duration = Duration::from_millis(500);

/// What the ways between a robot and the server are like.
#[derive(Clone, Copy, Debug)]
pub struct RobotConfig {
    /// Time that a message takes, each way.
    pub delay: Duration,
    /// Pause between two heartbeats; none: as the server says.
    pub heartbeat: Option<Duration>,
}

/// A robot.
pub struct Robot {
    core: AgentCore,
    body: SimHandle,
    clock: Arc<VirtualClock>,
    telemetry: TelemetryService,
    config: RobotConfig,
    link: Option<RobotLink>,
}

impl Robot {
    /// A robot that begins with nothing kept, around this body.
    pub fn new(body: SimHandle, clock: Arc<VirtualClock>, telemetry: TelemetryService, config: RobotConfig) -> Self {
        let robot_id = body.robot_id().clone();
        let memory = MemoryStore::new().load_now(&format!("ring-{robot_id}"));
        let of_core = CoreConfig { robot_id, bugs: Default::default(), update: None, server_is_proven: false };
        let core = AgentCore::new(of_core, Box::new(body.clone()), memory, clock.now());
        Self { core, body, clock, telemetry, config, link: None }
    }

    /// Lives until it is dropped, `after` the beginning: robots of a fleet are not switched on in the same moment.
    pub async fn run(mut self, after: Duration) {
        tokio::time::sleep(after).await;
        self.step(Input::Start);
        let mut network = self.body.network();
        loop {
            if *network.borrow_and_update() {
                self.attach().await;
            }
            while self.link.is_some() && *network.borrow_and_update() {
                self.wait().await;
            }
            if self.link.take().is_some() {
                self.step(Input::Disconnected);
            }
            self.work_alone(RETRY).await;
        }
    }

    async fn attach(&mut self) {
        let hello = self.hello();
        self.link = RobotLink::open(&self.telemetry, hello, self.config.delay).await.ok();
    }

    /// Hears the next message, or does what is due.
    async fn wait(&mut self) {
        let due = self.next_due();
        let Some(link) = &mut self.link else { return };
        tokio::select! {
            biased;
            message = link.down.next() => match message {
                Some(Ok(message)) => self.receive(message),
                Some(Err(_)) | None => self.link = None,
            },
            () = tokio::time::sleep(due) => self.step(Input::Tick),
        }
        if self.link.is_none() {
            self.step(Input::Disconnected);
        }
    }

    /// Goes on without a session for so long.
    async fn work_alone(&mut self, time: Duration) {
        let until = tokio::time::Instant::now() + time;
        while tokio::time::Instant::now() < until {
            let due = tokio::time::Instant::now() + self.next_due();
            tokio::time::sleep_until(due.min(until)).await;
            self.step(Input::Tick);
        }
    }

    /// Time until the core wants to be called. Never zero, so that nothing spins.
    fn next_due(&self) -> Duration {
        let now = self.clock.now();
        let wake = self.core.next_wake(&now);
        let site_ms = wake.site.map_or(u64::MAX, |at| at.since(now.site).as_ms());
        Duration::from_millis(wake.link.since(now.link).as_ms().min(site_ms).max(1))
    }

    fn receive(&mut self, message: SessionResponse) {
        match midshift_proto::parse(message) {
            Ok(ToRobot::Welcome(mut welcome)) => {
                if let Some(period) = self.config.heartbeat {
                    welcome.heartbeat_period_ms = period.as_millis() as u32;
                }
                self.step(Input::Connected(welcome));
            }
            Ok(ToRobot::Downlink(down)) => self.step(Input::Down(down)),
            Ok(ToRobot::MoveOver { .. }) => {}
            Ok(ToRobot::Close(_)) | Err(_) => self.link = None,
        }
    }

    fn step(&mut self, input: Input) {
        let mut inputs = VecDeque::from([input]);
        while let Some(input) = inputs.pop_front() {
            for output in self.core.step(self.clock.now(), input) {
                match output {
                    Output::Persist(batch, _) => inputs.push_back(Input::Persisted(batch)),
                    Output::Send(uplink) => {
                        if self.link.as_ref().is_some_and(|link| !link.send(*uplink)) {
                            self.link = None;
                        }
                    }
                    // There is no bulk connection: old STATUS goes on the session.
                    Output::Replay(replay) => {
                        inputs.push_back(Input::Replayed(replay.session_epoch, Replayed::NotServed));
                    }
                    Output::Job(_) | Output::DropJob | Output::Exit(_) => {}
                    Output::CheckIn(..) | Output::RedialStop(_) | Output::SaveStops(..) => {}
                }
            }
        }
    }

    fn hello(&self) -> Hello {
        let (now, memory) = (self.clock.now(), self.core.memory());
        let session = &memory.ledger.session;
        let position = |lane: Lane| {
            let buffer = memory.ring.lane(lane);
            (lane, LanePosition { first_seq: buffer.first(), next_seq: buffer.produced + 1 })
        };
        Hello {
            robot_id: self.core.robot_id().clone(),
            boot_id: format!("boot-{}", self.core.robot_id()),
            previous: (session.session_epoch > 0)
                .then(|| Previous { session_epoch: session.session_epoch, secret: session.secret.clone() }),
            inventory: self.core.inventory().clone(),
            reported: ReportedState { hb: 0, session_epoch: 0, ..self.core.reported(&now) },
            ring: memory.ring.id.clone(),
            lanes: Lane::ALL.into_iter().map(position).collect(),
            store_id: session.store_id.clone(),
            sent_unix_ms: now.wall.0,
            clock_rate_permille: self.clock.rate_permille(),
            protocol_versions: vec![PROTOCOL_VERSION],
            installed: String::new(),
        }
    }
}
