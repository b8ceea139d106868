//! Robots in processes of their own: one agent with a simulated body that survives its process, or a swarm against a server elsewhere.

use crate::door;
use crate::machines::Machines;
use crate::software::{self, Software};
use crate::way::{Way, with_scheme};
use crate::{clock, site_file, stop};
use anyhow::{Context, bail};
use midshift_agent::bulk::Bulk;
use midshift_agent::core::ExitReason;
use midshift_agent::device;
use midshift_agent::dial::TcpDial;
use midshift_agent::enrolment::{self, Enrolled, Identity, Invitation};
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::stop::keep::{FileStops, STOP_FILE};
use midshift_agent::stop::line::StopLine;
use midshift_agent::store::Store;
use midshift_core::Boxed;
use midshift_core::ids::{RobotId, WaypointId};
use midshift_core::time::Clock;
use midshift_sim::body::{BodyConfig, SimBody};
use midshift_sim::faults::FaultRates;
use midshift_sim::hall::{Hall, HallConfig, Persistence};
use midshift_sim::handle::SimHandle;
use midshift_sim::person::Person;
use midshift_sim::service::SimFace;
use midshift_sim::swarm::{AGENT_FILE, Swarm, SwarmConfig};
use midshift_sim::world::WorldConfig;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::service::Routes;

/// How often a person looks, real time.
const VISIT: Duration = Duration::from_secs(5);

/// The way to the stop service.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct StopFlags {
    /// The stop service, host:port. Without it that on port 7421 of the server, if the robots are enrolled; where there is no login there is no line then. With a line
    /// a robot stands until it was told what is stopped, and slows down and stands when nobody answers.
    #[arg(long, env = "MIDSHIFT_STOP_SERVER", value_name = "ADDR")]
    pub stop_server: Option<String>,
    /// No line to a stop service, also if one is named: fleet stop reaches these robots only by the work that fleet gives them, and they do not slow down or stand when nobody is heard.
    #[arg(long)]
    pub no_stop: bool,
}

/// The way to whoever says who is who.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct IdentityFlags {
    /// Where certificates are given out and renewed, host:port, if not at --server: of a site in several processes the address of the one with role identity, or that
    /// of the proxy for it.
    #[arg(long, env = "MIDSHIFT_IDENTITY_SERVER", value_name = "ADDR")]
    pub identity_server: Option<String>,
}

impl IdentityFlags {
    /// That address, or `server`.
    pub fn address<'a>(&'a self, server: &'a str) -> &'a str {
        self.identity_server.as_deref().unwrap_or(server)
    }
}

impl StopFlags {
    /// Where the stop service is for robots of the server at `server`, over TLS or not; none: there is to be no line, which is said aloud.
    fn address(&self, server: &str, is_secure: bool) -> Option<String> {
        let beside = || is_secure.then(|| stop::beside(server)).flatten();
        let address = if self.no_stop { None } else { self.stop_server.clone().or_else(beside) };
        match &address {
            Some(address) => {
                tracing::info!(address, "these robots stand until the stop service has told them what is stopped")
            }
            None => tracing::warn!("no stop line: fleet stop does not reach these robots by a way of its own"),
        }
        address
    }
}

