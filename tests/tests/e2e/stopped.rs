//! A fleet stop with real programs: everybody stands, the server dead or not, its database there or not, and nobody moves before a person has reset and resumed
//! it.

use crate::harness::{
    Running, Server, channel, folder, free_port, has_login, in_states, midshift_stop, same_site, until,
};
use crate::kill::{all_over, at_work, judge, submit};
use crate::robots::{Robots, with_robots};
use crate::rolled_out::{call, done};
use crate::secrets::keep_from_logs;
use anyhow::{Context, ensure};
use midshift_core::reason::Code;
use midshift_core::robot::StopLevel;
use midshift_core::site::{DEMO, Site, text};
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{ExplainTaskRequest, GetRobotControlRequest};
use midshift_proto::stop::v1::GetStatusRequest;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_sim::journal::{self, Effect};
use midshift_tests::postgres::PostgresServer;
use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

const ROBOTS: usize = 8;
const TASKS: usize = 20;
/// Why somebody stops, which is nothing for a log.
const REASON: &str = "somebody fell beside dock seven";
const LIMIT: Duration = Duration::from_secs(60);

/// A stop service in a process of its own, beside a server's data.
pub struct StopServer {
    /// Where it listens.
    pub address: SocketAddr,
    dir: PathBuf,
    running: Running,
}

impl StopServer {
    /// On the site of the server at `beside` in `dir`.
    pub async fn start(dir: &Path, beside: SocketAddr) -> anyhow::Result<Self> {
        let address = free_port()?;
        same_site(beside, address)?;
        let server = Self { address, dir: dir.to_owned(), running: Self::run(dir, address)? };
        server.answers().await?;
        Ok(server)
    }
    fn run(dir: &Path, address: SocketAddr) -> anyhow::Result<Running> {
        let mut command = Command::new(midshift_stop()?);
        command.args(["--listen", &address.to_string(), "--data"]).arg(dir.join("data"));
        if !has_login(address) {
            command.arg("--insecure");
        }
        Running::start(command.arg("--site").arg(dir.join("site.toml")), &dir.join("stop.log"))
    }
    /// Ends it by SIGKILL.
    pub fn kill(&mut self) -> anyhow::Result<()> {
        self.running.kill()
    }
    /// A new start after a kill, with whatever lies in the data directory now.
    pub async fn restart(&mut self) -> anyhow::Result<()> {
        self.running = Self::run(&self.dir, self.address)?;
        self.answers().await
    }
    async fn answers(&self) -> anyhow::Result<()> {
        until("the stop service's first answer", LIMIT, async || Ok(self.engaged().await.ok().map(drop))).await
    }
    /// Names of what is engaged.
    pub async fn engaged(&self) -> anyhow::Result<Vec<String>> {
        let mut client = StopServiceClient::new(channel(self.address)?);
        let status = client.get_status(GetStatusRequest {}).await?.into_inner().status.unwrap_or_default();
        Ok(status.stops.into_iter().filter_map(|engaged| engaged.stop).map(|stop| stop.stop_id).collect())
    }
    /// Stops by the command line, which waits until all have confirmed; the stop's name.
    pub fn stop(&self, whom: &[&str]) -> anyhow::Result<String> {
        keep_from_logs("why somebody stopped", REASON);
        let address = self.address.to_string();
        let stop = ["stop", "--stop-server", &address, "--reason", REASON, "-o", "name"];
        let output = tokio::task::block_in_place(|| call(&[&stop[..], whom].concat()))?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        ensure!(output.status.success(), "{whom:?}: {:?} {said}", output.status.code());
        say!("{whom:?}: {said}");
        Ok(String::from_utf8(output.stdout)?.trim().to_owned())
    }
    /// Resets a stop by the command line.
    pub fn reset(&self, stop_id: &str) -> anyhow::Result<()> {
        let address = self.address.to_string();
        done(&["stop", "reset", "--stop-server", &address, stop_id, "--reason", "all clear"])
    }
}

