//! A swarm: one agent for each body of a fleet, in one process, with the person who walks among them.
//!
//! Invariant: each agent is the one a real robot runs, unchanged; only its body, its network and its crashes are
//! simulated. Called by `dev`, `sim run`, the bench and the tests.

use crate::fleet::{Fleet, Persistence};
use crate::handle::SimHandle;
use crate::launched::{Launched, Start};
use crate::service::Crash;
use midshift_agent::body::Body;
use midshift_agent::bugs::Bugs;
use midshift_agent::bulk::Bulk;
use midshift_agent::core::ExitReason;
use midshift_agent::dial::{self, Dial, TcpDial};
use midshift_agent::memory::MemoryStore;
use midshift_agent::session::{self, AgentConfig, Lines};
use midshift_agent::sets;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::start_policy::HANG_SECONDS;
use midshift_agent::stop::line::StopLine;
use midshift_agent::stop::storage::{FileStops, MemoryStops, STOP_FILE, StopStorage};
use midshift_agent::store::{self, Store};
use midshift_agent::tls::Tls;
use midshift_agent::trust_anchors::TrustAnchors;
use midshift_core::Boxed;
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::robot::StopLevel;
use midshift_core::time::Clock;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Notify, watch};
use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

pub use midshift_agent::program::AGENT_FILE;

/// Name of the folder of its sets of software there.
const SETS: &str = "sets";
/// The person goes round this often, milliseconds of site time.
const ROUND_MS: u64 = 5_000;
/// A crashed agent is started again after this, real time.
const RESTART: Duration = Duration::from_millis(500);

/// Makes the way to the server for one robot; nothing may pass while its network says false.
pub type DialFor = Arc<dyn Fn(&RobotId, watch::Receiver<bool>) -> Result<Arc<dyn Dial>, dial::Error> + Send + Sync>;
/// How each robot speaks TLS; one that is not in it speaks plain text.
pub type TlsOf = Arc<BTreeMap<RobotId, Tls>>;
/// Whether a task still wants its item from the robot that carries it.
pub type IsTaskLive = Arc<dyn Fn(&TaskId) -> bool + Send + Sync>;

