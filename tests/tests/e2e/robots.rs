//! Robots as programs of their own.

use crate::harness::{Running, channel, has_login, midshift, sign_in, until, way};
use crate::secrets::{keep_key, keep_secret, secret_part};
use crate::stack::{machines_of, tell_identity};
use anyhow::Context;
use midshift::enrol_simulated::{Machines, Replaced};
use midshift_agent::device::DeviceKey;
use midshift_agent::enrolment::enrol;
use midshift_agent::ledger::Ledger;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::Store;
use midshift_agent::tls::Tls;
use midshift_core::ids::RobotId;
use midshift_core::site::{Site, text};
use midshift_proto::fleet::v1::ListPlacesRequest;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::identity::v1::CreateEnrolmentRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_sim::swarm::AGENT_FILE;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

/// How many times as fast as real the bodies work; clocks are not touched.
pub const BODY_SPEED: &str = "10";

/// Agents in processes of their own, each with its folder, which can be killed and started again; or many in few processes.
pub struct Robots {
    dir: PathBuf,
    server: String,
    /// The stop service that agents of their own dial.
    stops: Option<String>,
    starts: Vec<String>,
    running: BTreeMap<String, Running>,
    /// Processes that have many of them each.
    crowds: Vec<Running>,
    ids: Vec<String>,
}

