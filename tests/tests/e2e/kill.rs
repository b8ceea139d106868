//! Twenty agent processes survive `kill -9` of the server three times and of five agents once each, while they work; and an immediate
//! stop of PostgreSQL where the server keeps its rows there.

use crate::harness::{Server, in_states, tasks, until};
use crate::robots::{Robots, with_robots};
use midshift_agent::ledger::Holder;
use midshift_cli::task_list::request;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::task::v1::{SubmitTasksRequest, Task, TaskState};
use midshift_sim::judge::Judge;
use midshift_sim::workload::{Workload, WorkloadConfig};
use midshift_tests::postgres::PostgresServer;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::Duration;

const ROBOTS: usize = 20;
/// Tasks of one run.
pub const TASKS: usize = 80;

async fn done_and_running(server: SocketAddr) -> anyhow::Result<Option<(usize, Vec<Task>)>> {
    let done = in_states(server, &[TaskState::Succeeded]).await?;
    let running = in_states(server, &[TaskState::Running]).await?;
    Ok(done.zip(running).map(|(done, running)| (done.len(), running)))
}

/// Waits until so many tasks are done and others are at work at robots that were not killed.
pub async fn at_work(server: SocketAddr, done: usize, killed: &BTreeSet<String>) -> anyhow::Result<Vec<Task>> {
    until(&format!("{done} tasks done and others at work"), Duration::from_secs(120), || async {
        let Some((n, mut running)) = done_and_running(server).await? else { return Ok(None) };
        running.retain(|task| !killed.contains(&task.robot_id));
        Ok((n >= done && running.len() >= 3).then_some(running))
    })
    .await
}

