//! Our clients in other languages, as their packages are built from the .proto files: what each decides alone, its tour through a factory
//! at work, and a server that is killed under it.
//!
//! `cargo xtask test` builds them and says where they are.

use crate::clients::dev;
use crate::harness::{Running, Server, midshift, tool, until};
use crate::room::LIMIT;
use anyhow::{Context, ensure};
use midshift_core::site::DEMO;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{AbortRolloutRequest, GetRolloutRequest};
use midshift_proto::task::v1::CancelTaskRequest;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

#[derive(Clone, Copy, Debug)]
enum Language {
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

/// A robot in Python that knows nothing of midshift but the .proto files, and stands in `park-a` of the corridor.
pub fn minimal_robot(name: &str, server: &str, dir: &Path) -> anyhow::Result<Command> {
    let (memory, journal) = (dir.join("robot.json").display().to_string(), dir.join("effects").display().to_string());
    let arguments = ["--server", server, "--robot-id", name, "--data", &memory, "--journal", &journal];
    let mut command = Language::Python.run("examples/minimal_robot.py", &arguments)?;
    command.args(["--at", "park-a", "0", "3000", "--speed-mm-s", "5000", "--act-ms", "1500"]);
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
            Language::Python => text.contains("Ran 4 tests"),
            Language::Go => text.matches("--- PASS").count() == 4,
            Language::TypeScript => text.contains("# pass 4"),
        };
        ensure!(counted, "{language:?} did not run what it should: {text}");
    }
    Ok(())
}

/// Takes the sample releases into the factory with its throw-away keys, as its first lines say.
fn bring_samples(dir: &Path, server: &str) -> anyhow::Result<()> {
    let log = said(&dir.join("dev.log"))?;
    let flag = |name: &str| {
        let mut words = log.split_whitespace().skip_while(|word| *word != name);
        words.nth(1).with_context(|| format!("dev did not say its {name}")).map(str::to_owned)
    };
    let (repository, key) = (flag("--repository")?, flag("--key")?);
    let samples = dir.join("samples").display().to_string();
    let make = ["bundle", "samples", &samples, "--config-only", "--repository", &repository, "--key", &key];
    midshift_does(&make)?;
    midshift_does(&["bundle", "push", "--server", server, &repository])
}

fn midshift_does(arguments: &[&str]) -> anyhow::Result<()> {
    let ran = Command::new(midshift()?).args(arguments).output()?;
    ensure!(ran.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&ran.stderr));
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_client_submits_watches_explains_hears_every_violation_and_watches_a_rollout() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let (address, _dev) = dev(dir.path()).await?;
    let server = address.to_string();
    bring_samples(dir.path(), &server)?;
    let mut tours = Vec::new();
    for (language, robot) in ALL.into_iter().zip(["rbt-01", "rbt-02", "rbt-03"]) {
        let log = dir.path().join(format!("{language:?}.log"));
        let mut command = language.tour()?;
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

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_client_gives_up_in_time_and_outlives_a_server_that_is_killed() -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let samples = dir.path().join("samples");
    let (folder, keys) = (samples.display().to_string(), samples.join("keys").display().to_string());
    midshift_does(&["bundle", "samples", &folder])?;
    let mut server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    let address = server.address.to_string();
    midshift_does(&["bundle", "push", "--server", &address, &samples.join("repository").display().to_string()])?;
    let create = ["rollout", "create", "--server", &address, "walk-1.5.0", "--waves", "rest", "--allow-full-push"];
    midshift_does(&create)?;
    let logs = ALL.map(|language| dir.path().join(format!("{language:?}.log")));
    let mut clients = Vec::new();
    for (language, log) in ALL.into_iter().zip(&logs) {
        let (running, ear) = Running::start_listening(language.endure()?.args([&address, "walk-1.5.0"]), log)?;
        clients.push((running, ear, log));
    }
    all_said(&logs, "submitted ").await?;
    server.kill()?;
    for (_, ear, _) in &mut clients {
        writeln!(ear, "killed")?;
    }
    all_said(&logs, "asking").await?;
    server.restart().await?;
    all_said(&logs, "again ").await?;
    let mut rollouts = RolloutServiceClient::new(server.channel()?);
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
        server.tasks()?.cancel_task(request).await?;
        ensure!(running.ends().await? == Some(0), "{}", said(log)?);
        ensure!(after(&said(log)?, "ended ").is_some_and(|state| state.ends_with("CANCELED")), "{}", said(log)?);
        ensure!(after(&said(log)?, "rollout ").is_some_and(|phase| phase.ends_with("ABORTED")), "{}", said(log)?);
    }
    Ok(())
}
