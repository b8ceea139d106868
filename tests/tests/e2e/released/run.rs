//! A short run with everything that a site does: work, rules, commands of people, a fleet stop, tokens, releases good and
//! bad, another start of the server, a drain. It ends when the power goes.
//!
//! Invariant: it waits for whatever it is to leave behind; nothing is hoped for.

use super::database::sqlite_text;
use super::{Engine, Left, ROBOTS};
use crate::harness::{Server, folder, in_states, until};
use crate::rolled_out::{Doors, Robot, begin_rollout, call, done, fleet};
use crate::room::LIMIT;
use crate::stopped::{StopServer, until_held};
use anyhow::ensure;
use midshift_cli::samples::{self, Signer};
use midshift_core::robot::Lane;
use midshift_core::site::DEMO;
use midshift_proto::task::v1::{Task, TaskState};
use midshift_tests::postgres::PostgresServer;
use std::net::SocketAddr;
use std::path::Path;

/// What a roll-out of the run is told: all robots at once, watched as briefly as can be.
const BRIEF: [&str; 9] =
    ["--waves", "rest", "--allow-full-push", "--soak", "0s", "--probation", "1s", "--exposure-tasks", "0"];

/// The command line, spoken to one server.
#[derive(Clone, Copy)]
pub struct Line(pub SocketAddr);

impl Line {
    /// It must succeed.
    pub fn done(self, arguments: &[&str]) -> anyhow::Result<()> {
        done(&[arguments, &["--server", &self.0.to_string()]].concat())
    }
    /// Sends a task for one robot.
    fn submit(self, id: &str, robot: &str) -> anyhow::Result<()> {
        let request = format!("submit-{id}");
        let (from, to) = if robot == ROBOTS[1].0 { ("A02", "B02") } else { ("A01", "B03") };
        let what = [
            "--from",
            from,
            "--to",
            to,
            "--sku",
            "SKU-1",
            "--robot",
            robot,
            "--unknown-robot",
            "--request-id",
            &request,
        ];
        self.done(&[&["task", "submit", "--task-id", id][..], &what].concat())
    }
    /// Waits until a task is in one of these states.
    pub async fn until_task(self, task_id: &str, states: &[TaskState]) -> anyhow::Result<Task> {
        until(&format!("{task_id} in one of {states:?}"), LIMIT, async || {
            let tasks = in_states(self.0, states).await?.unwrap_or_default();
            Ok(tasks.into_iter().find(|task| task.task_id == task_id))
        })
        .await
    }
}

/// Runs it to its end.
pub async fn run(engine: Engine) -> anyhow::Result<Left> {
    let dir = folder()?;
    let samples = dir.path().join("samples");
    // Settings alone: with its program a recording would have a hundred megabytes.
    samples::make(&samples, None, Signer::Throwaway, midshift_process::clock::wall())?;
    let database = (engine == Engine::Postgres).then(|| PostgresServer::shared().database());
    let keys = samples.join("keys").display().to_string();
    let mut flags = vec!["--drain-seconds", "2", "--ota-keys", &keys];
    flags.extend(database.iter().flat_map(|url| ["--store", url]));
    let mut server = Server::start_with(dir.path(), DEMO, &flags).await?;
    let mut stop = StopServer::start(dir.path(), server.address).await?;
    let doors = Doors { people: server.address, robots: server.address, stops: Some(stop.address) };
    let (mut robots, _) = fleet(dir.path(), &doors, &samples, ROBOTS.len()).await?;
    let line = Line(server.address);
    work(line).await?;
    stops(line, &stop).await?;
    update(line)?;
    leave(line, dir.path(), &mut server, &stop).await?;
    stop.kill()?;
    for (robot, (id, _)) in robots.iter_mut().zip(ROBOTS) {
        end(robot, &dir.path().join(id)).await?;
    }
    Ok(Left { dir, database })
}

/// A task type with a field of each kind.
const LOOK: &str = r#"
name = "look"
description = "Looks at a place."
timeout = "60s"
fields = [
    { name = "at", description = "Where.", waypoint = {} },
    { name = "pause", description = "Before.", integer = { least = 1, most = 9, unit = "s" }, default = 2 },
    { name = "zoom", description = "Of it.", number = { least = 0.5, most = 4.0, unit = "" }, default = 1.5 },
    { name = "note", description = "For people.", text = { max_bytes = 64 }, default = "" },
    { name = "side", description = "Of it.", choice = { choices = ["left", "right"] }, default = "left" },
]
steps = [
    { goto = { field = "at" } },
    { wait = { field = "pause" } },
    { action = { name = "inspect", params = { zoom = "zoom", note = "note", side = "side" } } },
]
"#;

