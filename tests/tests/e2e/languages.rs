//! Our clients in other languages, as their packages are built from the .proto files: what each decides alone, its tour through a factory
//! at work, and a server that is killed under it.
//!
//! `cargo xtask test` builds them and says where they are.

use crate::clients::{grpcurl_passes, stock_python_passes};
use crate::factory::Factory;
use crate::harness::{Running, Server, approver, authority, channel, sign_in, tasks, tool, until};
use crate::robots::enrolment;
use crate::rolled_out::{call, done};
use crate::room::LIMIT;
use crate::stack::Stack;
use anyhow::{Context, ensure};
use midshift_core::site::DEMO;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{AbortRolloutRequest, GetRolloutRequest};
use midshift_proto::task::v1::CancelTaskRequest;
use std::io::Write;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;

#[derive(Clone, Copy, Debug)]
pub enum Language {
    Python,
    Go,
    TypeScript,
}

const ALL: [Language; 3] = [Language::Python, Language::Go, Language::TypeScript];

impl Language {
    fn home(self) -> anyhow::Result<PathBuf> {
        let name = match self {
            Self::Python => "python",
            Self::Go => "go",
            Self::TypeScript => "typescript",
        };
        Ok(tool("MIDSHIFT_TEST_CLIENTS")?.join(name))
    }
    /// Its own tests.
    fn tests(self) -> anyhow::Result<Command> {
        match self {
            Self::Python => self.run("-m", &["unittest", "discover", "-s", "tests"]),
            Self::Go => self.run("bin/midshift.test", &["-test.v"]),
            Self::TypeScript => self.run("--test", &["dist/test/client.test.js"]),
        }
    }
    fn tour(self) -> anyhow::Result<Command> {
        match self {
            Self::Python => self.run("examples/tour.py", &[]),
            Self::Go => self.run("bin/tour", &[]),
            Self::TypeScript => self.run("dist/examples/tour.js", &[]),
        }
    }
    fn endure(self) -> anyhow::Result<Command> {
        match self {
            Self::Python => self.run("tests/endure.py", &[]),
            Self::Go => self.run("bin/endure", &[]),
            Self::TypeScript => self.run("dist/test/endure.js", &[]),
        }
    }
    /// A batch of many small items.
    pub fn batch(self, arguments: &[&str]) -> anyhow::Result<Command> {
        match self {
            Self::Python => self.run("tests/batch.py", arguments),
            Self::Go => self.run("bin/batch", arguments),
            Self::TypeScript => anyhow::bail!("no program sends a batch"),
        }
    }
    /// Signs a text with a key file.
    pub fn signs(self, key: &Path, text: &str) -> anyhow::Result<Command> {
        match self {
            Self::Go => self.run("bin/keyfile", &[&key.to_string_lossy(), text]),
            Self::Python | Self::TypeScript => anyhow::bail!("no program signs"),
        }
    }
    fn run(self, program: &str, arguments: &[&str]) -> anyhow::Result<Command> {
        let home = self.home()?;
        let mut command = match self {
            Self::Python => {
                let mut command = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
                command.env("PYTHONPATH", home.join("built")).env("PYTHONDONTWRITEBYTECODE", "1");
                command.env("PYTHONUNBUFFERED", "1").arg(program);
                command
            }
            Self::Go => Command::new(home.join(program)),
            Self::TypeScript => {
                let mut command = Command::new(tool("MIDSHIFT_TEST_NODE")?);
                command.arg(program);
                command
            }
        };
        command.args(arguments).current_dir(home);
        Ok(command)
    }
}

/// A robot in Python that knows nothing of midshift but the .proto files, and stands in `park-a` of the corridor; with a line to the stop service at `stops`.
pub async fn minimal_robot(
    name: &str,
    server: SocketAddr,
    stops: Option<SocketAddr>,
    dir: &Path,
) -> anyhow::Result<Command> {
    let (line, authority) = (enrolment(server, name).await?.context("a site with a login")?, authority(server)?);
    let server = server.to_string();
    let (memory, journal) = (dir.join("robot.json").display().to_string(), dir.join("effects").display().to_string());
    let arguments = ["--server", &server, "--robot-id", name, "--data", &memory, "--journal", &journal];
    let mut command = Language::Python.run("examples/minimal_robot.py", &arguments)?;
    command.args(["--at", "park-a", "0", "3000", "--speed-mm-s", "5000", "--act-ms", "1500"]);
    command.env("MIDSHIFT_ENROLL", &line).arg("--ca").arg(authority);
    match stops {
        Some(stops) => command.args(["--stop-server", &stops.to_string()]),
        None => command.arg("--no-stop"),
    };
    Ok(command)
}

