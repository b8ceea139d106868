//! A server of this build on the store of each release, with the robots of that run: what was open is done.

use super::run::Line;
use super::{Engine, ROBOTS, all, database};
use crate::harness::{Running, folder, free_port, in_states, midshift, until};
use crate::rolled_out::{Robot, done};
use crate::room::LIMIT;
use crate::stopped::{StopServer, until_held};
use anyhow::{Context, ensure};
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::TaskState;
use midshift_sim::judge::Judge;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Without login: certificates and tokens of a release end, and its recording stays.
fn serve(dir: &Path, database: Option<&str>) -> anyhow::Result<(SocketAddr, Running)> {
    std::fs::write(dir.join("site.toml"), DEMO)?;
    let address = free_port()?;
    let mut command = Command::new(midshift()?);
    // Its stop service would outlive the test.
    command.env("MIDSHIFT_NO_STOP", "true");
    command.args(["serve", "--insecure", "--listen", &address.to_string(), "--data"]);
    command.arg(dir.join("data")).arg("--site").arg(dir.join("site.toml"));
    command.args(database.iter().flat_map(|url| ["--store", url]));
    Ok((address, Running::start(&mut command, &dir.join("server.log"))?))
}

async fn carries_on(engine: Engine) -> anyhow::Result<()> {
    for from in all(engine)? {
        let dir = folder()?;
        let database = database::restore(&from, dir.path())?;
        let (address, _server) = serve(dir.path(), database.as_deref())?;
        let line = Line(address);
        let running =
            until("the server's first answer", LIMIT, async || in_states(address, &[TaskState::Running]).await);
        let running = running
            .await
            .with_context(|| std::fs::read_to_string(dir.path().join("server.log")).unwrap_or_default())?;
        ensure!(running.iter().any(|task| task.task_id == "CARRIED"), "nothing was at work: {running:?}");
        let stop = StopServer::start(dir.path(), address).await?;
        let engaged = stop.engaged().await?;
        let [stop_id] = &engaged[..] else { anyhow::bail!("one stop was engaged, and now {engaged:?} are") };
        let mut robots = Vec::new();
        for (id, start) in ROBOTS {
            // A robot with a certificate speaks TLS.
            std::fs::remove_file(dir.path().join(id).join("data/identity.json"))?;
            robots.push(Robot::relaunch(id, start, &dir.path().join(id), &address.to_string(), stop.address)?);
        }
        for task in ["CARRIED", "WAITING"] {
            line.until_task(task, &[TaskState::Succeeded]).await?;
        }
        // The other robot is in maintenance and stopped until a person says that it is not.
        line.done(&["robot", "undrain", "rbt-02"])?;
        until_held(address, &["rbt-02".to_owned()], &format!("stop:{stop_id}")).await?;
        stop.reset(stop_id)?;
        until_held(address, &["rbt-02".to_owned()], &format!("resume:{stop_id}")).await?;
        line.done(&["resume", "--stop", stop_id, "--reason", "all clear"])?;
        line.until_task("FOR-THE-DRAINED", &[TaskState::Succeeded]).await?;
        done(&["stop", "verify", "--data", &dir.path().join("data").display().to_string()])?;
        for robot in &robots {
            ensure!(robot.committed()?.as_deref() == Some("1.5.0"), "it runs {:?}", robot.switch()?);
        }
        let journals: Vec<PathBuf> =
            ROBOTS.iter().map(|(id, _)| dir.path().join(id).join("data/journal.jsonl")).collect();
        let verdict = Judge::read(&text::parse(DEMO)?, journals.iter().map(PathBuf::as_path))?.verdict();
        ensure!(verdict.items_conserved() && verdict.exclusion_violations == 0, "{verdict:?}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_of_a_release_end_their_tasks_with_this_server_on_its_files_of_sqlite() -> anyhow::Result<()> {
    carries_on(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_of_a_release_end_their_tasks_with_this_server_on_its_database_of_postgresql() -> anyhow::Result<()> {
    carries_on(Engine::Postgres).await
}
