//! A server with signed releases and its robots, ready for a roll-out; and what its database says when it has ended.

use super::rollouts::Rollouts;
use crate::child::{Child, SESSIONS};
use crate::fsync::place;
use crate::ota::release::People;
use anyhow::{Context, ensure};
use midshift_bundle::bugs::Bugs;
use midshift_bundle::directive::{Directive, Expected};
use midshift_core::ids::SiteId;
use midshift_core::rollout::rows::{RolloutRobot, Step};
use midshift_core::rows::{Revision, Table};
use midshift_core::site::{Site, WaypointIx};
use midshift_core::update::DesiredUpdate;
use midshift_store::{SqliteStore, Store};
use std::collections::BTreeSet;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tempfile::TempDir;
use tokio::time::{Instant, sleep};

/// All robots are attached and known by then.
const ATTACH_WITHIN: Duration = Duration::from_secs(300);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(500);
/// Group commits so far, of all databases of a server.
pub const GROUPS: &str = "midshift_store_groups_total";

/// A floor, release people, and where the server will be.
pub struct Floor {
    dir: TempDir,
    map: PathBuf,
    /// The site.
    pub site: Arc<Site>,
    /// Who signed.
    pub people: People,
    address: SocketAddr,
}

impl Floor {
    /// For so many robots, below `dir` or the temporary directory.
    pub fn make(dir: Option<&PathBuf>, robots: usize) -> anyhow::Result<Self> {
        let dir = place(dir)?;
        let map = crate::grid_map::write(dir.path(), (robots as f64).sqrt() as usize + 2)?;
        let site = midshift_cli::site_file::load(Some(&map), None, None)?.site;
        let people = People::make(dir.path())?;
        // A server that is started again listens where its robots look for it.
        let address = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
        Ok(Self { dir, map, site, people, address })
    }
    /// A path below it, as text.
    fn path(&self, name: &str) -> anyhow::Result<String> {
        Ok(self.dir.path().join(name).to_str().context("a path that is no text")?.to_owned())
    }
    /// The directory of the server.
    pub fn data(&self) -> PathBuf {
        self.dir.path().join("data")
    }
    /// Starts the server on the first core, once it listens.
    pub async fn serve(&self) -> anyhow::Result<Child> {
        self.serve_on(None).await
    }
    /// The same, with its rows in a `store`.
    pub async fn serve_on(&self, store: Option<&str>) -> anyhow::Result<Child> {
        let (data, listen) = (self.path("data")?, self.address.to_string());
        let map = self.map.to_str().context("a path that is no text")?;
        let keys = self.people.keys.to_str().context("a path that is no text")?;
        let mut role = vec!["serve", "--data", &data, "--site", map, "--listen", &listen, "--ota-keys", keys];
        role.extend(store.iter().flat_map(|url| ["--store", url]));
        Child::start(&role, Some(0))?.listening().await
    }
    /// Starts robots that hear, on the other cores.
    pub fn hearers(&self, robots: usize, takes: Option<&str>) -> anyhow::Result<Child> {
        let (server, robots) = (self.address.to_string(), robots.to_string());
        let mut role = vec!["hearers", "--server", &server, "--robots", &robots];
        if let Some(bundle) = takes {
            role.extend(["--takes", bundle]);
        }
        Child::start(&role, Some(1))
    }
    /// Starts real agents that take software, on the other cores.
    pub fn swarm(&self, robots: usize) -> anyhow::Result<Child> {
        let trust = self.dir.path().join("trust.json");
        self.people.trust(self.site.site_id().clone())?.write(&trust)?;
        let (server, robots) = (self.address.to_string(), robots.to_string());
        let (map, trust) = (self.map.to_str().context("no text")?, trust.to_str().context("no text")?);
        let role = ["swarm", "--server", &server, "--site", map, "--robots", &robots, "--trust", trust];
        Child::start(&role, Some(1))
    }
    /// Areas that robots can be in.
    pub fn areas(&self) -> BTreeSet<String> {
        let all = (0..self.site.waypoints().len() as u32).map(WaypointIx);
        all.map(|at| self.site.area_of(at).area_id.to_string()).collect()
    }
    /// What the database says now; of a server that was killed it is read from a copy, so that the next one finds it as it was left.
    pub async fn read(&self) -> anyhow::Result<Rows> {
        let copy = tempfile::tempdir_in(self.dir.path()).context("making a directory for a copy")?;
        for file in ["control.db", "control.db-wal"] {
            let from = self.dir.path().join("data").join(file);
            if from.exists() {
                std::fs::copy(&from, copy.path().join(file)).with_context(|| format!("copying {file}"))?;
            }
        }
        Rows::read(copy.path(), self.site.site_id().clone()).await
    }
}

