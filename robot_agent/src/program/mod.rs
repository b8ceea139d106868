//! Runs the program of one robot around its body: enrolment, ledger, session, stop line, updates, and the end that its
//! launcher reads.
//!
//! [`run`] is the door for makers. A program that has something to do between the two halves takes them one by one:
//! [`Machine::open`], then [`Machine::run`]. A simulated robot does: its body behaves as its software says, and its
//! network can be cut. Swarms have thousands of robots in one process, in memory and without launchers, and use
//! [`session::run`] alone. Invariant: a body is driven only by a machine that has the lock of its folder.

pub mod environment;
pub mod launcher_heartbeat;

use crate::body::Body;
use crate::bugs::Bugs;
use crate::core::ExitReason;
use crate::launcher::{self, ENVIRONMENT, SWITCHED};
use crate::session::{self, AgentConfig, Lines, Updates};
use crate::sets::disk::DiskSets;
use crate::sets::{self, Holdings, Sets};
use crate::stop::line::StopLine;
use crate::stop::storage::{FileStops, STOP_FILE};
use crate::storage::sqlite::SqliteStore;
use crate::storage::{Store, store};
use crate::transport::bulk::Bulk;
use crate::transport::dial::{self, TcpDial, with_scheme};
use crate::transport::enrolment::{self, Enrolled, Identity, Invitation};
use crate::update::UpdateConfig;
use crate::update::io::UpdateWorker;
use crate::update::remote::GrpcRemote;
use crate::update::trust_anchors::{self, TrustAnchors};
use midshift_core::ids::{self, RobotId};
use midshift_core::stop::PORT;
use midshift_core::time::Clock;
use midshift_os::clock;
use midshift_os::told_to_end;
use std::future::Future;
use std::io;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::ExitCode;
use std::sync::Arc;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::transport::Uri;

/// Name of an agent's ledger and ring in its folder.
pub const AGENT_FILE: &str = "agent.db";
/// Variable with the secret that enrols a robot.
pub const ENROLL: &str = "MIDSHIFT_ENROLL";

/// Called once a second while the agent lives.
pub type Pulse = Box<dyn FnMut() + Send>;

/// The stop service on the host of a server: host:port. None: `server` names no host.
pub fn stop_service_beside(server: &str, port: u16) -> Option<String> {
    let uri: Uri = with_scheme("http", server).parse().ok()?;
    Some(format!("{}:{port}", uri.host()?))
}

/// The way to the stop service.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct StopFlags {
    /// The stop service, host:port. Without it that on port 7421 of the server, if the robots are enrolled; where there
    /// is no login there is no line then. With a line a robot stands until it was told what is stopped, and slows down
    /// and stands when nobody answers.
    #[arg(long, env = "MIDSHIFT_STOP_SERVER", value_name = "ADDR")]
    pub stop_server: Option<String>,
    /// No line to a stop service, also if one is named: fleet stop reaches these robots only by the work that fleet
    /// gives them, and they do not slow down or stand when nobody is heard.
    #[arg(long)]
    pub no_stop: bool,
}

