//! The room of one run: a server, ten robots and their clients on a simulated network, and the hall in which the bodies are.
//!
//! Invariant: bodies, disks and the world of items outlive the processes that use them; everything else dies with its process. One
//! thread, one time, one seed: the same plan gives the same run.

use crate::body::WatchedBody;
use crate::client;
use crate::clock::{MachineClock, Skew, TrueTime};
use crate::disk::{RobotDisk, ServerDisk};
use crate::net::{self, Ear, SERVER, SimDial, Wire};
use crate::observer::Shared;
use crate::plan::ROBOTS;
use midshift::server::{Parts, Server};
use midshift_agent::body::Body;
use midshift_agent::bugs::Bugs;
use midshift_agent::memory::MemoryStore as RobotMemory;
use midshift_agent::session::{self, AgentConfig};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::StopLevel;
use midshift_core::site::{DEMO, Site, text};
use midshift_core::task::machine::Phase;
use midshift_core::time::Clock;
use midshift_ota::OtaService;
use midshift_sim::faults::FaultRates;
use midshift_sim::hall::{Hall, HallConfig};
use midshift_store::{FRAME_BYTES_DEFAULT, FrameLog, MemoryFrames, MemoryStore, StoreId};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// Time of one step of the network.
const TICK: Duration = Duration::from_millis(10);
/// Bodies are looked at this often, milliseconds.
const BODIES_MS: u64 = 100;
/// The person goes round this often, milliseconds.
const PERSON_MS: u64 = 5_000;
/// Nothing lasts longer.
const LONGEST: Duration = Duration::from_secs(3_600);

/// Naive rules of one run.
#[derive(Clone, Copy, Debug, Default)]
pub struct Naive {
    /// Of every agent.
    pub agent: Bugs,
    /// Of the server.
    pub server: midshift::server::Naive,
}

/// What a room is opened with.
pub struct RoomConfig {
    /// Decides everything.
    pub seed: u64,
    /// Clocks of robots.
    pub skews: Vec<Skew>,
    /// Longest way of a message, milliseconds.
    pub latency_ms: u64,
    /// How often bodies fail.
    pub faults: FaultRates,
    /// Naive rules.
    pub naive: Naive,
}

/// The room.
pub struct Room {
    /// The network and its machines.
    pub sim: turmoil::Sim<'static>,
    /// True time.
    pub time: TrueTime,
    /// The witness.
    pub observer: Shared,
    /// The bodies.
    pub hall: Arc<Hall>,
    /// The server's disk.
    pub disk: Arc<ServerDisk>,
    /// What clients ask for.
    pub desk: Rc<client::Desk>,
    /// What each robot hears.
    pub ears: Vec<Ear>,
    /// Ways to the robots, and what was written on broken ones.
    pub wire: Wire,
    steps: u64,
}

/// The site of every run.
pub fn site() -> anyhow::Result<Arc<Site>> {
    Ok(Arc::new(text::parse(DEMO)?))
}

/// Name of a robot's machine.
pub fn machine(robot: usize) -> String {
    format!("robot-{robot}")
}

/// Name of the clients' machine.
pub const CLIENT: &str = "client";

impl Room {
    /// Sets everything up; nothing has run yet.
    pub fn open(config: &RoomConfig) -> anyhow::Result<Self> {
        let mut sim = turmoil::Builder::new()
            .rng_seed(config.seed)
            .simulation_duration(LONGEST)
            .tick_duration(TICK)
            .min_message_latency(Duration::from_millis(1))
            .max_message_latency(Duration::from_millis(config.latency_ms.max(2)))
            .tcp_capacity(4_096)
            .enable_random_order()
            .build();
        let (time, site) = (TrueTime::default(), site()?);
        let clock = MachineClock::boot(&time, Skew::default());
        let store_id = StoreId(Arc::from(format!("store-{}", config.seed)));
        let store = Arc::new(MemoryStore::new(site.site_id().clone(), store_id, clock.clone()));
        let observer = Shared::new(time.clone(), store.clone());
        let disk = Arc::new(ServerDisk::new(store, observer.clone(), config.seed));
        let frames: Arc<dyn FrameLog> = Arc::new(MemoryFrames::new(clock.clone(), FRAME_BYTES_DEFAULT));
        let of_hall = HallConfig { faults: config.faults, ..HallConfig::new(site.clone(), ROBOTS, config.seed) };
        let hall = Arc::new(Hall::open(&of_hall, &clock.now())?);
        observer.look().watch_world(hall.worlds()[0].clone());
        let wire = Wire::default();
        serve(&mut sim, &time, &site, disk.clone(), frames, config.naive, &wire);
        let ears: Vec<Ear> = (0..ROBOTS).map(|_| Ear::default()).collect();
        for (robot, ear) in ears.iter().enumerate() {
            let skew = config.skews.get(robot).copied().unwrap_or_default();
            let agent = Agent::new(robot, &hall, &time, &observer, skew, (ear, &wire), config);
            run_agent(&mut sim, machine(robot), agent);
        }
        let desk = Rc::new(client::Desk::default());
        let of_client = desk.clone();
        sim.host(CLIENT, move || client::run(of_client.clone()));
        Ok(Self { sim, time, observer, hall, disk, desk, ears, wire, steps: 0 })
    }
    /// True time so far, milliseconds.
    pub fn now_ms(&self) -> u64 {
        self.steps * TICK.as_millis() as u64
    }
    /// A robot's name.
    pub fn robot_id(&self, robot: usize) -> RobotId {
        self.hall.robots()[robot].robot_id().clone()
    }
    /// One step of the network, and a look at everything.
    pub fn step(&mut self) -> anyhow::Result<()> {
        self.sim.step().map_err(|error| anyhow::anyhow!("a machine ended: {error}"))?;
        self.steps += 1;
        self.time.note(self.sim.elapsed());
        if self.now_ms().is_multiple_of(BODIES_MS) {
            self.observer.look().bodies(self.hall.robots());
        }
        if self.now_ms().is_multiple_of(PERSON_MS) {
            let observer = self.observer.clone();
            let live = move |task_id: &TaskId| {
                let seen = observer.look();
                seen.tasks().get(task_id).is_some_and(|t| !t.phase.is_terminal() && t.phase != Phase::NeedsOperator)
            };
            self.hall.person_round(self.time.site(), &live);
        }
        Ok(())
    }
    /// Steps until `done`; an error after `limit_ms` more, or at the first finding.
    pub fn until(&mut self, what: &str, limit_ms: u64, mut done: impl FnMut(&mut Self) -> bool) -> anyhow::Result<()> {
        let end = self.now_ms() + limit_ms;
        while !done(self) {
            self.step()?;
            anyhow::ensure!(self.observer.look().findings().is_empty(), "a law is broken");
            anyhow::ensure!(self.now_ms() < end, "{} s passed in vain for: {what}", limit_ms / 1000);
        }
        Ok(())
    }
    /// An agent's process dies: its body stands still where it is.
    pub fn crash_agent(&mut self, robot: usize) {
        self.sim.crash(machine(robot));
        let now = self.time.site();
        let mut body = self.hall.robots()[robot].clone();
        body.stop(now, StopLevel::Halt);
        body.poll(now);
    }
    /// It is started again.
    pub fn restart_agent(&mut self, robot: usize) {
        let robot_id = self.robot_id(robot);
        self.observer.look().restarted(&robot_id);
        self.sim.bounce(machine(robot));
    }
    /// Ends the server's process.
    pub fn crash_server(&mut self) {
        self.sim.crash(SERVER);
    }
    /// Starts it again.
    pub fn restart_server(&mut self) {
        self.sim.bounce(SERVER);
    }
}

