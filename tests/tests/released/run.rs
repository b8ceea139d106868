//! A run with everything that midshift 0.1.0 does, short: work, rules, commands of people, releases good and bad, another server, a drain; it ends
//! with the power.
//!
//! Invariant: whatever it is to leave behind it waits for; nothing is hoped for.

use crate::harness::{in_states, until};
use crate::plant::{Engine, LIMIT, Robot, Server};
use crate::tap::Tap;
use anyhow::ensure;
use midshift::samples::{self, Signer};
use midshift_core::robot::Lane;
use midshift_proto::task::v1::TaskState;
use midshift_tests::postgres::PostgresServer;
use midshift_tests::released::sqlite_text;
use midshift_tests::wire::Frame;
use std::path::Path;

/// Robots and where they begin.
pub const ROBOTS: [(&str, &str); 2] = [("rbt-01", "park-1"), ("rbt-02", "park-2")];
/// What a roll-out of the run is told: all robots at once, watched as briefly as can be.
const BRIEF: [&str; 10] =
    ["--waves", "rest", "--allow-full-push", "--soak", "0s", "--probation", "1s", "--exposure-tasks", "0", "--start"];

/// What is left of a run when the power is gone.
pub struct Left {
    /// Everything in it: `data` of the server, `rbt-01`, `rbt-02`.
    pub dir: tempfile::TempDir,
    /// Its database, if it is not in `data`.
    pub database: Option<String>,
    /// What robots and server said to each other.
    pub frames: Vec<Frame>,
}

/// Runs it to its end.
pub async fn run(engine: Engine) -> anyhow::Result<Left> {
    let dir = crate::harness::folder()?;
    let samples = dir.path().join("samples");
    samples::make(&samples, None, Signer::Throwaway, midshift::clock::wall())?;
    let database = (engine == Engine::Postgres).then(|| PostgresServer::shared().database());
    let mut flags = vec!["--ota-keys".to_owned(), samples.join("keys").display().to_string()];
    flags.extend(["--drain-seconds".to_owned(), "2".to_owned()]);
    flags.extend(database.iter().flat_map(|url| ["--store".to_owned(), url.clone()]));
    let mut server = Server::start(dir.path(), &flags).await?;
    let tap = Tap::before(server.address).await?;
    let mut robots = Vec::new();
    for (id, start) in ROBOTS {
        let home = dir.path().join(id);
        Robot::trusts(&home, &samples)?;
        robots.push(Robot::launch(&home, id, start, tap.address)?);
    }
    work(&server).await?;
    update(&server, &samples).await?;
    leave(&mut server, &mut robots).await?;
    Ok(Left { dir, database, frames: tap.frames() })
}

/// Tasks, rules, and what people ask about tasks and robots.
async fn work(server: &Server) -> anyhow::Result<()> {
    for (id, _) in ROBOTS {
        until("the robot is known", LIMIT, async || {
            Ok(server.call(&["robot", "get", id])?.status.success().then_some(()))
        })
        .await?;
    }
    server.done(&["area", "put", "hall", "--speed-limit", "1400"])?;
    submit(server, "FIRST", "A01", "B03", "rbt-01")?;
    submit(server, "SECOND", "A02", "B02", "rbt-02")?;
    server.done(&["robot", "cordon", "rbt-02", "--reason", "looked at", "--request-id", "cordon-1"])?;
    server.done(&["robot", "uncordon", "rbt-02", "--request-id", "uncordon-1"])?;
    submit(server, "UNWANTED", "A01", "B03", "rbt-09")?;
    server.done(&["task", "cancel", "UNWANTED", "--reason", "not wanted", "--request-id", "cancel-1"])?;
    for task in ["FIRST", "SECOND"] {
        server.until_task(task, &[TaskState::Succeeded]).await?;
    }
    server.until_task("UNWANTED", &[TaskState::Canceled]).await?;
    Ok(())
}

fn submit(server: &Server, id: &str, from: &str, to: &str, robot: &str) -> anyhow::Result<()> {
    let request = format!("submit-{id}");
    let what = ["--from", from, "--to", to, "--sku", "SKU-1", "--robot", robot, "--request-id", &request];
    server.done(&[&["task", "submit", "--task-id", id][..], &what].concat())
}

/// A release that is kept, one that is taken back by the robots themselves, and one that stands still half-way.
async fn update(server: &Server, samples: &Path) -> anyhow::Result<()> {
    server.done(&["bundle", "push", &samples.join("repository").display().to_string()])?;
    let begin = |id: &str| server.done(&[&["rollout", "create", id][..], &BRIEF].concat());
    let ends = |id: &str, code: i32| -> anyhow::Result<()> {
        let waited = server.call(&["rollout", "wait", id, "--timeout", "120s"])?;
        ensure!(waited.status.code() == Some(code), "{id}: {}", String::from_utf8_lossy(&waited.stderr));
        Ok(())
    };
    begin("walk-1.5.0")?;
    ends("walk-1.5.0", 0)?;
    begin("walk-1.6.0-bad-at-start")?;
    ends("walk-1.6.0-bad-at-start", 12)?;
    server.done(&["robot", "pin", "rbt-02", "--reason", "compared with others", "--request-id", "pin-1"])?;
    begin("walk-1.5.1")?;
    server.done(&["rollout", "pause", "walk-1.5.1", "--reason", "lunch"])
}

/// A robot is in maintenance, the other one carries something, more waits; then the power of the server goes, and later that of the robots.
async fn leave(server: &mut Server, robots: &mut [Robot]) -> anyhow::Result<()> {
    server.done(&["robot", "drain", "rbt-02", "--reason", "oil", "--request-id", "drain-1"])?;
    submit(server, "CARRIED", "A02", "B02", "rbt-01")?;
    submit(server, "WAITING", "A01", "B03", "rbt-01")?;
    submit(server, "FOR-THE-DRAINED", "A01", "B03", "rbt-02")?;
    server.until_task("CARRIED", &[TaskState::Running]).await?;
    let [first, ..] = robots else { anyhow::bail!("no robots") };
    // Robots are asked to move over; there is nobody for a while, and then they come back with their work.
    server.end().await?;
    let memory = first.home.join("data/agent.db");
    let status = format!("INSERT INTO \"sample\" VALUES({},", Lane::Status as i64);
    until("STATUS has gathered that no server has", LIMIT, async || {
        Ok((sqlite_text(&memory)?.matches(&status).count() >= 2).then_some(()))
    })
    .await?;
    server.again().await?;
    // It was let go on with what it picked up: the rest of its way is its own.
    let carries = |journal: &str| {
        let mut lines = journal.lines().skip_while(|line| !(line.contains("\"picked\"") && line.contains("CARRIED")));
        lines.any(|line| line.contains("\"left\""))
    };
    until("it carries something", LIMIT, async || Ok(carries(&first.journal()?).then_some(()))).await?;
    let running = in_states(server.address, &[TaskState::Running]).await?.unwrap_or_default();
    ensure!(running.iter().any(|task| task.task_id == "CARRIED"), "it was over too soon: {running:?}");
    server.kill()?;
    // What happens from here on only the robot knows.
    let known = first.journal()?.len();
    until("something more has happened", LIMIT, async || Ok((first.journal()?.len() > known).then_some(()))).await?;
    for robot in robots {
        robot.kill().await?;
    }
    Ok(())
}
