//! A server of this build on the store of each release, with the robots of that run: what was open is done.

use crate::harness::in_states;
use crate::plant::{Engine, Robot, Server};
use crate::run::ROBOTS;
use crate::stores::restore;
use anyhow::ensure;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::TaskState;
use midshift_sim::oracle::Oracle;
use midshift_tests::released::{self, RELEASES, Release};
use std::path::PathBuf;

async fn carries_on(engine: Engine) -> anyhow::Result<()> {
    for release in Release::all()? {
        let dir = crate::harness::folder()?;
        let data = dir.path().join("data");
        let from = release.engine(engine.name());
        let database = restore(&release, engine, &data)?;
        released::copy(&from.join(RELEASES), &data.join(RELEASES))?;
        let flags: Vec<String> = database.iter().flat_map(|url| ["--store".to_owned(), url.clone()]).collect();
        let server = Server::start(dir.path(), &flags).await?;
        let running = in_states(server.address, &[TaskState::Running]).await?.unwrap_or_default();
        ensure!(running.iter().any(|task| task.task_id == "CARRIED"), "nothing was at work: {running:?}");
        let mut robots = Vec::new();
        for (id, start) in ROBOTS {
            let home = dir.path().join(id);
            released::copy(&from.join("robots").join(id), &home)?;
            robots.push(Robot::launch(&home, id, start, server.address)?);
        }
        for task in ["CARRIED", "WAITING"] {
            server.until_task(task, &[TaskState::Succeeded]).await?;
        }
        // The other robot is in maintenance until somebody says that it is not.
        server.done(&["robot", "undrain", "rbt-02"])?;
        server.until_task("FOR-THE-DRAINED", &[TaskState::Succeeded]).await?;
        let journals: Vec<PathBuf> = robots.iter().map(|robot| robot.home.join("data/journal.jsonl")).collect();
        let verdict = Oracle::read(&text::parse(DEMO)?, journals.iter().map(PathBuf::as_path))?.verdict();
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