/// Waits until fleet holds these robots by this token.
pub async fn until_held(server: SocketAddr, robots: &[String], token: &str) -> anyhow::Result<()> {
    until(&format!("{token} on {robots:?}"), LIMIT, async || {
        let mut client = FleetServiceClient::new(channel(server)?);
        for robot_id in robots.iter().cloned() {
            let Ok(answer) = client.get_robot_control(GetRobotControlRequest { robot_id }).await else {
                return Ok(None);
            };
            let control = answer.into_inner().control.unwrap_or_default();
            if !control.hold_tokens.iter().any(|held| held == token) {
                return Ok(None);
            }
        }
        Ok(Some(()))
    })
    .await
}

/// What the bodies wrote while they obeyed a stop: each stood at its start and for a stop, and none moved before it was released.
pub fn judge_stops(journals: Vec<PathBuf>) -> anyhow::Result<()> {
    let (mut stood, least) = (0, 2 * journals.len());
    for path in journals {
        let (mut is_stopped, mut stands_at) = (false, None);
        for entry in journal::read(&path)? {
            match entry.effect {
                Effect::Obeys { level, odometer_mm } => {
                    if let Some(at) = stands_at.take() {
                        ensure!(
                            odometer_mm == at,
                            "{}: it drove while it was stopped: {at} to {odometer_mm}",
                            path.display()
                        );
                    }
                    is_stopped = level >= StopLevel::Halt;
                }
                Effect::Stood { odometer_mm } => {
                    stood += 1;
                    stands_at = Some(odometer_mm);
                }
                Effect::Moved { odometer_mm } => {
                    ensure!(!is_stopped, "{}: it moved at {odometer_mm} while it was stopped", path.display());
                }
                _ => {}
            }
        }
    }
    ensure!(stood >= least, "each robot stood at its start and for a stop: {stood} of {least}");
    Ok(())
}