fn said(log: &Path) -> anyhow::Result<String> {
    std::fs::read_to_string(log).with_context(|| format!("reading {}", log.display()))
}

/// The rest of the first line that begins so.
fn after(text: &str, beginning: &str) -> Option<String> {
    text.lines().find_map(|line| line.strip_prefix(beginning)).map(str::to_owned)
}

#[test]
fn each_client_keeps_its_own_rules() -> anyhow::Result<()> {
    for language in ALL {
        let ran = language.tests()?.output()?;
        let text = [ran.stdout, ran.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
        ensure!(ran.status.success(), "{language:?}: {text}");
        let counted = match language {
            Language::Python => text.contains("Ran 13 tests"),
            Language::Go => text.matches("--- PASS").count() == 5,
            Language::TypeScript => text.contains("# pass 5"),
        };
        ensure!(counted, "{language:?} did not run what it should: {text}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_client_submits_watches_explains_hears_every_violation_and_watches_a_rollout() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let factory = Factory::one_box(dir.path()).await?;
    tours_pass(dir.path(), factory.address).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_client_and_foreign_ones_do_the_same_with_a_split_stack() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let factory = Factory::split(dir.path()).await?;
    grpcurl_passes(factory.address)?;
    stock_python_passes(dir.path(), factory.address)?;
    tours_pass(dir.path(), factory.address).await
}

/// The tour of each client through a factory that has the sample releases, all at once.
async fn tours_pass(dir: &Path, address: SocketAddr) -> anyhow::Result<()> {
    let server = address.to_string();
    let mut tours = Vec::new();
    for (language, robot) in ALL.into_iter().zip(["rbt-01", "rbt-02", "rbt-03"]) {
        let log = dir.join(format!("{language:?}.log"));
        let mut command = language.tour()?;
        sign_in(&mut command, address);
        let other = approver(address);
        command.envs(other.iter().map(|token| ("MIDSHIFT_APPROVER_TOKEN", token)));
        tours.push((Running::start(command.args([&server, robot, "walk-1.5.0"]), &log)?, log, robot));
    }
    for (mut tour, log, robot) in tours {
        let mut ended = || {
            let ended = tour.has_ended();
            async { Ok(ended?.then_some(())) }
        };
        until("the end of a tour", LIMIT, &mut ended).await?;
        let text = said(&log)?;
        ensure!(tour.ends().await? == Some(0), "{}: {text}", log.display());
        for field in ["flat.task_type: ", "flat.priority: ", "flat.timeout_seconds: ", "flat.to_waypoint: "] {
            ensure!(after(&text, &format!("violation {field}")).is_some(), "{field} is not in: {text}");
        }
        ensure!(text.contains("refused INVALID_REQUEST"), "{text}");
        let task = after(&text, "submitted ").context("no task")?;
        ensure!(after(&text, &format!("explained {task}: ")).is_some(), "{text}");
        let watched: Vec<_> = text.lines().filter(|line| line.starts_with("watched ")).collect();
        ensure!(watched.last().is_some_and(|line| line.contains("SUCCEEDED rbt-")), "{text}");
        ensure!(after(&text, "ended ").is_some_and(|state| state.ends_with("SUCCEEDED")), "{text}");
        let phases: Vec<_> =
            text.lines().filter(|l| l.starts_with("rollout ") && !l.starts_with("rollout robot")).collect();
        ensure!(phases.last().is_some_and(|line| line.contains("COMPLETED wave 0")), "{text}");
        ensure!(text.contains(&format!("rollout robot {robot} ")), "{text}");
    }
    Ok(())
}

/// Waits until each has said a line that begins so.
async fn all_said(logs: &[PathBuf], beginning: &str) -> anyhow::Result<()> {
    for log in logs {
        let heard = async || Ok(after(&said(log)?, beginning).map(|_| ()));
        until(beginning, LIMIT, heard).await.with_context(|| said(log).unwrap_or_default())?;
    }
    Ok(())
}

/// What clients know by an address, all of which is killed and started again.
enum Behind {
    OneBox(Server),
    Split(Box<Stack>),
}

impl Behind {
    fn address(&self) -> SocketAddr {
        match self {
            Self::OneBox(server) => server.address,
            Self::Split(stack) => stack.public,
        }
    }
    fn kill(&mut self) -> anyhow::Result<()> {
        match self {
            Self::OneBox(server) => server.kill(),
            Self::Split(stack) => stack.kill_all(),
        }
    }
    async fn restart(&mut self) -> anyhow::Result<()> {
        match self {
            Self::OneBox(server) => server.restart().await,
            Self::Split(stack) => stack.restart_all().await,
        }
    }
}

/// Sample releases in `dir`; the folder of their keys.
fn samples(dir: &Path) -> anyhow::Result<String> {
    done(&["bundle", "samples", &dir.join("samples").display().to_string()])?;
    Ok(dir.join("samples/keys").display().to_string())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_client_gives_up_in_time_and_outlives_a_server_that_is_killed() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let keys = samples(dir.path())?;
    let server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    endurance_passes(dir.path(), Behind::OneBox(server)).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_client_gives_up_in_time_and_outlives_a_split_stack_that_is_killed() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let keys = samples(dir.path())?;
    let stack = Stack::start(dir.path(), DEMO, &[], &["--ota-keys", &keys]).await?;
    endurance_passes(dir.path(), Behind::Split(Box::new(stack))).await
}

/// Each client has a task and a roll-out under way when all that it talks to is killed, and both when it is back.
async fn endurance_passes(dir: &Path, mut behind: Behind) -> anyhow::Result<()> {
    let address = behind.address().to_string();
    done(&["bundle", "push", "--server", &address, &dir.join("samples/repository").display().to_string()])?;
    let create = ["rollout", "create", "--server", &address, "walk-1.5.0", "--waves", "rest", "--allow-full-push"];
    // Another process than the one that took the release may be asked, and hears of it a moment later.
    let known = || async { Ok(call(&create)?.status.success().then_some(())) };
    until("the release to be known", LIMIT, known).await?;
    let logs = ALL.map(|language| dir.join(format!("{language:?}.log")));
    let mut clients = Vec::new();
    for (language, log) in ALL.into_iter().zip(&logs) {
        let mut command = language.endure()?;
        sign_in(&mut command, behind.address());
        let (running, ear) = Running::start_listening(command.args([&address, "walk-1.5.0"]), log)?;
        clients.push((running, ear, log));
    }
    all_said(&logs, "submitted ").await?;
    behind.kill()?;
    for (_, ear, _) in &mut clients {
        writeln!(ear, "killed")?;
    }
    all_said(&logs, "asking").await?;
    behind.restart().await?;
    all_said(&logs, "again ").await?;
    let mut rollouts = RolloutServiceClient::new(channel(behind.address())?);
    let request = GetRolloutRequest { rollout_id: "walk-1.5.0".to_owned() };
    let rollout = rollouts.get_rollout(request).await?.into_inner().rollout.unwrap_or_default();
    let request = AbortRolloutRequest { rollout_id: rollout.rollout_id, etag: rollout.etag, ..Default::default() };
    rollouts.abort_rollout(request).await?;
    for (running, _, log) in &mut clients {
        let text = said(log)?;
        ensure!(after(&text, "gave up ").is_some(), "a deadline did not hold: {text}");
        let task_id = after(&text, "submitted ").context("no task")?;
        ensure!(after(&text, "again ").as_ref() == Some(&task_id), "it was made twice: {text}");
        ensure!(after(&text, "ended ").is_none(), "it ended too early: {text}");
        let request = CancelTaskRequest { task_id, reason: "the test is over".to_owned(), ..Default::default() };
        tasks(behind.address())?.cancel_task(request).await?;
        ensure!(running.ends().await? == Some(0), "{}", said(log)?);
        ensure!(after(&said(log)?, "ended ").is_some_and(|state| state.ends_with("CANCELED")), "{}", said(log)?);
        ensure!(after(&said(log)?, "rollout ").is_some_and(|phase| phase.ends_with("ABORTED")), "{}", said(log)?);
    }
    Ok(())
}
