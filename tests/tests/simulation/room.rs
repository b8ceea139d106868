//! The room of one run: a server, ten robots and their clients on a simulated network, and the hall in which the bodies are.
//!
//! Invariant: bodies, disks and the world of items outlive the processes that use them; everything else dies with its process. One
//! thread, one time, one seed: the same plan gives the same run.

use crate::agent::Agent;
use crate::client;
use crate::clock::{MachineClock, Skew, TrueTime};
use crate::disk::{ServerDisk, ServerFrames};
use crate::net::{self, Ear, SERVER, SimDial, Wire, machine};
use crate::newer::Newer;
use crate::observer::Shared;
use crate::software::Software;
use crate::stops::Stops;
use crate::wall::ServerWall;
use midshift_agent::body::Body;
use midshift_agent::bugs::Bugs;
use midshift_agent::memory::MemoryStore as RobotMemoryStore;
use midshift_cli::roles::Roles;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::StopLevel;
use midshift_core::site::{DEMO, Site, text};
use midshift_core::task::machine::Phase;
use midshift_core::time::{SiteDuration, SiteTime};
use midshift_edge::Incoming;
use midshift_ota::rollouts::RolloutService;
use midshift_server::{Components, Server};
use midshift_sim::faults::{FaultRates, Injected};
use midshift_sim::fleet::{Fleet, FleetConfig};
use midshift_sim::launched::Launched;
use midshift_store::{FRAME_BYTES_DEFAULT, FrameLog, MemoryFrames, MemoryStore, StoreId};
use midshift_tests::player::Player;
use midshift_tests::player::line::Line;
use std::path::PathBuf;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// Where machines of the simulation are, for a port that counts addresses.
const fn nowhere(_: &net::Connection) -> std::net::SocketAddr {
    std::net::SocketAddr::new(std::net::IpAddr::V4(std::net::Ipv4Addr::LOCALHOST), 1)
}

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
    pub server: midshift_server::NaiveRules,
}

/// What a room is opened with.
pub struct RoomConfig {
    /// Decides everything.
    pub seed: u64,
    /// How many.
    pub robots: usize,
    /// Clocks of robots.
    pub skews: Vec<Skew>,
    /// Longest way of a message, milliseconds.
    pub latency_ms: u64,
    /// How often bodies fail.
    pub faults: FaultRates,
    /// Naive rules.
    pub naive: Naive,
    /// Planners of roll-outs on the one store; two race.
    pub planners: usize,
    /// A stop service is beside the server, and every robot has a line to it.
    pub stops: bool,
    /// Text of the site.
    pub site: String,
    /// Robots without a body that behave badly.
    pub players: Vec<Arc<Mutex<Player>>>,
    /// Which programs are of the next version; none: nobody asks.
    pub newer: Option<Newer>,
}

/// The room.
pub struct Room {
    /// The network and its machines.
    pub sim: turmoil::Sim<'static>,
    /// True time.
    pub time: TrueTime,
    /// The wall of the server's machine.
    pub wall: ServerWall,
    /// The witness.
    pub observer: Shared,
    /// The bodies.
    pub hall: Arc<Fleet>,
    /// The server's disk.
    pub disk: Arc<ServerDisk>,
    /// What clients ask for.
    pub desk: Rc<client::Desk>,
    /// What each robot hears.
    pub ears: Vec<Ear>,
    /// Ways to the robots, and what was written on broken ones.
    pub wire: Wire,
    /// The stop service, if there is one.
    pub stop: Option<Stops>,
    /// Releases that robots may have.
    pub software: Arc<Software>,
    /// The memory of the server.
    pub store: Arc<MemoryStore>,
    /// The launcher of each robot.
    pub launched: Vec<Arc<Launched>>,
    stops: Vec<Option<SiteTime>>,
    steps: u64,
}

/// The site of every run.
pub fn site() -> anyhow::Result<Arc<Site>> {
    Ok(Arc::new(text::parse(DEMO)?))
}

/// Name of the clients' machine.
pub const CLIENT: &str = "client";