/// Resumes by the command line whatever one stop stood.
pub fn resume(server: &Server, stop_id: &str) -> anyhow::Result<()> {
    let address = server.address.to_string();
    done(&["resume", "--server", &address, "--stop", stop_id, "--reason", "all clear"])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stopped_fleet_stands_through_every_kill_until_it_is_reset_and_resumed() -> anyhow::Result<()> {
    let dir = folder()?;
    let site: Site = with_robots(DEMO, ROBOTS)?;
    let mut server = Server::start_for(dir.path(), &site).await?;
    let mut stops = StopServer::start(dir.path(), server.address).await?;
    let (address, stop_address) = (server.address, Some(stops.address));
    let robots = Robots::start_beside(dir.path(), address, address, stop_address, &site).await?;
    submit(address, &site, 7, TASKS).await?;
    at_work(address, 8, &BTreeSet::new()).await?;

    let first = stops.stop(&["--all"])?;
    until_held(address, &robots.ids(), &format!("stop:{first}")).await?;
    server.kill()?;
    let second = stops.stop(&["--robot", "rbt-01", "--level", "posture"])?;
    stops.kill()?;
    stops.restart().await?;
    let engaged = stops.engaged().await?;
    ensure!(engaged == [first.clone(), second.clone()], "after kill -9 it knows of {engaged:?}");
    stops.reset(&second)?;
    stops.reset(&first)?;
    server.restart().await?;
    until_held(address, &robots.ids(), &format!("resume:{first}")).await?;
    until_held(address, &["rbt-01".to_owned()], &format!("resume:{second}")).await?;
    resume(&server, &first)?;
    resume(&server, &second)?;

    let ended = all_over(address, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    judge_stops(robots.journals())?;
    let data = dir.path().join("data").display().to_string();
    done(&["stop", "verify", "--data", &data]).context("the audit of stops")
}

/// How often work of each task was given.
async fn epochs(server: SocketAddr) -> anyhow::Result<Option<BTreeMap<String, u64>>> {
    let all = in_states(server, &[]).await?;
    Ok(all.map(|tasks| tasks.into_iter().map(|task| (task.task_id, task.epoch)).collect()))
}

/// Waits until fleet says of this task that a stop is why it waits.
async fn until_kept_from_work(server: SocketAddr, task_id: &str) -> anyhow::Result<()> {
    until(&format!("{task_id} waits for a stop"), LIMIT, async || {
        let request = ExplainTaskRequest { task_id: task_id.to_owned() };
        let Ok(answer) = FleetServiceClient::new(channel(server)?).explain_task(request).await else { return Ok(None) };
        let explanation = answer.into_inner().explanation.unwrap_or_default();
        let free = explanation.candidates.iter().filter(|candidate| candidate.reason.is_none()).count();
        let stopped = explanation.filtered.iter().any(|filter| filter.code == Code::StopEngaged.as_str());
        Ok((free == 0 && stopped).then_some(()))
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_is_engaged_while_the_database_is_gone_is_recorded_and_holds_when_it_is_back() -> anyhow::Result<()>
{
    let dir = folder()?;
    let site: Site = with_robots(DEMO, ROBOTS)?;
    let mut postgres = PostgresServer::start();
    let url = postgres.database();
    let server = Server::start_with(dir.path(), &text::render(&site), &["--store", &url]).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let address = server.address;
    let robots = Robots::start_beside(dir.path(), address, address, Some(stops.address), &site).await?;
    submit(address, &site, 7, TASKS).await?;
    at_work(address, 4, &BTreeSet::new()).await?;

    tokio::task::block_in_place(|| postgres.cut());
    // It comes back with success: every robot has confirmed that it stands.
    let stop_id = stops.stop(&["--all"])?;
    let audit = std::fs::read_to_string(dir.path().join("data/stop/audit.jsonl"))?;
    let is_engaged = |line: &str| line.contains("ENGAGED") && line.contains(&stop_id);
    ensure!(audit.lines().any(is_engaged), "the audit of stops says nothing of {stop_id}: {audit}");
    tokio::task::block_in_place(|| postgres.start_again());

    until_held(address, &robots.ids(), &format!("stop:{stop_id}")).await?;
    let recorded = format!("SELECT count(*) FROM control.stop_record WHERE id = '{stop_id}'");
    until("the record of the stop", LIMIT, async || {
        let found = tokio::task::block_in_place(|| postgres.ask(&url, &recorded));
        Ok((found == "1").then_some(()))
    })
    .await?;
    let listed = ["audit", "ls", "--server", &address.to_string(), "--service", "stop", "--action", "stop.engage"];
    let listed = call(&[&listed[..], &["-o", "json"]].concat())?;
    let listed = String::from_utf8(listed.stdout)?;
    ensure!(listed.contains(&stop_id), "the audit of the site says nothing of {stop_id}: {listed}");
    done(&["audit", "verify", "--server", &address.to_string()]).context("the audit of the site")?;
    let before = until("all tasks", LIMIT, || epochs(address)).await?;
    let new = ["task", "submit", "--server", &address.to_string(), "--from", "A01", "--to", "B03", "--sku", "SKU-1"];
    done(&[&new[..], &["--task-id", "AFTER"]].concat())?;
    until_kept_from_work(address, "AFTER").await?;
    let after = until("all tasks", LIMIT, || epochs(address)).await?;
    ensure!(after.get("AFTER") == Some(&0), "it was given to a robot: {after:?}");
    ensure!(before.iter().all(|(task, epoch)| after.get(task) == Some(epoch)), "given again: {before:?} {after:?}");

    stops.reset(&stop_id)?;
    until_held(address, &robots.ids(), &format!("resume:{stop_id}")).await?;
    resume(&server, &stop_id)?;
    let ended = all_over(address, TASKS + 1).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    judge_stops(robots.journals())?;
    let data = dir.path().join("data").display().to_string();
    done(&["stop", "verify", "--data", &data]).context("the audit of stops")
}