/// A swarm that could not start or go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The server's address is not usable.
    #[error(transparent)]
    Dial(#[from] dial::Error),
    /// A directory could not be made.
    #[error("making {path}: {source}")]
    Dir {
        /// The directory that was to be made.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// An agent's ledger could not be kept.
    #[error("agent of {robot_id}: {source}")]
    Store {
        /// The robot that the agent is of.
        robot_id: RobotId,
        /// What the ledger's store says.
        source: store::Error,
    },
    /// An agent's software could not be kept.
    #[error("software of {robot_id}: {source}")]
    Sets {
        /// The robot that the agent is of.
        robot_id: RobotId,
        /// What the store of software says.
        source: sets::Error,
    },
}

/// What a swarm needs.
#[derive(Clone)]
pub struct SwarmConfig {
    /// Its bodies.
    pub fleet: Arc<Fleet>,
    /// Both clocks.
    pub clock: Arc<dyn Clock>,
    /// The way to the server.
    pub dial: DialFor,
    /// The same beside the sessions: for software and old STATUS.
    pub bulk: DialFor,
    /// How robots speak TLS.
    pub tls: TlsOf,
    /// The way to the stop service, at its own address; none: they have none, and obey no fleet stop.
    pub stop: Option<DialFor>,
    /// Where ledgers and rings are kept: in memory, or in `<dir>/<robot_id>/agent.db`.
    pub persistence: Persistence,
    /// Decides the spread of starts and of attempts to connect.
    pub seed: u64,
    /// Starts are spread over this, real time.
    pub spread: Duration,
    /// Naive rules for twins of tests; none outside them.
    pub bugs: Bugs,
    /// Which tasks a person leaves to their robots; none: nobody walks about.
    pub person: Option<IsTaskLive>,
    /// What they believe of software; none: theirs is not changed.
    pub software: Option<TrustAnchors>,
}

impl SwarmConfig {
    /// With stop lines over TCP to `uri`; over TLS if its sessions are.
    #[must_use]
    pub fn with_stop(self, uri: &str) -> Self {
        let (uri, tls) = (uri.to_owned(), self.tls.clone());
        let dial: DialFor = Arc::new(move |robot, network| {
            Ok(Arc::new(TcpDial::new(&uri, Some(network))?.with_tls(tls.get(robot).cloned())))
        });
        Self { stop: Some(dial), ..self }
    }
    /// Over TCP to `http://host:port`, all in memory, with a person to whom no load is dear.
    pub fn tcp(fleet: Arc<Fleet>, clock: Arc<dyn Clock>, uri: &str, seed: u64) -> Self {
        Self::over(fleet, clock, uri, Arc::default(), seed)
    }
    /// As [`SwarmConfig::tcp`], to `https://host:port` for those robots that have a way to speak TLS.
    pub fn over(fleet: Arc<Fleet>, clock: Arc<dyn Clock>, uri: &str, tls: TlsOf, seed: u64) -> Self {
        let (link, bulk) = (uri.to_owned(), uri.to_owned());
        let (link_tls, bulk_tls) = (tls.clone(), tls.clone());
        Self {
            fleet,
            clock,
            dial: Arc::new(move |robot, network| {
                Ok(Arc::new(TcpDial::new(&link, Some(network))?.with_tls(link_tls.get(robot).cloned())))
            }),
            bulk: Arc::new(move |robot, network| {
                Ok(Arc::new(TcpDial::bulk(&bulk, Some(network))?.with_tls(bulk_tls.get(robot).cloned())))
            }),
            tls,
            stop: None,
            persistence: Persistence::Memory,
            seed,
            spread: Duration::from_millis(500),
            bugs: Bugs::default(),
            person: Some(Arc::new(|_| false)),
            software: None,
        }
    }
}

/// How a swarm ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SwarmEnd {
    /// Robots whose agent gave up because another machine has its name.
    pub fenced: Vec<RobotId>,
    /// Crashes that were asked for.
    pub crashes: u64,
}

/// Agents that can be crashed one by one while they run.
pub struct Swarm {
    config: SwarmConfig,
    crashes: Arc<BTreeMap<RobotId, Notify>>,
}

impl Swarm {
    /// Ready to run.
    pub fn new(config: SwarmConfig) -> Self {
        let crashes = config.fleet.robots().iter().map(|r| (r.robot_id().clone(), Notify::new()));
        Self { crashes: Arc::new(crashes.collect()), config }
    }
    /// Crashes one agent: its task is dropped where it is, its body stands, and it is started again from what it had
    /// kept.
    pub fn crash(&self) -> Crash {
        let crashes = self.crashes.clone();
        Arc::new(move |robot_id| crashes.get(robot_id).inspect(|c| c.notify_one()).is_some())
    }
    /// Runs every agent until `shutdown`. Errors: the first agent that cannot go on ends all.
    pub fn run(self, shutdown: CancellationToken) -> Boxed<'static, Result<SwarmEnd, Error>> {
        Box::pin(async move {
            let ending = shutdown.child_token();
            let _ends_all = ending.clone().drop_guard();
            let mut agents = JoinSet::new();
            let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed ^ 0x7377_6172);
            let spread_us = self.config.spread.as_micros() as u64;
            for robot in self.config.fleet.robots() {
                let life = Life {
                    config: self.config.clone(),
                    robot: robot.clone(),
                    crashes: self.crashes.clone(),
                    rng: ChaCha8Rng::seed_from_u64(rng.random()),
                    memory: MemoryStore::new(),
                    stops: MemoryStops::default(),
                    starts_after: Duration::from_micros(rng.random_range(0..=spread_us)),
                };
                agents.spawn(life.run(ending.clone()));
            }
            let person = walk(self.config.clone());
            tokio::pin!(person);
            let mut end = SwarmEnd::default();
            loop {
                let ended = tokio::select! {
                    ended = agents.join_next() => ended,
                    never = &mut person => match never {},
                };
                match ended {
                    None => return Ok(end),
                    Some(Ok(one)) => {
                        let (fenced, crashes) = one?;
                        end.fenced.extend(fenced);
                        end.crashes += crashes;
                    }
                    Some(Err(panicked)) => std::panic::resume_unwind(panicked.into_panic()),
                }
            }
        })
    }
}