/// Kills an agent that was not killed before and starts it again; what it held, by its own ledger. Again with another one if it had
/// just finished.
async fn kill_one_at_work(
    server: &Server,
    robots: &mut Robots,
    done: usize,
    killed: &mut BTreeSet<String>,
    rng: &mut StdRng,
) -> anyhow::Result<Holder> {
    loop {
        let running = at_work(server.address, done, killed).await?;
        let Some(task) = running.choose(rng) else { anyhow::bail!("nothing is at work") };
        let id = task.robot_id.clone();
        robots.kill(&id)?;
        killed.insert(id.clone());
        let holder = robots.ledger(&id).await?.holder;
        robots.restart(&id)?;
        if let Some(holder) = holder.filter(|h| h.attempt.subject.task_id().is_some()) {
            return Ok(holder);
        }
        say!("{id} held no task when it was killed");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_lost_and_nothing_done_twice_when_server_and_agents_are_killed_at_work() -> anyhow::Result<()> {
    killed_at_work(None).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_lost_and_nothing_done_twice_on_postgresql_which_ends_at_once_as_well() -> anyhow::Result<()> {
    killed_at_work(Some(PostgresServer::start())).await
}

async fn killed_at_work(mut postgres: Option<PostgresServer>) -> anyhow::Result<()> {
    let seed: u64 = std::env::var("MIDSHIFT_SEED").ok().and_then(|s| s.parse().ok()).unwrap_or(20_261_120);
    let mut rng = StdRng::seed_from_u64(seed);
    let dir = tempfile::tempdir()?;
    let site = with_robots(DEMO, ROBOTS)?;
    let url = postgres.as_ref().map(PostgresServer::database);
    let flags: Vec<&str> = url.iter().flat_map(|url| ["--store", url.as_str()]).collect();
    let mut server = Server::start_with(dir.path(), &text::render(&site), &flags).await?;
    let mut robots = Robots::start(dir.path(), server.address, server.address, &site).await?;
    submit(server.address, &site, seed, TASKS).await?;
    let mut kills: Vec<(usize, bool)> =
        [(8, true), (16, false), (24, false), (32, true), (40, false), (48, false), (56, true), (62, false)]
            .into_iter()
            .map(|(at, of_server)| (at + rng.random_range(0..6), of_server))
            .collect();
    kills.sort_unstable();
    // Tasks whose agent died inside a step that must not be done twice: for those a person may be asked.
    let mut inside = BTreeSet::new();
    let (mut killed, mut hits) = (BTreeSet::new(), 0);
    for (kill, (at, of_server)) in kills.into_iter().enumerate() {
        if let Some(postgres) = postgres.as_mut().filter(|_| kill == 4) {
            say!("seed {seed}: PostgreSQL ends at once, and starts again");
            tokio::task::block_in_place(|| {
                postgres.cut();
                postgres.start_again();
            });
        }
        if of_server {
            let running = at_work(server.address, at, &BTreeSet::new()).await?;
            say!("seed {seed}: kill -9 of the server with {at} done and {} at work", running.len());
            server.kill_and_restart().await?;
            continue;
        }
        let held = kill_one_at_work(&server, &mut robots, at, &mut killed, &mut rng).await?;
        hits += 1;
        say!(
            "seed {seed}: kill -9 of an agent with {at} done, {} at step {}, {:?}",
            held.attempt,
            held.step,
            held.intent
        );
        if let Some(task_id) = held.attempt.subject.task_id().filter(|_| held.intent.is_some()) {
            inside.insert(task_id.to_string());
        }
    }
    assert_eq!(hits, 5, "agents killed at work; {killed:?}");
    let ended = all_over(server.address, TASKS).await?;
    judge(&ended, &inside, &site, &robots)?;
    judge_ledgers(&ended, robots).await
}

/// Waits for the end of every one of `count` tasks.
pub async fn all_over(server: SocketAddr, count: usize) -> anyhow::Result<Vec<Task>> {
    let over =
        [TaskState::Succeeded, TaskState::Failed, TaskState::Canceled, TaskState::Expired, TaskState::NeedsOperator];
    let ended = until("the end of every task", Duration::from_secs(240), || async {
        Ok(in_states(server, &over).await?.filter(|tasks| tasks.len() == count))
    })
    .await;
    if ended.is_err() {
        let open = [
            TaskState::Queued,
            TaskState::Assigned,
            TaskState::Running,
            TaskState::Held,
            TaskState::Stopping,
            TaskState::RetryWait,
        ];
        for task in in_states(server, &open).await?.unwrap_or_default() {
            say!("open: {} {:?} {} {:?}", task.task_id, task.state(), task.robot_id, task.attempt);
        }
    }
    ended
}

/// Every robot's own memory: a task that succeeded was finished by one robot, once.
pub async fn judge_ledgers(tasks: &[Task], mut robots: Robots) -> anyhow::Result<()> {
    let mut finished: BTreeMap<String, Vec<String>> = BTreeMap::new();
    robots.kill_all()?;
    for id in robots.ids() {
        let ledger = robots.ledger(&id).await?;
        let done = ledger.subjects().keys().filter(|subject| ledger.finished(subject).is_some());
        for task_id in done.filter_map(|subject| subject.task_id()) {
            finished.entry(task_id.to_string()).or_default().push(id.clone());
        }
    }
    for task in tasks {
        let by = finished.get(&task.task_id).map_or(0, Vec::len);
        let wanted = usize::from(task.state() == TaskState::Succeeded);
        assert_eq!(
            by,
            wanted,
            "{} ended {:?}, finished by {:?}",
            task.task_id,
            task.state(),
            finished.get(&task.task_id)
        );
    }
    Ok(())
}

/// Submits `count` tasks between stations.
pub async fn submit(server: SocketAddr, site: &Site, seed: u64, count: usize) -> anyhow::Result<()> {
    let mut workload =
        Workload::new(WorkloadConfig::background(seed), site).ok_or_else(|| anyhow::anyhow!("no stations"))?;
    let items: Vec<SubmitTasksRequest> = (0..count)
        .map(|i| {
            let mut item = request(&workload.next_transport());
            item.request_id = format!("{seed}-{i}");
            SubmitTasksRequest { item: Some(item) }
        })
        .collect();
    // As a client with retries does it: each has a request_id.
    let answer = until("an answer to the submission", Duration::from_secs(60), || async {
        let answer = tasks(server)?.submit_tasks(tokio_stream::iter(items.clone())).await;
        Ok(answer.ok().map(tonic::Response::into_inner))
    })
    .await?;
    anyhow::ensure!(answer.results.len() == count, "{} of {count} answered", answer.results.len());
    Ok(())
}

/// Held against the journals of the bodies: nothing is lost, nothing was done twice; only what was killed `inside` a step may need a person.
pub fn judge(tasks: &[Task], inside: &BTreeSet<String>, site: &Site, robots: &Robots) -> anyhow::Result<()> {
    judge_journals(tasks, inside, site, &robots.journals())
}

/// The same, of robots with these journals.
pub fn judge_journals(tasks: &[Task], inside: &BTreeSet<String>, site: &Site, paths: &[PathBuf]) -> anyhow::Result<()> {
    let succeeded = tasks.iter().filter(|t| t.state() == TaskState::Succeeded).count();
    judge_each(tasks, inside, site, paths)?;
    assert!(succeeded * 100 >= tasks.len() * 95, "{succeeded} of {} succeeded", tasks.len());
    Ok(())
}

/// The same of each task, however many were killed `inside` a step.
pub fn judge_each(tasks: &[Task], inside: &BTreeSet<String>, site: &Site, paths: &[PathBuf]) -> anyhow::Result<()> {
    let others: Vec<_> = tasks.iter().filter(|t| t.state() != TaskState::Succeeded).collect();
    for task in &others {
        say!("{} ended {:?}: {:?}", task.task_id, task.state(), task.reason);
    }
    for task in &others {
        assert_eq!(task.state(), TaskState::NeedsOperator, "{}", task.task_id);
        assert!(
            inside.contains(&task.task_id),
            "{} needs an operator and no agent was killed inside its step",
            task.task_id
        );
    }
    let paths: Vec<&Path> = paths.iter().map(PathBuf::as_path).collect();
    let oracle = Judge::read(site, paths)?;
    let verdict = oracle.verdict();
    say!("{verdict:?}");
    // A task may carry what an earlier one put down, so items are fewer than tasks; drops are not.
    let drops = oracle.drops_by_task();
    for task in tasks.iter().filter(|t| t.state() == TaskState::Succeeded) {
        let dropped = drops.iter().find(|(id, _)| id.as_str() == task.task_id).map(|(_, times)| *times);
        assert_eq!(dropped, Some(1), "the journals show how often {} was put down", task.task_id);
    }
    assert!(verdict.items_conserved(), "{verdict:?}");
    assert_eq!(verdict.steps_done_twice, 0, "{verdict:?}");
    assert_eq!(verdict.exclusion_violations, 0, "{verdict:?}");
    Ok(())
}