impl Robots {
    /// Starts those that the site names, and waits until the server at `public` knows where each stands.
    pub async fn start(dir: &Path, server: SocketAddr, public: SocketAddr, site: &Site) -> anyhow::Result<Self> {
        Self::start_beside(dir, server, public, None, site).await
    }
    /// As [`Robots::start`], with lines to the stop service at `stops`.
    pub async fn start_beside(
        dir: &Path,
        server: SocketAddr,
        public: SocketAddr,
        stops: Option<SocketAddr>,
        site: &Site,
    ) -> anyhow::Result<Self> {
        let starts: Vec<String> = site.starts().values().map(|at| site.name_of(*at).to_string()).collect();
        anyhow::ensure!(!starts.is_empty(), "the site names no robots: `with_robots` gives it some");
        Self::start_at(dir, server, public, stops, &starts).await
    }
    /// As [`Robots::start_beside`], one at each of these waypoints.
    pub async fn start_at(
        dir: &Path,
        server: SocketAddr,
        public: SocketAddr,
        stops: Option<SocketAddr>,
        starts: &[String],
    ) -> anyhow::Result<Self> {
        let count = starts.len();
        let mut robots = Self::none(dir, server);
        (robots.starts, robots.stops) = (starts.to_vec(), stops.map(|address| address.to_string()));
        // First all of them are enrolled: one that works before another is heard may be sent to where that one stands.
        let ids = (0..count).map(|number| RobotId::parse(&robot_id(number))).collect::<Result<Vec<_>, _>>()?;
        if has_login(public) {
            Machines::enrol(&way(public)?, &machines_of(server).to_string(), ids, Some(dir), &Replaced::default())
                .await?;
        }
        for number in 0..count {
            robots.start_one(number, None)?;
        }
        robots.ids = robots.running.keys().cloned().collect();
        let all: BTreeSet<&String> = robots.ids.iter().collect();
        until("every robot in its place", Duration::from_secs(60), || async {
            let request = ListPlacesRequest { in_use: true, page_size: 1_000, ..ListPlacesRequest::default() };
            let page = FleetServiceClient::new(channel(public)?).list_places(request).await;
            let places = page.map_or_else(|_| Vec::new(), |page| page.into_inner().places);
            let stand: BTreeSet<&String> = places.iter().flat_map(|p| &p.holders).map(|h| &h.robot_id).collect();
            Ok((stand == all).then_some(()))
        })
        .await?;
        for id in &robots.ids {
            keep_secrets(&dir.join(id)).await?;
        }
        Ok(robots)
    }
    /// `count` of them on the site of a file, shared out among `processes`, with bodies no faster than real ones; they take software as `trust` says.
    pub fn crowd(
        dir: &Path,
        server: SocketAddr,
        site: &Path,
        trust: &Path,
        count: usize,
        processes: usize,
    ) -> anyhow::Result<Self> {
        let mut robots = Self::none(dir, server);
        let digits = count.to_string().len();
        robots.ids = (1..=count).map(|number| format!("rbt-{number:0digits$}")).collect();
        for nth in 0..processes {
            let [from, to] = [nth, nth + 1].map(|n| 1 + count * n / processes);
            let mut command = Command::new(midshift()?);
            command.args(["sim", "run", "--server", &robots.server, "--robots", &count.to_string(), "--no-faults"]);
            command.args(["--no-stop", "--only", &format!("{from}..{to}"), "--seed", "1"]).arg("--data").arg(dir);
            command.arg("--site").arg(site).arg("--trust").arg(trust);
            sign_in(&mut command, server);
            tell_identity(&mut command, &robots.server);
            robots.crowds.push(Running::start(&mut command, &dir.join(format!("crowd-{nth}.log")))?);
        }
        Ok(robots)
    }
    fn none(dir: &Path, server: SocketAddr) -> Self {
        let (starts, running, stops) = (Vec::new(), BTreeMap::new(), None);
        let (crowds, ids) = (Vec::new(), Vec::new());
        Self { dir: dir.to_owned(), server: server.to_string(), stops, starts, running, crowds, ids }
    }
    /// Names of all.
    pub fn ids(&self) -> Vec<String> {
        self.ids.clone()
    }
    /// SIGKILL to all of them.
    pub fn kill_all(&mut self) -> anyhow::Result<()> {
        self.running.values_mut().chain(&mut self.crowds).try_for_each(Running::kill)
    }
    fn start_one(&mut self, number: usize, enrolment: Option<&str>) -> anyhow::Result<()> {
        let id = robot_id(number);
        let running = self.run(number, &self.dir.join(&id), enrolment)?;
        self.running.insert(id, running);
        Ok(())
    }
    /// A copy of all that the machine of a robot keeps, taken in a moment in which it does nothing, and a second agent of it.
    pub fn copy(&self, id: &str, to: &Path) -> anyhow::Result<Running> {
        let robot = self.running.get(id).context("a robot that runs")?;
        robot.signal("STOP")?;
        std::fs::create_dir_all(to)?;
        for file in std::fs::read_dir(self.dir.join(id))? {
            let file = file?;
            if file.file_type()?.is_file() {
                std::fs::copy(file.path(), to.join(file.file_name()))?;
            }
        }
        robot.signal("CONT")?;
        self.run(id.trim_start_matches("rbt-").parse::<usize>()? - 1, to, None)
    }
    /// Starts one with what lies in `dir`.
    pub fn run(&self, number: usize, dir: &Path, enrolment: Option<&str>) -> anyhow::Result<Running> {
        let id = robot_id(number);
        std::fs::create_dir_all(dir)?;
        let mut command = Command::new(midshift()?);
        command.args([
            "agent",
            "run",
            "--robot-id",
            &id,
            "--server",
            &self.server,
            "--body-speed",
            BODY_SPEED,
            "--no-faults",
        ]);
        command.args(["--start", &self.starts[number], "--seed", &number.to_string()]).arg("--data").arg(dir);
        match &self.stops {
            Some(stops) => command.args(["--stop-server", stops]),
            None => command.arg("--no-stop"),
        };
        if let Some(secret) = enrolment {
            command.env("MIDSHIFT_ENROLL", secret);
        }
        tell_identity(&mut command, &self.server);
        Running::start(&mut command, &dir.join("agent.log"))
    }
    /// Ends it by SIGKILL.
    pub fn kill(&mut self, id: &str) -> anyhow::Result<()> {
        self.running.get_mut(id).map_or(Ok(()), Running::kill)
    }
    /// Starts one again that was killed.
    pub fn restart(&mut self, id: &str) -> anyhow::Result<()> {
        let number: usize = id.trim_start_matches("rbt-").parse()?;
        self.start_one(number - 1, None)
    }
    /// None yet, on starting places of the site.
    pub fn waiting(dir: &Path, server: SocketAddr, site: &Site, count: usize) -> Self {
        let starts = site.starting_places(count).into_iter().map(|at| site.name_of(at).to_string()).collect();
        Self { starts, ..Self::none(dir, server) }
    }
    /// The key of the machine in this folder, whether or not its agent runs.
    pub async fn device(folder: &Path) -> anyhow::Result<DeviceKey> {
        remembered(folder).await?.device.context("a key")
    }
    /// What a robot remembers; its agent must not run.
    pub async fn ledger(&self, id: &str) -> anyhow::Result<Ledger> {
        Ok(SqliteStore::open(&self.dir.join(id).join(AGENT_FILE)).await?.load("").await?.ledger)
    }
    /// Journals of all bodies.
    pub fn journals(&self) -> Vec<PathBuf> {
        self.ids.iter().map(|id| self.dir.join(id).join("journal.jsonl")).collect()
    }
}