/// The person's rounds; ends only by being dropped.
async fn walk(config: SwarmConfig) -> Infallible {
    let Some(live) = config.person else { return std::future::pending().await };
    let rate = u64::from(config.clock.rate_permille()).max(1);
    loop {
        tokio::time::sleep(Duration::from_millis((ROUND_MS * 1000 / rate).max(1))).await;
        for deed in config.fleet.person_round(config.clock.now().site, &*live) {
            tracing::info!(?deed, "a person helped");
        }
    }
}

/// One robot's agent, from start to start.
struct Life {
    config: SwarmConfig,
    robot: SimHandle,
    crashes: Arc<BTreeMap<RobotId, Notify>>,
    rng: ChaCha8Rng,
    memory: MemoryStore,
    stops: MemoryStops,
    starts_after: Duration,
}

/// How one run of an agent ended.
enum Ended {
    Agent(ExitReason),
    /// It was asked to, or what its software says.
    Crashed,
}

impl Life {
    /// Until the end; says whether it was fenced, and how often it crashed.
    async fn run(mut self, shutdown: CancellationToken) -> Result<(Option<RobotId>, u64), Error> {
        let robot_id = self.robot.robot_id().clone();
        let launched = self.config.software.as_ref().map(|_| self.launched());
        let mut crashes = 0;
        let mut pause = self.starts_after;
        loop {
            tokio::select! {
                () = shutdown.cancelled() => return Ok((None, crashes)),
                () = tokio::time::sleep(pause) => {}
            }
            pause = RESTART;
            let now = self.config.clock.now().site;
            let failed = |source| Error::Sets { robot_id: robot_id.clone(), source };
            let start = launched.as_ref().map(|l| l.start(&self.robot, now)).transpose().map_err(failed)?;
            let hangs_after = match start {
                Some(Start::Dead(why)) => {
                    tracing::info!(%robot_id, why, "agent ended at its start");
                    pause = launched.as_ref().map_or(RESTART, Launched::pause);
                    continue;
                }
                Some(Start::Runs { hangs_after }) => hangs_after,
                None => None,
            };
            match self.run_once(launched.as_ref(), hangs_after, &shutdown, &mut crashes).await? {
                Ended::Agent(ExitReason::Shutdown) => return Ok((None, crashes)),
                Ended::Agent(ExitReason::FencedTwice) => return Ok((Some(robot_id), crashes)),
                Ended::Agent(ExitReason::Switched) => {
                    if let Some(launched) = &launched {
                        launched.switched();
                        pause = Duration::ZERO;
                    }
                }
                Ended::Crashed => pause = launched.as_ref().map_or(RESTART, Launched::pause),
            }
            self.robot.stop(self.config.clock.now().site, StopLevel::Halt);
            self.robot.poll(self.config.clock.now().site);
        }
    }