impl StopFlags {
    /// Where the stop service is for robots of the server at `server`, over TLS or not; none: there is to be no line,
    /// which is said aloud.
    pub fn address(&self, server: &str, is_secure: bool) -> Option<String> {
        let beside = || is_secure.then(|| stop_service_beside(server, PORT)).flatten();
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

/// The way to whoever says who is who.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct IdentityFlags {
    /// Where certificates are given out and renewed, host:port, if not at --server: of a site in several processes the
    /// address of the one with role identity, or that of the proxy for it.
    #[arg(long, env = "MIDSHIFT_IDENTITY_SERVER", value_name = "ADDR")]
    pub identity_server: Option<String>,
}

impl IdentityFlags {
    /// That address, or `server`.
    pub fn address<'a>(&'a self, server: &'a str) -> &'a str {
        self.identity_server.as_deref().unwrap_or(server)
    }
}

/// What the program of a robot is told at its start, on its command line and in its environment.
#[derive(Clone, Debug, clap::Parser)]
pub struct Config {
    /// The robot that the agent is of.
    #[arg(long)]
    pub robot_id: String,
    /// The server, host:port.
    #[arg(long, env = "MIDSHIFT_SERVER", default_value = "127.0.0.1:7420")]
    pub server: String,
    /// A folder for what outlives the program: its key and certificate, its ledger, the stops that it was told, and
    /// what a simulated body keeps.
    #[arg(long)]
    pub data: PathBuf,
    /// A file of its owner's alone with the secret that `midshift robot enroll` printed: this machine becomes the
    /// robot, once, and keeps its certificate in --data. Without it the secret is taken from the variable
    /// MIDSHIFT_ENROLL, if that is set; never from the command line, which other users of a machine can read.
    #[arg(long, env = "MIDSHIFT_ENROLL_FILE", value_name = "FILE")]
    pub enroll_file: Option<PathBuf>,
    /// Where its sets of software are. With --trust it takes updates; a simulated body behaves as behaviour.toml of the
    /// set that runs says.
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

impl Config {
    /// The robot, if its name is one.
    ///
    /// # Errors
    /// The name is none.
    pub fn robot_id(&self) -> Result<RobotId, Error> {
        Ok(RobotId::parse(&self.robot_id)?)
    }

