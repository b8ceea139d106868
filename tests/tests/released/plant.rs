//! A server and robots of a run, each in a folder of its own, on either engine.

use crate::harness::{Running, channel, free_port, in_states, midshift, until};
use anyhow::{Context, ensure};
use midshift_agent::trust::Trust;
use midshift_bundle::keys::SecretKey;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{ListTasksRequest, Task, TaskState};
use std::net::SocketAddr;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

/// Longest wait for anything that must happen.
pub const LIMIT: Duration = Duration::from_secs(120);
/// How many times as fast as real the bodies work; clocks are not touched.
const BODY_SPEED: &str = "5";

/// What is behind a store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Engine {
    /// Files.
    Sqlite,
    /// A server.
    Postgres,
}

impl Engine {
    /// Its name in paths.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sqlite => "sqlite",
            Self::Postgres => "postgres",
        }
    }
}

/// A `midshift serve`.
pub struct Server {
    /// Where it listens.
    pub address: SocketAddr,
    dir: PathBuf,
    flags: Vec<String>,
    running: Running,
}

impl Server {
    /// Starts it on `dir/data` and waits until it answers.
    pub async fn start(dir: &Path, flags: &[String]) -> anyhow::Result<Self> {
        std::fs::write(dir.join("site.toml"), DEMO)?;
        let address = free_port()?;
        let running = Self::run(dir, address, flags)?;
        let server = Self { address, dir: dir.to_owned(), flags: flags.to_vec(), running };
        server.answers().await?;
        Ok(server)
    }
    fn run(dir: &Path, address: SocketAddr, flags: &[String]) -> anyhow::Result<Running> {
        let mut command = Command::new(midshift()?);
        command
            .env("MIDSHIFT_NO_STOP", "true")
            .args(["serve", "--insecure"])
            .arg("--data")
            .arg(dir.join("data"))
            .args(["--listen", &address.to_string()]);
        command.arg("--site").arg(dir.join("site.toml")).args(flags);
        Running::start(&mut command, &dir.join("server.log"))
    }
    async fn answers(&self) -> anyhow::Result<()> {
        until("the server's first answer", Duration::from_secs(30), || async {
            let mut client = TaskServiceClient::new(channel(self.address)?);
            let request = ListTasksRequest { page_size: 1, ..ListTasksRequest::default() };
            Ok(client.list_tasks(request).await.ok().map(drop))
        })
        .await
        .with_context(|| std::fs::read_to_string(self.dir.join("server.log")).unwrap_or_default())
    }
    /// Asks it to end, and waits for that.
    pub async fn end(&mut self) -> anyhow::Result<()> {
        self.running.signal("TERM")?;
        self.running.ends().await?;
        Ok(())
    }
    /// Starts it again.
    pub async fn again(&mut self) -> anyhow::Result<()> {
        self.running = Self::run(&self.dir, self.address, &self.flags)?;
        self.answers().await
    }
    /// SIGKILL.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        self.running.kill()
    }
    /// The command line, spoken to this server; it must succeed.
    pub fn done(&self, arguments: &[&str]) -> anyhow::Result<()> {
        let output = self.call(arguments)?;
        ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
        Ok(())
    }
    /// The same, whatever it says.
    pub fn call(&self, arguments: &[&str]) -> anyhow::Result<Output> {
        let mut command = Command::new(midshift()?);
        command.args(arguments).args(["--server", &self.address.to_string()]);
        command.output().with_context(|| format!("calling {arguments:?}"))
    }
    /// Waits until a task is in one of these states.
    pub async fn until_task(&self, task_id: &str, states: &[TaskState]) -> anyhow::Result<Task> {
        until(&format!("{task_id} in one of {states:?}"), LIMIT, || async {
            let tasks = in_states(self.address, states).await?.unwrap_or_default();
            Ok(tasks.into_iter().find(|task| task.task_id == task_id))
        })
        .await
    }
}

/// A launcher with its agent; both end with this.
pub struct Robot {
    /// Its folder.
    pub home: PathBuf,
    running: Running,
}

impl Drop for Robot {
    fn drop(&mut self) {
        if self.running.has_ended().is_ok_and(|ended| !ended) {
            let _ = self.running.signal_group("KILL");
        }
    }
}

impl Robot {
    /// Whom a new robot in `home` believes: the release people of `samples`.
    pub fn trusts(home: &Path, samples: &Path) -> anyhow::Result<()> {
        std::fs::create_dir_all(home)?;
        let key = SecretKey::read(&samples.join("keys/directive-1.pem"))?.public();
        let root = std::fs::read(samples.join("repository/metadata/1.root.json"))?;
        let site = text::parse(DEMO)?.site_id().clone();
        Ok(Trust { root, directive_keys: [(key.id(), key)].into(), site }.write(&home.join("trust.json"))?)
    }
    /// Starts what lies in `home`; a body that never lived begins at `start`.
    pub fn launch(home: &Path, id: &str, start: &str, server: SocketAddr) -> anyhow::Result<Self> {
        let (program, sets) = (midshift()?, home.join("sets"));
        let mut command = Command::new(&program);
        command.arg("launcher").arg("--record").arg(home.join("tries")).arg("--sets").arg(&sets).arg("--");
        command.arg(&program).args(["agent", "run", "--robot-id", id, "--no-faults", "--server", &server.to_string()]);
        command.args(["--start", start, "--body-speed", BODY_SPEED]);
        command.arg("--data").arg(home.join("data")).arg("--sets").arg(&sets);
        command.arg("--trust").arg(home.join("trust.json")).process_group(0);
        Ok(Self { home: home.to_owned(), running: Running::start(&mut command, &home.join("log"))? })
    }
    /// SIGKILL to launcher and agent, and waits until both are gone.
    pub async fn kill(&mut self) -> anyhow::Result<()> {
        self.running.signal_group("KILL")?;
        self.running.ends().await?;
        // The agent's folder is free once it is gone too.
        let lock = std::fs::File::open(self.home.join("data/agent.lock"))?;
        until("the agent's end", LIMIT, || async { Ok(lock.try_lock().is_ok().then_some(())) }).await
    }
    /// What its body did.
    pub fn journal(&self) -> anyhow::Result<String> {
        Ok(std::fs::read_to_string(self.home.join("data/journal.jsonl"))?)
    }
}