/// One agent with a simulated body.
#[derive(Clone, Debug, clap::Args)]
pub struct AgentRun {
    /// The robot that the agent is of.
    #[arg(long)]
    pub robot_id: String,
    /// The server, host:port.
    #[arg(long, env = "MIDSHIFT_SERVER", default_value = "127.0.0.1:7420")]
    pub server: String,
    /// Where the ledger, the body and its journal are kept: a killed agent does not teleport its body or lose its load.
    #[arg(long)]
    pub data: PathBuf,
    /// A file of its owner's alone with the secret that `midshift robot enroll` printed: this machine becomes the robot, once, and keeps its
    /// certificate in --data. Without it the secret is taken from the variable MIDSHIFT_ENROLL, if that is set; never from the command line,
    /// which other users of a machine can read.
    #[arg(long, env = "MIDSHIFT_ENROLL_FILE", value_name = "FILE")]
    pub enroll_file: Option<PathBuf>,
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
    /// Where its sets of software are. With --trust it takes updates, and behaves as behaviour.toml of the set that runs says.
    #[arg(long, requires = "trust")]
    pub sets: Option<PathBuf>,
    /// Its trust file: whose software it takes.
    #[arg(long, requires = "sets")]
    pub trust: Option<PathBuf>,
    /// The machine's clock is not set from the network: the end of a signature is not judged by it.
    #[arg(long, requires = "sets")]
    pub clock_unsynced: bool,
    /// The way to whoever says who is who.
    #[command(flatten)]
    pub identity: IdentityFlags,
    /// The way to the stop service.
    #[command(flatten)]
    pub stop: StopFlags,
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

/// Variable with the secret that enrols a robot.
pub const ENROLL: &str = "MIDSHIFT_ENROLL";

/// What this machine was given to enrol with; none: nothing.
fn invitation(file: Option<&Path>) -> Result<Option<Invitation>, enrolment::Error> {
    match (file, std::env::var(ENROLL)) {
        (Some(file), _) => Invitation::read(file).map(Some),
        (None, Ok(text)) if !text.is_empty() => text.parse().map(Some),
        (None, _) => Ok(None),
    }
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
    let robot_id = RobotId::parse(&args.robot_id)?;
    let site = site_file::load(args.site.as_deref(), None, None)?.site;
    midshift_durable::make_folder(&args.data).with_context(|| format!("making {}", args.data.display()))?;
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
    let mut store: Box<dyn Store> = Box::new(SqliteStore::open(&args.data.join(AGENT_FILE)).await?);
    let new_ring_id = format!("{:032x}", rand::random::<u128>());
    let identity = match invitation(args.enroll_file.as_deref())? {
        None if Enrolled::read(&args.data)?.is_none() => {
            tracing::warn!(
                server = args.server,
                "not enrolled: the session is plain text, and the server must let everybody in"
            );
            None
        }
        invitation => {
            let key = device::key_of(&mut *store, &new_ring_id).await?;
            let address = args.identity.address(&args.server);
            Some(Identity::open(&args.data, &robot_id, key, address, invitation.as_ref()).await?)
        }
    };
    let tls = identity.as_ref().map(Identity::tls);
    let trust = args.trust.clone().or(trust_of_site(&args.data, identity.as_ref())?);
    let software = args.sets.as_deref().zip(trust.as_deref());
    let software = software.map(|(sets, trust)| Software::open(sets, software::trust_of(trust, &site)?)).transpose()?;
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
    let (body, _world) = SimBody::restore(config, site, world, &args.data, now.site)?;
    software.as_ref().map_or(Ok(()), Software::live)?;
    let handle = SimHandle::new(body);
    hand(&handle, &clock);
    let _person =
        args.person.then(|| AbortOnDropHandle::new(tokio::spawn(visit(handle.clone(), args.seed, clock.clone()))));
    let (network, stop_network) = (handle.network(), handle.stop_network());
    let scheme = if tls.is_some() { "https" } else { "http" };
    let uri = with_scheme(scheme, &args.server);
    let link = Arc::new(TcpDial::new(&uri, Some(network.clone()))?.with_tls(tls.clone()));
    let bulk = Bulk::new(Arc::new(TcpDial::bulk(&uri, Some(network))?.with_tls(tls.clone())));
    let renewal = with_scheme(scheme, args.identity.address(&args.server));
    let renewal = Arc::new(TcpDial::new(&renewal, Some(handle.network()))?.with_tls(tls.clone()));
    let _renewing =
        identity.map(|identity| AbortOnDropHandle::new(tokio::spawn(identity.keep(renewal, clock.clone()))));
    let mut pulse = midshift_agent::pulse::for_launcher();
    if let Some(software) = &software {
        pulse = software.pulse(pulse, &clock);
    }
    let mut update = software.map(|software| software.updates(bulk.clone()));
    if let Some(update) = &mut update {
        update.config.clock_synced = !args.clock_unsynced;
    }
    let stop_line = match args.stop.address(&args.server, tls.is_some()) {
        Some(address) => Some(StopLine {
            dial: Arc::new(TcpDial::new(&with_scheme(scheme, &address), Some(stop_network))?.with_tls(tls.clone())),
            keep: Box::new(FileStops::new(&args.data.join(STOP_FILE))),
        }),
        None => None,
    };
    let agent = midshift_agent::session::AgentConfig {
        stop: stop_line,
        update,
        robot_id,
        boot_id: format!("{:032x}", rand::random::<u128>()),
        new_ring_id,
        seed: rand::random(),
        bugs: midshift_agent::bugs::Bugs::default(),
        pulse,
    };
    let lines = midshift_agent::session::Lines { link, bulk };
    match midshift_agent::session::run(agent, Box::new(handle), store, clock, lines, stop).await? {
        reason @ (ExitReason::Shutdown | ExitReason::Switched) => Ok(reason),
        ExitReason::FencedTwice => {
            bail!("fenced twice: another machine runs as this robot. Find it, then start this one again")
        }
    }
}

/// The trust file that came with the enrolment, if one did.
fn trust_of_site(data: &Path, identity: Option<&Identity>) -> anyhow::Result<Option<PathBuf>> {
    let Some(text) = identity.map(|identity| &identity.enrolled().trust_json).filter(|text| !text.is_empty()) else {
        return Ok(None);
    };
    let path = data.join("trust.json");
    midshift_durable::replace(&path, text.as_bytes()).with_context(|| format!("writing {}", path.display()))?;
    Ok(Some(path))
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

/// Runs a swarm until `stop`; enrolled by whoever is signed in, or in plain text.
pub fn swarm(args: SimRun, signed_in: Option<Way>, stop: CancellationToken) -> Boxed<'static, anyhow::Result<()>> {
    Box::pin(swarming(args, signed_in, stop))
}

async fn swarming(args: SimRun, signed_in: Option<Way>, stop: CancellationToken) -> anyhow::Result<()> {
    let site = site_file::load(args.site.as_deref(), None, None)?.site;
    let clock: Arc<dyn Clock> = clock::clock(1000);
    let mut config = HallConfig::new(site, args.robots, args.seed);
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
    let hall = Arc::new(Hall::open(&config, &clock.now())?);
    let (machines, scheme) = match &signed_in {
        None => (None, "http"),
        Some(way) => {
            let ids = hall.robots().iter().map(|robot| robot.robot_id().clone()).collect();
            let address = args.identity.address(&args.server);
            (Some(Machines::enrol(way, address, ids, args.data.as_deref()).await?), "https")
        }
    };
    let tls = machines.as_ref().map(Machines::tls).unwrap_or_default();
    let mut swarm =
        SwarmConfig::over(hall.clone(), clock.clone(), &with_scheme(scheme, &args.server), Arc::new(tls), args.seed);
    if let Some(address) = args.stop.address(&args.server, machines.is_some()) {
        swarm = swarm.with_stop(&with_scheme(scheme, &address));
    }
    let _renewing = machines.map(|machines| machines.keep(args.identity.address(&args.server), &clock)).transpose()?;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enrolled_robots_have_a_stop_line_to_the_host_of_their_server_unless_they_are_told_otherwise() {
        let flags = |named: Option<&str>, no_stop| StopFlags { stop_server: named.map(str::to_owned), no_stop };
        let default = flags(None, false);
        assert_eq!(default.address("fleet.local:7420", true).as_deref(), Some("fleet.local:7421"));
        assert_eq!(default.address("https://[::1]:9000", true).as_deref(), Some("[::1]:7421"));
        assert_eq!(default.address("fleet.local:7420", false), None, "where there is no login");
        assert_eq!(flags(None, true).address("fleet.local:7420", true), None);
        for is_secure in [false, true] {
            let named = flags(Some("stops:1"), false).address("fleet.local:7420", is_secure);
            assert_eq!(named.as_deref(), Some("stops:1"));
        }
    }
}