/// Waits until all robots are attached and the roll-outs know each of them.
pub async fn attached(server: &mut Child, rollouts: &mut Rollouts, robots: usize) -> anyhow::Result<()> {
    let end = Instant::now() + ATTACH_WITHIN;
    while (server.ask(SESSIONS)? as usize) < robots || rollouts.software().await?.len() < robots {
        ensure!(Instant::now() < end, "{} of {robots} robots are attached", server.ask(SESSIONS)?);
        sleep(LOOK_EVERY).await;
    }
    Ok(())
}

/// Rows of roll-outs as a database has them.
pub struct Rows {
    /// What robots should run, with the writes of each row so far.
    pub desired: Vec<(DesiredUpdate, Revision)>,
    /// Robots in roll-outs.
    pub robots: Vec<RolloutRobot>,
}

impl Rows {
    async fn read(dir: &Path, site: SiteId) -> anyhow::Result<Self> {
        let store = SqliteStore::open(dir, site, midshift_process::clock::clock(1000)).await?;
        let snapshot = store.snapshot(&[Table::DesiredUpdate, Table::RolloutRobot]).await?;
        store.close().await;
        let of = |table: Table| snapshot.rows.iter().filter(move |row| row.key.table == table);
        let desired = of(Table::DesiredUpdate).map(|row| anyhow::Ok((row.decode()?, row.revision)));
        let robots = of(Table::RolloutRobot).map(|row| anyhow::Ok(row.decode()?));
        Ok(Self { desired: desired.collect::<anyhow::Result<_>>()?, robots: robots.collect::<anyhow::Result<_>>()? })
    }
    /// Robots that were assigned: those with a directive.
    pub fn assigned(&self) -> usize {
        self.desired.iter().filter(|(desired, _)| !desired.directive.is_empty()).count()
    }
    /// Holds that each of so many robots was assigned once: one row of what it should run, written once, with a directive that its key
    /// signed and that the robot heard, and a row in the roll-out that says the same.
    pub fn check(&self, people: &People, robots: usize, hearers: &mut Child) -> anyhow::Result<()> {
        ensure!(self.desired.len() == robots && self.robots.len() == robots, "rows are missing");
        let key = people.directive_key()?;
        let (keys, now) = ([(key.id(), key)].into(), midshift_agent::clock::wall());
        for ((desired, revision), robot) in self.desired.iter().zip(&self.robots) {
            let id = &desired.robot_id;
            ensure!(*id == robot.robot_id && *revision == Revision(1), "{id} was assigned {} times", revision.0);
            ensure!(
                robot.step == Step::Staging && robot.directive_generation == desired.generation,
                "{id} is {:?}",
                robot.step
            );
            let expected = Expected { robot_id: id, keys: &keys, generation: 0, now, bugs: Bugs::default() };
            let said = Directive::verify(desired.directive.as_bytes(), &expected)?;
            ensure!(said.generation == desired.generation, "{id} has a directive of another generation");
            let at = crate::ota::hearers::index(id.as_str()).context("a robot of another name")?;
            let (heard, times) = (hearers.ask(&format!("generation {at}"))?, hearers.ask(&format!("count {at}"))?);
            ensure!((heard, times) == (desired.generation, 1), "{id} heard {times} generations, the last {heard}");
        }
        Ok(())
    }
}
