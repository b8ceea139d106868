//! Robots in processes of their own: one agent with a simulated body that survives its process, or a swarm against a server elsewhere.

use crate::enrol_simulated::{Machines, Replace, Replaced};
use crate::software::{self, Behaving};
use anyhow::{Context, bail};
use midshift_agent::core::ExitReason;
use midshift_agent::program::{Machine, RunOptions};
use midshift_cli::endpoint::{Endpoint, with_scheme};
use midshift_cli::site_file;
use midshift_core::Boxed;
use midshift_core::ids::{RobotId, WaypointId};
use midshift_core::time::Clock;
use midshift_process::clock;
use midshift_process::door;
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::FaultRates;
use midshift_sim::fleet::{Fleet, FleetConfig, Persistence};
use midshift_sim::handle::SimHandle;
use midshift_sim::person::Person;
use midshift_sim::service::SimFace;
use midshift_sim::swarm::{Swarm, SwarmConfig};
use midshift_sim::world::WorldConfig;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::service::Routes;

pub use midshift_agent::program::{Config, IdentityFlags, StopFlags};

/// How often a person looks, real time.
const VISIT: Duration = Duration::from_secs(5);

/// One agent with a simulated body.
#[derive(Clone, Debug, clap::Args)]
pub struct AgentRun {
    /// What every program of a robot is told.
    #[command(flatten)]
    pub config: Config,
    /// The site file the body lives on. Without it the built-in demo site.
    #[arg(long)]
    pub site: Option<PathBuf>,
    /// Where a new body stands; later starts find the body where it was left. Without it where the site file says that it starts, else the first
    /// starting place that the file gives to nobody, the same for every such robot: name one each when there are several.
    #[arg(long)]
    pub start: Option<String>,
    /// Seed of the body.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// How many times as fast as real a body works; clocks are not touched.
    #[arg(long, default_value_t = 1.0)]
    pub body_speed: f64,
    /// Nothing goes wrong by itself.
    #[arg(long)]
    pub no_faults: bool,
    /// A simulated person mends it and takes away what it was left with.
    #[arg(long)]
    pub person: bool,
}

/// Robots of one process against a server elsewhere.
#[derive(Clone, Debug, clap::Args)]
pub struct SimRun {
    /// How many robots the whole site has.
    #[arg(long, default_value_t = 12)]
    pub robots: usize,
    /// Only these of them, from 1, e.g. 1..5000 (the end is not included): several processes take a part each.
    #[arg(long, value_parser = part)]
    pub only: Option<(usize, usize)>,
    /// The server, host:port.
    #[arg(long, env = "MIDSHIFT_SERVER", default_value = "127.0.0.1:7420")]
    pub server: String,
    /// The site. Without it the built-in demo site.
    #[arg(long)]
    pub site: Option<PathBuf>,
    /// Seed of bodies and faults.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Begin of each robot's name.
    #[arg(long, default_value = "rbt-")]
    pub prefix: String,
    /// More robots than the site has seats: they stand in each other, and places are not judged.
    #[arg(long)]
    pub crowded: bool,
    /// Keep ledgers, bodies and journals here instead of in memory.
    #[arg(long)]
    pub data: Option<PathBuf>,
    /// Nothing goes wrong by itself.
    #[arg(long)]
    pub no_faults: bool,
    /// Whose software they take: the trust file of a robot of the site. Without it they keep what they came with.
    #[arg(long)]
    pub trust: Option<PathBuf>,
    /// Also in place of robots that never said they are simulated: their machines lose their certificates.
    #[arg(long)]
    pub replace: bool,
    /// Also answer `sim.v1` (faults) here.
    #[arg(long)]
    pub listen: Option<SocketAddr>,
    /// The way to whoever says who is who.
    #[command(flatten)]
    pub identity: IdentityFlags,
    /// The way to the stop service.
    #[command(flatten)]
    pub stop: StopFlags,
}

fn part(text: &str) -> Result<(usize, usize), String> {
    let bad = || "must be FROM..TO, from 1, TO not included".to_owned();
    let (from, to) = text.split_once("..").ok_or_else(bad)?;
    let (from, to): (usize, usize) = (from.parse().map_err(|_| bad())?, to.parse().map_err(|_| bad())?);
    if from == 0 || to <= from { Err(bad()) } else { Ok((from - 1, to - 1)) }
}

/// Runs one agent until `stop`. Fenced twice is an error: another machine has this robot's name.
pub fn agent(args: AgentRun, stop: CancellationToken) -> Boxed<'static, anyhow::Result<ExitReason>> {
    agent_in_hand(args, |_, _| (), stop)
}

/// As [`agent`]; `hand` is given its body before it starts, and the clocks of the process, to do something to it later.
pub fn agent_in_hand(
    args: AgentRun,
    hand: impl FnOnce(&SimHandle, &Arc<dyn Clock>) + Send + 'static,
    stop: CancellationToken,
) -> Boxed<'static, anyhow::Result<ExitReason>> {
    Box::pin(one_agent(args, Box::new(hand), stop))
}

/// Whoever is given a body and the clocks.
type Hand = Box<dyn FnOnce(&SimHandle, &Arc<dyn Clock>) + Send>;

