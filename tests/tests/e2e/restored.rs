//! A backup is taken while robots work, the server is lost, and the robots carry on from what was restored.

use crate::harness::{Server, command, until};
use crate::robots::{Robots, with_robots};
use crate::secrets::heard;
use crate::stopped::{StopServer, resume, until_held};
use midshift_cli::task_list::request;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::task::v1::submit_task_result::Outcome;
use midshift_proto::task::v1::{SubmitTasksRequest, TaskState};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListEventsRequest, event::Item};
use midshift_sim::judge::Judge;
use midshift_sim::workload::{Workload, WorkloadConfig};
use midshift_tests::postgres::PostgresServer;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

const ROBOTS: usize = 6;
const TASKS: usize = 12;

pub fn run(arguments: &[&str]) -> anyhow::Result<String> {
    let output = heard(&mut command(arguments)?)?;
    anyhow::ensure!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

async fn submit(server: &Server, site: &Site, seed: u64, prefix: &str) -> anyhow::Result<Vec<String>> {
    let mut workload =
        Workload::new(WorkloadConfig::background(seed), site).ok_or_else(|| anyhow::anyhow!("no stations"))?;
    let items: Vec<SubmitTasksRequest> = (0..TASKS)
        .map(|i| {
            let mut item = request(&workload.next_transport());
            item.request_id = format!("{prefix}-{i}");
            SubmitTasksRequest { item: Some(item) }
        })
        .collect();
    let answer = server.tasks()?.submit_tasks(tokio_stream::iter(items)).await?.into_inner();
    let admitted = answer.results.into_iter().filter_map(|result| match result.outcome? {
        Outcome::TaskId(id) => Some(id),
        Outcome::Refusal(_) => None,
    });
    Ok(admitted.collect())
}

async fn until_done(server: &Server, count: usize) -> anyhow::Result<()> {
    until(&format!("{count} tasks done"), Duration::from_secs(180), || async {
        let done = server.in_states(&[TaskState::Succeeded]).await?;
        Ok(done.filter(|done| done.len() >= count).map(drop))
    })
    .await
}

/// Numbers of each lane without a hole: what was taken by a server that is gone is a gap. Returns the reasons of all gaps.
async fn reasons_of_gaps(server: &Server) -> anyhow::Result<Vec<String>> {
    let mut client = TelemetryServiceClient::new(server.channel()?);
    let (mut next, mut reasons): (BTreeMap<_, u64>, Vec<String>) = Default::default();
    let mut cursor = String::new();
    loop {
        let request = ListEventsRequest { page_size: 1_000, cursor, ..ListEventsRequest::default() };
        let page = client.list_events(request).await?.into_inner();
        for event in page.events {
            let expected = next.entry((event.robot_id.clone(), event.ring.clone(), event.lane)).or_insert(1);
            let (first, last) = match &event.item {
                Some(Item::Sample(sample)) => (sample.seq, sample.seq),
                Some(Item::Gap(gap)) => {
                    reasons.push(gap.reason.clone().unwrap_or_default().code);
                    (gap.from_seq, gap.to_seq)
                }
                other => anyhow::bail!("{other:?}"),
            };
            anyhow::ensure!(first == *expected, "{} goes on with {first}, not {expected}", event.robot_id);
            *expected = last + 1;
        }
        if page.caught_up {
            return Ok(reasons);
        }
        cursor = page.cursor;
    }
}

/// Where the server keeps its rows and samples, and how those are lost.
#[derive(Clone, Copy, Debug)]
pub enum Engine {
    Sqlite,
    /// With the name of its database.
    Postgres(&'static str),
}

impl Engine {
    /// What `serve`, `backup` and `restore` are told.
    pub fn flags(self) -> Vec<String> {
        match self {
            Self::Sqlite => Vec::new(),
            Self::Postgres(database) => vec!["--store".to_owned(), PostgresServer::shared().url(database)],
        }
    }
    /// Names of the parts of a backup.
    const fn parts(self) -> &'static str {
        match self {
            Self::Sqlite => "control\ntelemetry\nidentity\n",
            Self::Postgres(_) => "postgresql\nidentity\n",
        }
    }
    pub fn prepare(self) {
        if let Self::Postgres(database) = self {
            PostgresServer::shared().database_named(database);
        }
    }
    /// Nothing of it is left.
    pub fn lose(self, data: &Path) -> anyhow::Result<()> {
        if let Self::Postgres(database) = self {
            PostgresServer::shared().emptied(database);
        }
        if data.exists() {
            std::fs::remove_dir_all(data)?;
        }
        Ok(())
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_carry_on_from_a_backup_of_sqlite_that_was_taken_while_they_worked() -> anyhow::Result<()> {
    drill(Engine::Sqlite).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn robots_carry_on_from_a_backup_of_postgresql_that_was_taken_while_they_worked() -> anyhow::Result<()> {
    drill(Engine::Postgres("drill")).await
}

async fn drill(engine: Engine) -> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let site = with_robots(DEMO, ROBOTS)?;
    engine.prepare();
    let flags = engine.flags();
    let flags: Vec<&str> = flags.iter().map(String::as_str).collect();
    let mut server = Server::start_with(dir.path(), &text::render(&site), &flags).await?;
    let robots = Robots::start(dir.path(), server.address, server.address, &site).await?;
    let before = submit(&server, &site, 1, "before").await?;
    until_done(&server, 2).await?;
    let (data, backup) = (server.data(), dir.path().join("backup"));
    let (data, backup) = (data.to_string_lossy(), backup.to_string_lossy());
    run(&[&["backup", "--data", &data, "--to", &backup][..], &flags].concat())?;
    let parts = run(&["restore", "--verify", "--from", &backup, "-o", "name"])?;
    assert_eq!(parts, engine.parts());
    // What is done from here on nobody but the robots will know of.
    until_done(&server, 6).await?;
    server.kill()?;
    engine.lose(&server.data())?;
    run(&[&["restore", "--from", &backup, "--data", &data, "--identity", "as-backed-up"][..], &flags].concat())?;
    server.restart().await?;
    let after = submit(&server, &site, 2, "after").await?;
    let ended = until("every task to be over or with a person", Duration::from_secs(240), || async {
        let over = [TaskState::Succeeded, TaskState::NeedsOperator, TaskState::Failed];
        let Some(over) = server.in_states(&over).await? else { return Ok(None) };
        Ok((over.len() == 2 * TASKS).then_some(over))
    })
    .await?;
    let done: Vec<&str> =
        ended.iter().filter(|t| t.state() == TaskState::Succeeded).map(|t| t.task_id.as_str()).collect();
    assert!(after.iter().all(|id| done.contains(&id.as_str())), "{after:?} were to be done, {done:?} are");
    assert!(before.iter().filter(|id| done.contains(&id.as_str())).count() >= TASKS - ROBOTS, "{done:?}");
    let reasons = reasons_of_gaps(&server).await?;
    assert!(!reasons.is_empty() && reasons.iter().all(|code| code == "FREED_AFTER_ACK"), "{reasons:?}");
    let journals = robots.journals();
    let verdict = Judge::read(&site, journals.iter().map(PathBuf::as_path))?.verdict();
    assert!(verdict.items_conserved() && verdict.exclusion_violations == 0, "{verdict:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restored_stop_service_stops_what_stood_at_the_backup_and_takes_later_stops_back_from_robots()
-> anyhow::Result<()> {
    let dir = tempfile::tempdir()?;
    let site = with_robots(DEMO, 4)?;
    let mut server = Server::start_for(dir.path(), &site).await?;
    let mut stops = StopServer::start(dir.path(), server.address).await?;
    let robots = Robots::start_beside(dir.path(), server.address, server.address, Some(stops.address), &site).await?;
    let [stood, reset_later] = [stops.stop(&["--robot", "rbt-01"])?, stops.stop(&["--robot", "rbt-02"])?];
    let reset_before = stops.stop(&["--robot", "rbt-04"])?;
    stops.reset(&reset_before)?;
    let (data, backup) = (server.data(), dir.path().join("backup"));
    let (data, backup) = (data.to_string_lossy(), backup.to_string_lossy());
    run(&["backup", "--data", &data, "--to", &backup])?;
    assert_eq!(run(&["restore", "--verify", "--from", &backup, "-o", "name"])?, "control\ntelemetry\nidentity\nstop\n");
    // Of these two nobody but the robots will know.
    stops.reset(&reset_later)?;
    let later = stops.stop(&["--robot", "rbt-03"])?;
    until_held(server.address, &["rbt-03".to_owned()], &format!("stop:{later}")).await?;
    server.kill()?;
    stops.kill()?;
    std::fs::remove_dir_all(server.data())?;
    run(&["restore", "--from", &backup, "--data", &data, "--identity", "as-backed-up"])?;
    server.restart().await?;
    stops.restart().await?;

    let mut expected = vec![stood.clone(), reset_later.clone(), later.clone()];
    expected.sort();
    until("the robot brings its stop back", Duration::from_secs(60), || async {
        let mut engaged = stops.engaged().await.unwrap_or_default();
        engaged.sort();
        Ok((engaged == expected).then_some(()))
    })
    .await?;
    for (robot, stop_id) in [("rbt-01", &stood), ("rbt-02", &reset_later), ("rbt-03", &later)] {
        until_held(server.address, &[robot.to_owned()], &format!("stop:{stop_id}")).await?;
    }
    run(&["stop", "verify", "--data", &data])?;
    // Reset by name once more, and resumed: then all of them work.
    for stop_id in &expected {
        stops.reset(stop_id)?;
    }
    for (robot, stop_id) in
        [("rbt-01", &stood), ("rbt-02", &reset_later), ("rbt-03", &later), ("rbt-04", &reset_before)]
    {
        until_held(server.address, &[robot.to_owned()], &format!("resume:{stop_id}")).await?;
        resume(&server, stop_id)?;
    }
    submit(&server, &site, 2, "after").await?;
    until_done(&server, TASKS).await?;
    assert_eq!(robots.ids().len(), 4);
    Ok(())
}