impl Room {
    /// Sets everything up; nothing has run yet.
    pub fn open(config: &RoomConfig) -> anyhow::Result<Self> {
        let mut sim = network(config);
        let (time, site) = (TrueTime::default(), Arc::new(text::parse(&config.site)?));
        let wall = ServerWall::new(&time);
        let clock = wall.boot();
        let store_id = StoreId(Arc::from(format!("store-{}", config.seed)));
        let store = Arc::new(MemoryStore::new(site.site_id().clone(), store_id, clock.clone()));
        let observer = Shared::new(time.clone(), store.clone());
        let disk = Arc::new(ServerDisk::new(store.clone(), observer.clone(), config.seed, config.newer.clone()));
        let frames = MemoryFrames::new(clock.clone(), FRAME_BYTES_DEFAULT);
        let frames: Arc<dyn FrameLog> = Arc::new(ServerFrames::new(frames, disk.clone()));
        let of_hall =
            FleetConfig { faults: config.faults, ..FleetConfig::new(site.clone(), config.robots, config.seed) };
        let hall = Arc::new(Fleet::open(&of_hall, &clock.now())?);
        observer.lock().watch_world(hall.worlds()[0].clone());
        let wire = Wire::default();
        let software = Arc::new(Software::make(clock.now().wall, site.site_id().clone())?);
        let keys = software.trust.directive_keys.clone();
        observer.lock().changes().watch(keys, software.signed.clone(), hall.robots());
        let stop = if config.stops { Some(Stops::open(&mut sim, &time, &site, config.robots)?) } else { None };
        let folder = stop.as_ref().map(Stops::folder);
        serve(&mut sim, &wall, &site, disk.clone(), frames, config, &wire, &software, folder);
        let ears: Vec<Ear> = (0..config.robots).map(|_| Ear::default()).collect();
        let launched: Vec<_> = hall.robots().iter().map(|body| Arc::new(Launched::new(None, body))).collect();
        for (robot, ear) in ears.iter().enumerate() {
            let agent = Agent {
                robot,
                seed: config.seed,
                body: hall.robots()[robot].clone(),
                time: time.clone(),
                observer: observer.clone(),
                skew: config.skews.get(robot).copied().unwrap_or_default(),
                ear: ear.clone(),
                wire: wire.clone(),
                stop: stop.as_ref().map(|stops| stops.line(robot)),
                memory: RobotMemoryStore::new(),
                launched: launched[robot].clone(),
                trust: software.trust.clone(),
                bugs: config.naive.agent,
                newer: config.newer.clone(),
                lives: Arc::default(),
            };
            run_agent(&mut sim, agent);
        }
        for (number, player) in config.players.iter().enumerate() {
            observer.lock().behaves_badly(player.clone());
            play(&mut sim, number, player, &time, &wire);
        }
        let desk = Rc::new(client::Desk::default());
        let of_client = desk.clone();
        sim.host(CLIENT, move || client::run(of_client.clone()));
        Ok(Self {
            sim,
            time,
            wall,
            observer,
            hall,
            disk,
            desk,
            ears,
            wire,
            stop,
            software,
            store,
            launched,
            stops: vec![None; config.robots],
            steps: 0,
        })
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
        self.let_go();
        if self.now_ms().is_multiple_of(BODIES_MS) {
            self.observer.lock().bodies(self.hall.robots());
        }
        if self.now_ms().is_multiple_of(PERSON_MS) {
            let observer = self.observer.clone();
            let live = move |task_id: &TaskId| {
                let seen = observer.lock();
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
            anyhow::ensure!(self.observer.lock().findings().is_empty(), "a law is broken");
            anyhow::ensure!(self.now_ms() < end, "{} s passed in vain for: {what}", limit_ms / 1000);
        }
        Ok(())
    }
    /// The maker's own safety system stops a body for so long, milliseconds, and ends that by itself.
    pub fn stop_body(&mut self, robot: usize, lasts_ms: u64) {
        let now = self.time.site();
        self.hall.robots()[robot].inject(now, Injected::HardwareStop(SiteDuration(lasts_ms)));
        self.stops[robot] = Some(now + SiteDuration(lasts_ms));
        let (robot_id, us) = (self.robot_id(robot), self.time.us());
        self.observer.lock().changes().stopped(&robot_id, Some(us));
    }
    /// Its own safety system stops it now.
    pub fn is_stopped(&self, robot: usize) -> bool {
        self.stops[robot].is_some()
    }
    /// Forgets stops that are over.
    fn let_go(&mut self) {
        let now = self.time.site();
        for robot in 0..self.stops.len() {
            if self.stops[robot].is_some_and(|until| until <= now) {
                self.stops[robot] = None;
                let robot_id = self.robot_id(robot);
                self.observer.lock().changes().stopped(&robot_id, None);
            }
        }
    }
    /// An agent's process dies: its body stands still where it is. With the power goes what its disk had not yet.
    pub fn crash_agent(&mut self, robot: usize, power: bool) {
        self.sim.crash(machine(robot));
        if power {
            self.launched[robot].lose_power();
        }
        let now = self.time.site();
        let mut body = self.hall.robots()[robot].clone();
        body.stop(now, StopLevel::Halt);
        body.poll(now);
    }
    /// It is started again.
    pub fn restart_agent(&mut self, robot: usize) {
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

fn network(config: &RoomConfig) -> turmoil::Sim<'static> {
    turmoil::Builder::new()
        .rng_seed(config.seed)
        .simulation_duration(LONGEST)
        .tick_duration(TICK)
        .min_message_latency(Duration::from_millis(1))
        .max_message_latency(Duration::from_millis(config.latency_ms.max(2)))
        .tcp_capacity(4_096)
        .enable_random_order()
        .build()
}

#[expect(clippy::too_many_arguments, reason = "everything that a server stands on in this room, once")]
fn serve(
    sim: &mut turmoil::Sim<'static>,
    wall: &ServerWall,
    site: &Arc<Site>,
    disk: Arc<ServerDisk>,
    frames: Arc<dyn FrameLog>,
    config: &RoomConfig,
    wire: &Wire,
    software: &Arc<Software>,
    stops: Option<PathBuf>,
) {
    let (naive, planners, site_text) = (config.naive, config.planners, config.site.clone());
    let (wall, site, wire, software) = (wall.clone(), site.clone(), wire.clone(), software.clone());
    sim.host(SERVER, move || {
        let (wall, site, disk, frames) = (wall.clone(), site.clone(), disk.clone(), frames.clone());
        let (wire, software, site_text, stops) = (wire.clone(), software.clone(), site_text.clone(), stops.clone());
        async move {
            loop {
                let clock = wall.boot();
                let ota = software.open(clock.clone()).await?;
                let parts = Components {
                    stop_port: None,
                    keep: Default::default(),
                    jumped_before: None,
                    roles: Roles::default(),
                    drain: Duration::ZERO,
                    heard: None,
                    store: disk.clone(),
                    frames: frames.clone(),
                    site: site.clone(),
                    site_text: site_text.clone(),
                    map: Default::default(),
                    clock,
                    ota,
                    reader: None,
                    sim: None,
                    naive: naive.server,
                    stops: stops.clone(),
                    identity: None,
                    port: midshift_process::door::alone("business"),
                    planning: tokio::runtime::Handle::current(),
                };
                // A service manager starts a server again that could not read its disk.
                let (ota, clock) = (parts.ota.clone(), parts.clock.clone());
                if let Ok(server) = Server::new(parts, CancellationToken::new()).await {
                    for _ in 1..planners {
                        let parts = midshift_ota::rollouts::Parts {
                            store: disk.clone(),
                            board: server.board(),
                            site: site.clone(),
                            clock: clock.clone(),
                            ota: ota.clone(),
                            bugs: naive.server.rollouts,
                        };
                        let (face, planner) = RolloutService::new(parts, CancellationToken::new());
                        tokio::spawn(async move {
                            // A planner whose face is gone would end.
                            let _face = face;
                            planner.run(CancellationToken::new()).await
                        });
                    }
                    server
                        .serve(Incoming::new(net::incoming(wire.clone()).await?, nowhere as fn(&net::Connection) -> _))
                        .await?;
                }
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
        }
    });
}

fn run_agent(sim: &mut turmoil::Sim<'static>, agent: Agent) {
    sim.host(machine(agent.robot), move || {
        let agent = agent.clone();
        async move { Ok(agent.live().await?) }
    });
}

/// Name of the machine of a player.
pub fn player_machine(number: usize) -> String {
    format!("player-{number}")
}

fn play(sim: &mut turmoil::Sim<'static>, number: usize, player: &Arc<Mutex<Player>>, time: &TrueTime, wire: &Wire) {
    let (player, time, wire) = (player.clone(), time.clone(), wire.clone());
    sim.host(player_machine(number), move || {
        let (machine, wire) = (player_machine(number), wire.clone());
        let dial = SimDial { to: SERVER, ear: Ear::default(), machine, wire, voice: None };
        let line = Line::new(player.clone(), Arc::new(dial), MachineClock::boot(&time, Skew::default()));
        async move {
            line.play().await;
            Ok(())
        }
    });
}