    /// One run of the agent. One that hangs is left where it is, with its connection, until its launcher would kill it.
    async fn run_once(
        &mut self,
        launched: Option<&Launched>,
        hangs_after: Option<Duration>,
        shutdown: &CancellationToken,
        crashes: &mut u64,
    ) -> Result<Ended, Error> {
        let robot_id = self.robot.robot_id().clone();
        let link = (self.config.dial)(&robot_id, self.robot.network())?;
        let bulk = Bulk::new((self.config.bulk)(&robot_id, self.robot.network())?);
        let store = self.store().await?;
        let config = self.agent_config(launched, &bulk)?;
        let (body, clock) = (Box::new(self.robot.clone()), self.config.clock.clone());
        let agent = session::run(config, body, store, clock, Lines { link, bulk }, shutdown.clone());
        tokio::pin!(agent);
        let crash = async {
            match self.crashes.get(&robot_id) {
                Some(crash) => crash.notified().await,
                None => std::future::pending().await,
            }
        };
        let hang = async {
            match hangs_after {
                Some(after) => tokio::time::sleep(after).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            ended = &mut agent => match ended {
                Ok(reason) => return Ok(Ended::Agent(reason)),
                Err(session::Error::Store(source)) => return Err(Error::Store { robot_id, source }),
            },
            () = crash => {
                *crashes += 1;
                tracing::info!(%robot_id, "agent crashed");
                return Ok(Ended::Crashed);
            }
            () = hang => {}
        }
        tokio::select! {
            () = shutdown.cancelled() => return Ok(Ended::Agent(ExitReason::Shutdown)),
            () = tokio::time::sleep(Duration::from_secs(HANG_SECONDS)) => {}
        }
        tracing::info!(%robot_id, "agent gave no sign and was killed");
        Ok(Ended::Crashed)
    }

    fn launched(&self) -> Launched {
        let dir = match &self.config.persistence {
            Persistence::Memory => None,
            Persistence::Dir(dir) => Some(dir.join(self.robot.robot_id().as_str()).join(SETS)),
        };
        Launched::new(dir.as_deref(), &self.robot)
    }

    fn agent_config(&mut self, launched: Option<&Launched>, bulk: &Bulk) -> Result<AgentConfig, Error> {
        let robot_id = self.robot.robot_id().clone();
        let update = match (&self.config.software, launched) {
            (Some(trust), Some(launched)) => {
                let failed = |source| Error::Sets { robot_id: robot_id.clone(), source };
                Some(launched.updates(trust, bulk.clone()).map_err(failed)?)
            }
            _ => None,
        };
        // What must differ between two processes comes from the wall's clock too; the seed alone would repeat.
        let wall = self.config.clock.now().wall.0;
        Ok(AgentConfig {
            update,
            stop: self.stop_line()?,
            robot_id,
            boot_id: format!("{wall:x}-{:016x}", self.rng.random::<u64>()),
            new_ring_id: format!("{wall:x}-{:016x}", self.rng.random::<u64>()),
            seed: self.rng.random(),
            bugs: self.config.bugs,
            pulse: launched.map(Launched::pulse),
        })
    }
    /// Its way to the stop service, if the swarm has one, and what it keeps of stops: across its crashes, as a disk
    /// would.
    fn stop_line(&self) -> Result<Option<StopLine>, Error> {
        let Some(dial) = &self.config.stop else { return Ok(None) };
        let robot_id = self.robot.robot_id();
        let storage: Box<dyn StopStorage> = match &self.config.persistence {
            Persistence::Memory => Box::new(self.stops.clone()),
            Persistence::Dir(dir) => {
                let dir = dir.join(robot_id.as_str());
                make_dir(&dir)?;
                Box::new(FileStops::new(&dir.join(STOP_FILE)))
            }
        };
        Ok(Some(StopLine { dial: dial(robot_id, self.robot.stop_network())?, storage }))
    }
    async fn store(&self) -> Result<Box<dyn Store>, Error> {
        let Persistence::Dir(dir) = &self.config.persistence else { return Ok(Box::new(self.memory.clone())) };
        let dir = dir.join(self.robot.robot_id().as_str());
        let failed = |source| Error::Store { robot_id: self.robot.robot_id().clone(), source };
        make_dir(&dir)?;
        Ok(Box::new(SqliteStore::open(&dir.join(AGENT_FILE)).await.map_err(failed)?))
    }
}

fn make_dir(path: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(|source| Error::Dir { path: path.to_owned(), source })
}