/// Tasks, rules, rights, and what people ask about tasks and robots.
async fn work(line: Line) -> anyhow::Result<()> {
    line.done(&["token", "create", "orders", "--role", "operator", "--valid", "1d"])?;
    line.done(&["area", "put", "hall", "--speed-limit", "1400"])?;
    line.done(&["planner", "put", "--horizon", "20s"])?;
    line.done(&["zone", "block", "door", "--reason", "under repair", "--for", "1d"])?;
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("look.toml");
    std::fs::write(&file, LOOK)?;
    line.done(&["task", "type", "put", &file.display().to_string()])?;
    line.done(&["task", "type", "accept", "known"])?;
    line.submit("FIRST", "rbt-01")?;
    line.submit("SECOND", "rbt-02")?;
    line.done(&["robot", "cordon", "rbt-02", "--reason", "looked at", "--request-id", "cordon-1"])?;
    line.done(&["robot", "uncordon", "rbt-02", "--request-id", "uncordon-1"])?;
    line.submit("UNWANTED", "rbt-09")?;
    line.done(&["task", "cancel", "UNWANTED", "--reason", "not wanted", "--request-id", "cancel-1"])?;
    for task in ["FIRST", "SECOND"] {
        line.until_task(task, &[TaskState::Succeeded]).await?;
    }
    line.until_task("UNWANTED", &[TaskState::Canceled]).await?;
    Ok(())
}

/// A stop that is reset and resumed.
async fn stops(line: Line, stop: &StopServer) -> anyhow::Result<()> {
    let stop_id = stop.stop(&["--robot", "rbt-02"])?;
    let robots = ["rbt-02".to_owned()];
    until_held(line.0, &robots, &format!("stop:{stop_id}")).await?;
    stop.reset(&stop_id)?;
    until_held(line.0, &robots, &format!("resume:{stop_id}")).await?;
    line.done(&["resume", "--stop", &stop_id, "--reason", "all clear"])
}

/// A release that is kept, one that the robots take back by themselves, and one that stands still half-way.
fn update(line: Line) -> anyhow::Result<()> {
    let address = line.0.to_string();
    let begin = |id: &str| {
        line.done(&[&["rollout", "create", id][..], &BRIEF].concat())?;
        begin_rollout(&address, id)
    };
    let ends = |id: &str, code: i32| -> anyhow::Result<()> {
        let waited = call(&["rollout", "wait", id, "--timeout", "120s", "--server", &address])?;
        ensure!(waited.status.code() == Some(code), "{id}: {}", String::from_utf8_lossy(&waited.stderr));
        Ok(())
    };
    begin("walk-1.5.0")?;
    ends("walk-1.5.0", 0)?;
    begin("walk-1.6.0-bad-at-start")?;
    ends("walk-1.6.0-bad-at-start", 12)?;
    line.done(&["robot", "pin", "rbt-02", "--reason", "compared with others", "--request-id", "pin-1"])?;
    begin("walk-1.5.1")?;
    line.done(&["rollout", "pause", "walk-1.5.1", "--reason", "lunch"])
}

/// A robot is in maintenance and stopped, the other one carries something, more waits; then the power of the server goes.
async fn leave(line: Line, dir: &Path, server: &mut Server, stop: &StopServer) -> anyhow::Result<()> {
    line.done(&["robot", "drain", "rbt-02", "--reason", "oil", "--request-id", "drain-1"])?;
    stop.stop(&["--robot", "rbt-02"])?;
    line.submit("CARRIED", "rbt-01")?;
    line.submit("WAITING", "rbt-01")?;
    line.submit("FOR-THE-DRAINED", "rbt-02")?;
    line.until_task("CARRIED", &[TaskState::Running]).await?;
    // Nobody serves for a while; then the robots come back with their work.
    server.kill()?;
    let memory = dir.join("rbt-01/data/agent.db");
    let status = format!("INSERT INTO \"sample\" VALUES({},", Lane::Status as i64);
    until("STATUS has gathered that no server has", LIMIT, async || {
        Ok((sqlite_text(&memory)?.matches(&status).count() >= 2).then_some(()))
    })
    .await?;
    server.restart().await?;
    // It was let go on with what it picked up: the rest of its way is its own.
    let journal = || std::fs::read_to_string(dir.join("rbt-01/data/journal.jsonl"));
    let carries = |journal: &str| {
        let mut lines = journal.lines().skip_while(|line| !(line.contains("\"picked\"") && line.contains("CARRIED")));
        lines.any(|line| line.contains("\"left\""))
    };
    until("it carries something", LIMIT, async || Ok(carries(&journal()?).then_some(()))).await?;
    let running = in_states(line.0, &[TaskState::Running]).await?.unwrap_or_default();
    ensure!(running.iter().any(|task| task.task_id == "CARRIED"), "it was over too soon: {running:?}");
    server.kill()?;
    // What happens from here on only the robot knows.
    let known = journal()?.len();
    until("something more has happened", LIMIT, async || Ok((journal()?.len() > known).then_some(()))).await
}

/// SIGKILL to launcher and agent, until both are gone.
async fn end(robot: &mut Robot, home: &Path) -> anyhow::Result<()> {
    robot.end()?;
    // The agent is the launcher's child; its folder is free once it is gone too.
    let lock = std::fs::File::open(home.join("data/agent.lock"))?;
    until("the agent's end", LIMIT, async || Ok(lock.try_lock().is_ok().then_some(()))).await
}
