//! Robots as programs of their own.

use crate::harness::{Running, midshift};
use midshift_agent::ledger::Ledger;
use midshift_agent::sqlite::SqliteStore;
use midshift_agent::store::Store;
use midshift_core::site::Site;
use midshift_sim::swarm::AGENT_FILE;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;

/// How many times as fast as real the bodies work; clocks are not touched.
const BODY_SPEED: &str = "5";

/// Agents in processes of their own, each with its folder, which can be killed and started again.
pub struct Robots {
    dir: PathBuf,
    server: String,
    starts: Vec<String>,
    running: BTreeMap<String, Running>,
}

impl Robots {
    /// Starts `count` of them at starting places of the site.
    pub fn start(dir: &Path, server: SocketAddr, site: &Site, count: usize) -> anyhow::Result<Self> {
        let starts = site.starting_places(count).into_iter().map(|at| site.name_of(at).to_string()).collect();
        let mut robots = Self { dir: dir.to_owned(), server: server.to_string(), starts, running: BTreeMap::new() };
        (0..count).try_for_each(|number| robots.start_one(number))?;
        Ok(robots)
    }
    /// Names of all.
    pub fn ids(&self) -> Vec<String> {
        self.running.keys().cloned().collect()
    }
    fn start_one(&mut self, number: usize) -> anyhow::Result<()> {
        let id = format!("rbt-{:02}", number + 1);
        let dir = self.dir.join(&id);
        std::fs::create_dir_all(&dir)?;
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
        command.args(["--start", &self.starts[number], "--seed", &number.to_string()]).arg("--data").arg(&dir);
        let running = Running::start(&mut command, &dir.join("agent.log"))?;
        self.running.insert(id, running);
        Ok(())
    }
    /// SIGKILL.
    pub fn kill(&mut self, id: &str) -> anyhow::Result<()> {
        self.running.get_mut(id).map_or(Ok(()), Running::kill)
    }
    /// Starts one again that was killed.
    pub fn restart(&mut self, id: &str) -> anyhow::Result<()> {
        let number: usize = id.trim_start_matches("rbt-").parse()?;
        self.start_one(number - 1)
    }
    /// What a robot remembers; its agent must not run.
    pub async fn ledger(&self, id: &str) -> anyhow::Result<Ledger> {
        Ok(SqliteStore::open(&self.dir.join(id).join(AGENT_FILE)).await?.load("").await?.ledger)
    }
    /// Journals of all bodies.
    pub fn journals(&self) -> Vec<PathBuf> {
        self.running.keys().map(|id| self.dir.join(id).join("journal.jsonl")).collect()
    }
}