async fn one_agent(args: AgentRun, hand: Hand, stop: CancellationToken) -> anyhow::Result<ExitReason> {
    let robot_id = args.config.robot_id()?;
    let site = site_file::load(args.site.as_deref(), None, None)?.site;
    let clock = clock::clock(1000);
    let start = match &args.start {
        Some(name) => WaypointId::parse(name)?,
        None => site
            .starts_of(std::slice::from_ref(&robot_id))
            .first()
            .map(|at| site.name_of(*at).clone())
            .context("the site has no place to start at; name one with --start")?,
    };
    if site.find(&start).is_none() {
        bail!("the site has no waypoint {start}");
    }
    let data = args.config.data.clone();
    let machine = Machine::open(args.config, clock.clone()).await?;
    let software = machine.software().map(|software| Behaving::read(software, &site)).transpose()?;
    let mut config = BodyConfig::new(robot_id.clone(), args.seed, start);
    if let Some(software) = &software {
        software.shape(&mut config);
    }
    let pace = args.body_speed.clamp(0.1, 100.0);
    config.pace_permille = (pace * 1000.0) as u32;
    config.faults = if args.no_faults { FaultRates::none() } else { config.faults.paced(pace) };
    let now = clock.now();
    // Journals of several processes are judged together: by UTC, and by names of items that differ.
    let utc_base_ms = now.utc.0 - i64::try_from(now.site.0).unwrap_or(0);
    let world = WorldConfig { tag: format!("{robot_id}-"), auto_stock: true, utc_base_ms, ..WorldConfig::default() };
    let (body, _world) = SimBody::restore(config, site, world, &data, now.site)?;
    software.as_ref().map_or(Ok(()), Behaving::live)?;
    let handle = SimHandle::new(body);
    hand(&handle, &clock);
    let _person =
        args.person.then(|| AbortOnDropHandle::new(tokio::spawn(visit(handle.clone(), args.seed, clock.clone()))));
    let mut pulse = midshift_agent::launcher_heartbeat::for_launcher();
    if let Some(software) = &software {
        pulse = software.pulse(pulse, &clock);
    }
    let (network, stop_network) = (Some(handle.network()), Some(handle.stop_network()));
    Ok(machine.run(Box::new(handle), RunOptions { network, stop_network, pulse }, stop).await?)
}

/// A person who looks after one robot.
async fn visit(robot: SimHandle, seed: u64, clock: Arc<dyn Clock>) {
    let mut person = Person::new(seed);
    loop {
        tokio::time::sleep(VISIT).await;
        for deed in person.round(clock.now().site, std::slice::from_ref(&robot), &|_| false) {
            tracing::info!(?deed, "a simulated person helped");
        }
    }
}

/// The ways of whoever is signed in: to where machines are enrolled, and to the server that robots dial.
pub type SignedIn = [Endpoint; 2];

/// Runs a swarm until `stop`; enrolled by whoever is signed in, or in plain text.
pub fn swarm(args: SimRun, signed_in: Option<SignedIn>, stop: CancellationToken) -> Boxed<'static, anyhow::Result<()>> {
    Box::pin(swarming(args, signed_in, stop))
}

async fn swarming(args: SimRun, signed_in: Option<SignedIn>, stop: CancellationToken) -> anyhow::Result<()> {
    let site = site_file::load(args.site.as_deref(), None, None)?.site;
    let clock: Arc<dyn Clock> = clock::clock(1000);
    let mut config = FleetConfig::new(site, args.robots, args.seed);
    config.only = args.only.map(|(from, to)| from..to);
    config.prefix.clone_from(&args.prefix);
    config.crowded = args.crowded;
    if args.no_faults {
        config.faults = FaultRates::none();
    }
    if let Some(dir) = &args.data {
        config.persistence = Persistence::Dir(dir.clone());
    }
    let trust = args.trust.as_deref().map(|file| software::trust_of(file, &config.site)).transpose()?;
    let hall = Arc::new(Fleet::open(&config, &clock.now())?);
    let (machines, scheme) = match &signed_in {
        None => (None, "http"),
        Some([identities, robots]) => {
            let ids: Vec<RobotId> = hall.robots().iter().map(|robot| robot.robot_id().clone()).collect();
            let (address, data) = (args.identity.address(&args.server), args.data.as_deref());
            let replace = if args.replace { Replace::Any } else { Replace::Simulated };
            let replaced = Replaced::find((identities, robots), &ids, data, replace).await?;
            (Some(Machines::enrol(identities, address, ids, data, &replaced).await?), "https")
        }
    };
    let tls = machines.as_ref().map(Machines::tls).unwrap_or_default();
    let mut swarm =
        SwarmConfig::over(hall.clone(), clock.clone(), &with_scheme(scheme, &args.server), Arc::new(tls), args.seed);
    if let Some(address) = args.stop.address(&args.server, machines.is_some()) {
        swarm = swarm.with_stop(&with_scheme(scheme, &address));
    }
    let _renewing = machines
        .map(|machines| machines.renew_certificates(args.identity.address(&args.server), &clock))
        .transpose()?;
    swarm.software = trust;
    swarm.persistence = config.persistence.clone();
    let swarm = Swarm::new(swarm);
    let face = SimFace::new(hall, clock, swarm.crash());
    let robots = swarm.run(stop.clone());
    match args.listen {
        None => drop(robots.await?),
        Some(address) => {
            let listener = TcpListener::bind(address).await.with_context(|| format!("listening on {address}"))?;
            let routes = face.add_to(Routes::default());
            let served = door::serve(door::alone("sim"), None, routes, listener, stop);
            let (robots, served) = tokio::join!(robots, served);
            robots?;
            served?;
        }
    }
    Ok(())
}