    /// What this machine was given to enrol with; none: nothing.
    fn invitation(&self) -> Result<Option<Invitation>, enrolment::Error> {
        match (&self.enroll_file, std::env::var(ENROLL)) {
            (Some(file), _) => Invitation::read(file).map(Some),
            (None, Ok(text)) if !text.is_empty() => text.parse().map(Some),
            (None, _) => Ok(None),
        }
    }
}

/// A robot's program that could not begin or go on.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The robot's name.
    #[error(transparent)]
    Name(#[from] ids::Error),
    /// A file or folder of the machine.
    #[error("making {path}: {source}", path = path.display())]
    File {
        /// What was to be made.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// The ledger.
    #[error(transparent)]
    Store(#[from] store::Error),
    /// Who the machine is.
    #[error(transparent)]
    Enrolment(#[from] enrolment::Error),
    /// The address of a server.
    #[error(transparent)]
    Dial(#[from] dial::Error),
    /// The trust file.
    #[error(transparent)]
    Trust(#[from] trust_anchors::Error),
    /// The sets of software.
    #[error(transparent)]
    Sets(#[from] sets::Error),
    /// The set that was started is none of them.
    #[error("set {0} is not there")]
    NoSet(String),
    /// The agent.
    #[error(transparent)]
    Session(#[from] session::Error),
    /// A second machine has this robot's name.
    #[error("fenced twice: another machine runs as this robot. Find it, then start this one again")]
    FencedTwice,
    /// The launcher died before its program ran.
    #[error("the launcher that started this agent is not there: {0}")]
    NoLauncher(#[source] io::Error),
}

/// The software of a robot: its sets, whom it trusts, and which set runs. The launcher names that one, else the switch
/// record does.
pub struct Software {
    trust: TrustAnchors,
    sets: DiskSets,
    holdings: Holdings,
    running: String,
    is_launched: bool,
}

impl Software {
    fn open(folder: &Path, trust: TrustAnchors) -> Result<Self, Error> {
        let mut sets = DiskSets::open(folder)?;
        let told = std::env::var(launcher::SET).ok();
        if let Some(set) = &told {
            sets.started_from(set)?;
        }
        let holdings = sets.holdings()?;
        let is_launched = told.is_some();
        let running = told.unwrap_or_else(|| holdings.switch.running().to_owned());
        if holdings.set(&running).is_none() {
            return Err(Error::NoSet(running));
        }
        Ok(Self { trust, sets, holdings, running, is_launched })
    }

    /// Whose software it takes.
    pub const fn trust(&self) -> &TrustAnchors {
        &self.trust
    }

    /// Name of the set that runs.
    pub fn running(&self) -> &str {
        &self.running
    }

    /// Version of the set that runs, of the bundle taken last; none: what the robot came with.
    pub fn version(&self) -> Option<String> {
        self.holdings.version(&self.running)
    }

    /// Whether the set that runs is not proven yet.
    pub fn is_on_probation(&self) -> bool {
        self.holdings.switch.trial.as_ref().is_some_and(|trial| trial.set == self.running && !trial.is_proven)
    }

    /// The file of a component of kind config in the set that runs; none: it has no such component.
    pub fn settings(&self, component: &str) -> Option<PathBuf> {
        self.holdings.settings(&self.running, component).map(|_| self.sets.component(&self.running, component))
    }

    fn updates(self, bulk: Bulk, clock_synced: bool) -> Updates {
        let config = UpdateConfig { is_launched: self.is_launched, clock_synced, ..self.trust.config() };
        Updates { config, worker: Box::new(UpdateWorker::new(Box::new(self.sets), Arc::new(GrpcRemote::new(bulk)))) }
    }
}

/// What one run of a machine has of its own: a simulated robot's network, which can be cut, and the pulse.
#[derive(Default)]
pub struct RunOptions {
    /// While it says false nothing passes to the server; none: nobody cuts it.
    pub network: Option<watch::Receiver<bool>>,
    /// The same to the stop service.
    pub stop_network: Option<watch::Receiver<bool>>,
    /// Tells the launcher that the agent lives; none: nobody listens.
    pub pulse: Option<Pulse>,
}

/// A machine that is a robot of a site, before its body is driven.
pub struct Machine {
    config: Config,
    robot_id: RobotId,
    clock: Arc<dyn Clock>,
    store: Box<dyn Store>,
    new_ring_id: String,
    identity: Option<Identity>,
    software: Option<Software>,
}

impl Machine {
    /// Opens its folder, enrols it if it was given something to enrol with, and looks which software runs.
    ///
    /// # Errors
    /// Another program has its folder; the site does not take it; its files cannot be used.
    pub async fn open(config: Config, clock: Arc<dyn Clock>) -> Result<Self, Error> {
        let (robot_id, data) = (config.robot_id()?, &config.data);
        midshift_durable::make_folder(data).map_err(|source| Error::File { path: data.clone(), source })?;
        let mut store: Box<dyn Store> = Box::new(SqliteStore::open(&data.join(AGENT_FILE)).await?);
        let new_ring_id = format!("{:032x}", rand::random::<u128>());
        let identity = match config.invitation()? {
            None if Enrolled::read(data)?.is_none() => {
                let server = &config.server;
                tracing::warn!(server, "not enrolled: the session is plain text, and the server must let everybody in");
                None
            }
            invitation => {
                let key = store::device_key(&mut *store, &new_ring_id).await?;
                let address = config.identity.address(&config.server);
                Some(Identity::open(data, &robot_id, key, address, invitation.as_ref()).await?)
            }
        };
        let trust = config.trust.clone().or(trust_of_site(data, identity.as_ref())?);
        let software = config.sets.as_deref().zip(trust.as_deref());
        let software = software.map(|(sets, trust)| Software::open(sets, TrustAnchors::read(trust)?)).transpose()?;
        Ok(Self { config, robot_id, clock, store, new_ring_id, identity, software })
    }

    /// Its software; none: it is not changed from here.
    pub const fn software(&self) -> Option<&Software> {
        self.software.as_ref()
    }

    /// Drives `body` until `shutdown`, or until another set of software is to be started.
    ///
    /// # Errors
    /// An address that is none; a ledger that cannot be kept; another machine with this robot's name.
    pub async fn run(
        self,
        body: Box<dyn Body>,
        options: RunOptions,
        shutdown: CancellationToken,
    ) -> Result<ExitReason, Error> {
        let Self { config, robot_id, clock, store, new_ring_id, identity, software } = self;
        let RunOptions { network, stop_network, pulse } = options;
        let tls = identity.as_ref().map(Identity::tls);
        let scheme = if tls.is_some() { "https" } else { "http" };
        let dial = |address: &str, network: Option<watch::Receiver<bool>>| -> Result<TcpDial, dial::Error> {
            Ok(TcpDial::new(&with_scheme(scheme, address), network)?.with_tls(tls.clone()))
        };
        let link = Arc::new(dial(&config.server, network.clone())?);
        let bulk = TcpDial::bulk(&with_scheme(scheme, &config.server), network.clone())?.with_tls(tls.clone());
        let bulk = Bulk::new(Arc::new(bulk));
        let renewal = Arc::new(dial(config.identity.address(&config.server), network)?);
        let _renewing = identity
            .map(|identity| AbortOnDropHandle::new(tokio::spawn(identity.renew_when_due(renewal, clock.clone()))));
        let stop = match config.stop.address(&config.server, tls.is_some()) {
            Some(address) => Some(StopLine {
                dial: Arc::new(dial(&address, stop_network)?),
                storage: Box::new(FileStops::new(&config.data.join(STOP_FILE))),
            }),
            None => None,
        };
        let agent = AgentConfig {
            stop,
            update: software.map(|software| software.updates(bulk.clone(), !config.clock_unsynced)),
            robot_id,
            boot_id: format!("{:032x}", rand::random::<u128>()),
            new_ring_id,
            seed: rand::random(),
            bugs: Bugs::default(),
            pulse,
        };
        match session::run(agent, body, store, clock, Lines { link, bulk }, shutdown).await? {
            reason @ (ExitReason::Shutdown | ExitReason::Switched) => Ok(reason),
            ExitReason::FencedTwice => Err(Error::FencedTwice),
        }
    }
}

/// The trust file that came with the enrolment, if one did.
fn trust_of_site(data: &Path, identity: Option<&Identity>) -> Result<Option<PathBuf>, Error> {
    let Some(text) = identity.map(|identity| &identity.enrolled().trust_json).filter(|text| !text.is_empty()) else {
        return Ok(None);
    };
    let path = data.join("trust.json");
    match midshift_durable::replace(&path, text.as_bytes()) {
        Ok(()) => Ok(Some(path)),
        Err(source) => Err(Error::File { path, source }),
    }
}

/// Runs the program of a robot with this body: what `main` of a maker's program calls, and whose answer it returns. To
/// be called by the first thread.
///
/// It ends at Ctrl-C, SIGTERM, or when its launcher is to start another set of software. Why it ends otherwise is
/// logged.
pub fn run(config: Config, body: Box<dyn Body>) -> Pin<Box<dyn Future<Output = ExitCode> + Send>> {
    // Before anything else: a launcher that dies now takes its program along.
    let followed = launcher_heartbeat::follow_launcher().map_err(Error::NoLauncher);
    Box::pin(async move {
        let ended = match followed {
            Ok(()) => until_told(config, body).await,
            Err(error) => Err(error),
        };
        match ended {
            Ok(ExitReason::Switched) => ExitCode::from(SWITCHED),
            Ok(ExitReason::Shutdown | ExitReason::FencedTwice) => ExitCode::SUCCESS,
            Err(error) => {
                tracing::error!(%error, "the robot's program ends");
                let is_environment = matches!(error, Error::NoLauncher(_)) || environment::is_to_blame(&error);
                if is_environment { ExitCode::from(ENVIRONMENT) } else { ExitCode::FAILURE }
            }
        }
    })
}

async fn until_told(config: Config, body: Box<dyn Body>) -> Result<ExitReason, Error> {
    let machine = Machine::open(config, clock::real(|_| ())).await?;
    let (shutdown, ways) =
        (CancellationToken::new(), RunOptions { pulse: launcher_heartbeat::for_launcher(), ..RunOptions::default() });
    let mut driven = Box::pin(machine.run(body, ways, shutdown.clone()));
    tokio::select! {
        ended = &mut driven => return ended,
        () = told_to_end() => shutdown.cancel(),
    }
    driven.await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flags_of_a_robot_hang_together() {
        <Config as clap::CommandFactory>::command().debug_assert();
    }

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