fn serve(
    sim: &mut turmoil::Sim<'static>,
    time: &TrueTime,
    site: &Arc<Site>,
    disk: Arc<ServerDisk>,
    frames: Arc<dyn FrameLog>,
    naive: Naive,
    wire: &Wire,
) {
    let (time, site, wire) = (time.clone(), site.clone(), wire.clone());
    sim.host(SERVER, move || {
        let (time, site, disk, frames) = (time.clone(), site.clone(), disk.clone(), frames.clone());
        let wire = wire.clone();
        async move {
            loop {
                let parts = Parts {
                    store: disk.clone(),
                    frames: frames.clone(),
                    site: site.clone(),
                    site_text: DEMO.to_owned(),
                    clock: MachineClock::boot(&time, Skew::default()),
                    ota: OtaService::without_keys(),
                    sim: None,
                    naive: naive.server,
                    planning: tokio::runtime::Handle::current(),
                };
                // A service manager starts a server again that could not read its disk.
                if let Ok(server) = Server::new(parts, CancellationToken::new()).await {
                    server.serve(net::incoming(wire.clone()).await?).await?;
                }
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
        }
    });
}

/// What one agent's process is made of, each time it starts.
#[derive(Clone)]
struct Agent {
    robot: usize,
    seed: u64,
    hall: Arc<Hall>,
    time: TrueTime,
    observer: Shared,
    skew: Skew,
    ear: Ear,
    wire: Wire,
    memory: RobotMemory,
    bugs: Bugs,
    lives: Arc<AtomicU64>,
}

impl Agent {
    fn new(
        robot: usize,
        hall: &Arc<Hall>,
        time: &TrueTime,
        observer: &Shared,
        skew: Skew,
        (ear, wire): (&Ear, &Wire),
        config: &RoomConfig,
    ) -> Self {
        Self {
            robot,
            seed: config.seed,
            hall: hall.clone(),
            time: time.clone(),
            observer: observer.clone(),
            skew,
            ear: ear.clone(),
            wire: wire.clone(),
            memory: RobotMemory::new(),
            bugs: config.naive.agent,
            lives: Arc::default(),
        }
    }

    async fn live(self) -> anyhow::Result<()> {
        let life = self.lives.fetch_add(1, Relaxed);
        let number = self.seed.wrapping_mul(1_000_003) + self.robot as u64 * 1_009 + life;
        // Machines are not switched on in the same moment.
        tokio::time::sleep(Duration::from_millis(number % 700)).await;
        let body = &self.hall.robots()[self.robot];
        let robot_id = body.robot_id().clone();
        let config = AgentConfig {
            update: None,
            robot_id: robot_id.clone(),
            boot_id: format!("boot-{}-{life}", self.robot),
            new_ring_id: format!("ring-{}-{life}", self.robot),
            seed: number,
            bugs: self.bugs,
            pulse: None,
        };
        let witness = WatchedBody::new(body.clone(), self.observer.clone());
        let disk = RobotDisk::open(self.memory.clone(), robot_id.clone(), self.observer.clone(), number);
        let clock: Arc<dyn Clock> = MachineClock::boot(&self.time, self.skew);
        let never = CancellationToken::new();
        let dial = Arc::new(SimDial { ear: self.ear.clone(), machine: machine(self.robot), wire: self.wire.clone() });
        let end = session::run(config, Box::new(witness), Box::new(disk), clock, dial, never).await?;
        self.observer.look().find(format!("the agent of {robot_id} ended: {end:?}"));
        std::future::pending().await
    }
}

fn run_agent(sim: &mut turmoil::Sim<'static>, machine: String, agent: Agent) {
    sim.host(machine, move || {
        let agent = agent.clone();
        async move { Ok(agent.live().await?) }
    });
}