/// What the machine in this folder remembers, whether or not its agent runs.
pub async fn remembered(folder: &Path) -> anyhow::Result<Ledger> {
    let copy = tempfile::tempdir()?;
    for name in [AGENT_FILE.to_owned(), format!("{AGENT_FILE}-wal")] {
        let _ = std::fs::copy(folder.join(&name), copy.path().join(&name));
    }
    Ok(SqliteStore::open(&copy.path().join(AGENT_FILE)).await?.load("").await?.ledger)
}

/// Nobody may be told the key of the machine in this folder, nor what proves its session.
pub async fn keep_secrets(folder: &Path) -> anyhow::Result<()> {
    // A copy that is made while the machine writes may be of no use.
    let known =
        || async { Ok(remembered(folder).await.ok().filter(|known| !known.session.secret.reveal().is_empty())) };
    let known = until("what a machine remembers", Duration::from_secs(30), known).await?;
    keep_secret("a session's secret", known.session.secret.reveal());
    let key = serde_json::to_value(known.device.context("a key")?)?;
    keep_key("a machine's key", key.as_str().context("a key in PEM")?)
}

/// A site in which `count` robots start: nobody is sent to where one of them stands before it has been heard.
pub fn with_robots(text: &str, count: usize) -> anyhow::Result<Site> {
    let site = text::parse(text)?;
    let seats = site.starting_places(count).into_iter().enumerate();
    let starts = seats.map(|(nth, at)| Ok((RobotId::parse(&robot_id(nth))?, site.name_of(at).clone())));
    let starts = starts.collect::<anyhow::Result<Vec<_>>>()?;
    Ok(site.with_starts(&starts)?)
}

fn robot_id(number: usize) -> String {
    format!("rbt-{:02}", number + 1)
}

/// How a robot in this process speaks to the site of the server at `address`: enrolled there; none: the site has no login.
pub async fn enrolled(address: SocketAddr, robot_id: &RobotId) -> anyhow::Result<Option<Tls>> {
    let Some(secret) = enrolment(address, robot_id.as_str()).await? else { return Ok(None) };
    let key = DeviceKey::draw();
    let enrolled = enrol(&address.to_string(), robot_id, &secret.parse()?, &key).await?;
    Ok(Some(Tls::fixed(enrolled.config(&key)?)))
}

/// A secret that enrols one machine as this robot; none: the site has no login.
pub async fn enrolment(public: SocketAddr, robot_id: &str) -> anyhow::Result<Option<String>> {
    if !has_login(public) {
        return Ok(None);
    }
    let request = CreateEnrolmentRequest { robot_id: robot_id.to_owned(), replace: false };
    let offered = IdentityServiceClient::new(channel(public)?).create_enrolment(request).await?.into_inner();
    keep_secret("an enrolment", secret_part(&offered.secret)?);
    Ok(Some(offered.secret))
}
