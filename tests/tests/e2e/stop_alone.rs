//! A stop service by itself: it works when nobody takes what it says, the next one is there before it ends, and `serve` has it there again when it is gone.

use crate::harness::{Running, channel, folder, free_port, midshift, midshift_stop, same_site, sign_in_to, until};
use crate::rolled_out::call;
use anyhow::{Context, ensure};
use midshift_core::reason::Code;
use midshift_core::site::DEMO;
use midshift_proto::fleet::v1::ListIncidentsRequest;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::collections::BTreeSet;
use std::fs::Permissions;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::Duration;
use tokio::net::TcpStream;
use tokio_stream::StreamExt;
use tokio_util::sync::CancellationToken;
use tonic::Streaming;
use tonic::transport::Channel;

const LIMIT: Duration = Duration::from_secs(60);

/// A way to it, when there is one.
pub async fn way(address: SocketAddr) -> anyhow::Result<Channel> {
    until("the stop service", LIMIT, async || {
        Ok(Channel::from_shared(format!("http://{address}"))?.connect().await.ok())
    })
    .await
}

/// A robot's line.
async fn attend(channel: Channel) -> anyhow::Result<Streaming<v1::AttendResponse>> {
    let attend = v1::Attend { robot_id: "r1".to_owned(), boot_id: "b".to_owned(), ..v1::Attend::default() };
    let first = v1::AttendRequest { message: Some(v1::attend_request::Message::Attend(attend)) };
    let up = tokio_stream::once(first).chain(tokio_stream::pending());
    Ok(StopLinkServiceClient::new(channel).attend(up).await?.into_inner())
}

/// Stops the fleet, durably. Its id.
async fn engage(people: &mut StopServiceClient<Channel>) -> anyhow::Result<String> {
    let scope = Some(v1::Scope { scope: Some(W::Fleet(v1::Fleet {})) });
    let mut engaged = people.engage(v1::EngageRequest { scope, ..v1::EngageRequest::default() }).await?.into_inner();
    let engaged = engaged.message().await?.context("an answer")?;
    ensure!(engaged.durable, "{engaged:?}");
    Ok(engaged.stop.context("a stop")?.stop_id)
}

async fn reset(people: &mut StopServiceClient<Channel>, stop_id: &str) -> anyhow::Result<()> {
    let request =
        v1::ResetRequest { stop_id: stop_id.to_owned(), reason: "all clear".to_owned(), site_id: String::new() };
    ensure!(people.reset(request).await?.into_inner().was_engaged, "it was not engaged");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_service_whose_log_takes_nothing_engages_tells_and_resets() -> anyhow::Result<()> {
    let dir = folder()?;
    let address = free_port()?;
    let mut command = Command::new("sh");
    command.args(["-c", "exec \"$0\" \"$@\" 2>/dev/full"]).arg(midshift_stop()?).env("MIDSHIFT_LOG", "debug");
    command.args(["--insecure", "--listen", &address.to_string(), "--data"]).arg(dir.path());
    let mut running = Running::start(&mut command, &dir.path().join("said.log"))?;
    let channel = way(address).await?;
    let mut line = attend(channel.clone()).await?;
    let mut people = StopServiceClient::new(channel);
    let stop_id = engage(&mut people).await?;
    reset(&mut people, &stop_id).await?;
    let (mut is_engaged, mut is_reset) = (false, false);
    while !is_reset {
        let message = tokio::time::timeout(LIMIT, line.message()).await??.context("the line goes on")?;
        if let Some(v1::attend_response::Message::Facts(facts)) = message.message {
            is_engaged |= facts.stops.iter().any(|stop| stop.stop_id == stop_id);
            is_reset |= facts.resets.iter().any(|reset| reset.stop_id == stop_id);
        }
    }
    ensure!(is_engaged && !running.has_ended()?, "it was told of the reset alone, or the service is gone");
    Ok(())
}

/// Processes of stop services that were started by a server or by one before them, as these logs tell; killed when the test lets them go: they outlive both.
pub struct Children(Vec<PathBuf>);

/// What is said of each of them.
const STARTED: &str = "a stop service was started";
const READY: &str = "the next stop service is ready";

impl Children {
    fn all(&self, words: &str) -> BTreeSet<u32> {
        let said: String = self.0.iter().map(|log| std::fs::read_to_string(log).unwrap_or_default()).collect();
        let started = said.lines().filter(|line| line.contains(words));
        let named = started.filter_map(|line| line.split("process=").nth(1)?.split_whitespace().next()?.parse().ok());
        named.collect()
    }
    async fn next(&self, words: &str, before: &BTreeSet<u32>) -> anyhow::Result<u32> {
        until("one more stop service", LIMIT, async || Ok(self.all(words).difference(before).next().copied())).await
    }
}

/// Waits until something stands in a log.
async fn says(log: &Path, words: &str) -> anyhow::Result<()> {
    until(words, LIMIT, async || Ok(std::fs::read_to_string(log)?.contains(words).then_some(()))).await
}

fn signal(name: &str, process: u32) -> anyhow::Result<()> {
    let sent = Command::new("kill").args(["-s", name, &process.to_string()]).output()?;
    ensure!(sent.status.success(), "kill -s {name} {process}: {}", sent.status);
    Ok(())
}

impl Drop for Children {
    fn drop(&mut self) {
        // Those that the test has ended are gone.
        [STARTED, READY].iter().flat_map(|words| self.all(words)).for_each(|process| drop(signal("KILL", process)));
    }
}

/// A stop service of this site, whose log tells processes.
pub fn stop_service(dir: &Path, address: SocketAddr) -> anyhow::Result<(Running, Children)> {
    let mut command = Command::new(midshift_stop()?);
    command.args(["--insecure"]);
    started(command, dir, address)
}

/// The same by a command that becomes one.
fn started(mut command: Command, dir: &Path, address: SocketAddr) -> anyhow::Result<(Running, Children)> {
    std::fs::write(dir.join("site.toml"), DEMO)?;
    let log = dir.join("stop.log");
    command.env("NO_COLOR", "1").args(["--listen", &address.to_string(), "--data"]);
    command.arg(dir.join("data")).arg("--site").arg(dir.join("site.toml"));
    Ok((Running::start(&mut command, &log)?, Children(vec![log])))
}

/// Dials as often as robots of a large site would. How often.
async fn dial_until(is_over: CancellationToken, address: SocketAddr) -> io::Result<u32> {
    let (mut each, mut dialed) = (tokio::time::interval(Duration::from_millis(2)), 0);
    while !is_over.is_cancelled() {
        each.tick().await;
        TcpStream::connect(address).await?;
        dialed += 1;
    }
    Ok(dialed)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_next_stop_service_takes_over_port_and_stops_and_nobody_who_dials_is_refused() -> anyhow::Result<()> {
    let (dir, address) = (folder()?, free_port()?);
    let (mut running, children) = stop_service(dir.path(), address)?;
    let channel = way(address).await?;
    let mut line = attend(channel.clone()).await?;
    let stop_id = engage(&mut StopServiceClient::new(channel)).await?;
    let is_over = CancellationToken::new();
    let dialing = tokio::spawn(dial_until(is_over.clone(), address));
    // Somebody stops all the while, by one or the other.
    let mut stopping = Command::new(midshift()?);
    stopping.args(["stop", "--all", "--reason", "in between", "--no-wait", "-o", "name", "--stop-server"]);
    stopping.arg(address.to_string()).env("MIDSHIFT_CONTEXTS", dir.path().join("nobody"));
    let stopped = thread::spawn(move || (0..8).map(|_| stopping.output()).collect::<Vec<_>>());
    running.signal("USR2")?;
    children.next(READY, &BTreeSet::new()).await?;
    ensure!(running.ends().await? == Some(0), "the one before ends well");
    let mut is_moved = false;
    while let Some(message) = tokio::time::timeout(LIMIT, line.message()).await?.ok().flatten() {
        is_moved |= matches!(message.message, Some(v1::attend_response::Message::MoveOver(_)));
    }
    ensure!(is_moved, "robots are told to dial again");
    let mut people = StopServiceClient::new(way(address).await?);
    for output in stopped.join().ok().context("it panicked")? {
        let output = output?;
        let (id, said) = (String::from_utf8(output.stdout)?, String::from_utf8_lossy(&output.stderr));
        ensure!(output.status.success(), "{:?}: {said}", output.status);
        reset(&mut people, id.trim()).await.with_context(|| format!("{id}: {said}"))?;
    }
    is_over.cancel();
    ensure!(dialing.await?.context("somebody was refused")? > 0, "nobody dialed");
    reset(&mut people, &stop_id).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_next_stop_service_that_cannot_begin_leaves_the_one_that_runs_alone() -> anyhow::Result<()> {
    let (dir, address) = (folder()?, free_port()?);
    let (mut running, _children) = stop_service(dir.path(), address)?;
    let mut people = StopServiceClient::new(way(address).await?);
    std::fs::write(dir.path().join("site.toml"), "no site")?;
    running.signal("USR2")?;
    says(&dir.path().join("stop.log"), "this one goes on").await?;
    let stop_id = engage(&mut people).await?;
    ensure!(!running.has_ended()?, "it ended");
    // And it is asked again when that is mended.
    std::fs::write(dir.path().join("site.toml"), DEMO)?;
    running.signal("USR2")?;
    ensure!(running.ends().await? == Some(0), "the one before ends well");
    reset(&mut StopServiceClient::new(way(address).await?), &stop_id).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_service_that_was_started_as_midshift_stop_serve_is_followed_by_the_program_midshift_stop()
-> anyhow::Result<()> {
    let (dir, address) = (folder()?, free_port()?);
    // As one of before 0.2.0 starts the next one: its own program again, with its own arguments.
    let [before, then] = ["before", "then"].map(|name| dir.path().join(name));
    for (program, words) in [(&before, ""), (&then, "stop serve ")] {
        std::fs::write(program, format!("#!/bin/sh\nexec '{}' {words}\"$@\"\n", midshift()?.display()))?;
        std::fs::set_permissions(program, Permissions::from_mode(0o755))?;
    }
    let mut command = Command::new(midshift_stop()?);
    command.arg0(&before).args(["--insecure"]);
    let (mut running, _children) = started(command, dir.path(), address)?;
    let stop_id = engage(&mut StopServiceClient::new(way(address).await?)).await?;
    running.signal("USR2")?;
    says(&dir.path().join("stop.log"), "this one goes on").await?;
    ensure!(!running.has_ended()?, "arguments of another program are no reason to end");
    std::fs::rename(&then, &before)?;
    running.signal("USR2")?;
    ensure!(running.ends().await? == Some(0), "the one before ends well");
    reset(&mut StopServiceClient::new(way(address).await?), &stop_id).await
}

/// A `serve` of the demo site in `dir` with a stop service beside it.
fn serving(dir: &Path, address: SocketAddr, stop_address: SocketAddr) -> anyhow::Result<Command> {
    std::fs::write(dir.join("site.toml"), DEMO)?;
    let mut command = Command::new(midshift()?);
    command.env("NO_COLOR", "1").args(["serve", "--data"]).arg(dir.join("data"));
    command.arg("--site").arg(dir.join("site.toml")).arg("--first-token-file").arg(dir.join("token"));
    command.args(["--listen", &address.to_string(), "--stop-listen", &stop_address.to_string()]);
    Ok(command)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn serve_starts_the_stop_service_again_unless_a_next_one_is_there_and_what_it_said_is_in_its_folder()
-> anyhow::Result<()> {
    let dir = folder()?;
    let (address, stop_address) = (free_port()?, free_port()?);
    let (log, token) = (dir.path().join("server.log"), dir.path().join("token"));
    let mut command = serving(dir.path(), address, stop_address)?;
    let said = dir.path().join("data/stop/log");
    let children = Children(vec![log.clone(), said.clone()]);
    let mut running = Running::start(&mut command, &log)?;
    sign_in_to(address, dir.path().join("data/identity/ca.pem"), &token).await?;
    same_site(address, stop_address)?;
    let answers =
        || async { Ok(StopServiceClient::new(channel(stop_address)?).get_status(v1::GetStatusRequest {}).await.ok()) };
    let mut known = BTreeSet::new();
    for name in ["KILL", "TERM"] {
        let process = children.next(STARTED, &known).await?;
        known.insert(process);
        until("an answer", LIMIT, answers).await?;
        signal(name, process)?;
    }
    let third = children.next(STARTED, &known).await?;
    known.insert(third);
    until("an answer", LIMIT, answers).await?;
    signal("USR2", third)?;
    says(&log, "another stop service has taken the place").await?;
    let fourth = children.next(READY, &BTreeSet::new()).await?;
    ensure!(children.all(STARTED) == known, "one that has a next one is not started again");
    until("an answer", LIMIT, answers).await?;
    // A server that is killed leaves it alone, and the next one finds it and looks after it.
    running.kill()?;
    until("an answer", LIMIT, answers).await?;
    let _running = Running::start(&mut command, &log)?;
    says(&log, "a stop service answers already and is left alone").await?;
    signal("TERM", fourth)?;
    known.insert(children.next(STARTED, &known).await?);
    until("an answer", LIMIT, answers).await?;
    ensure!(known.len() == 4, "{known:?}");
    let said = std::fs::read_to_string(said)?;
    ensure!(said.matches("stop service opened").count() == 5, "{said}");
    ensure!(
        !std::fs::read_to_string(&log)?.contains("stop service opened"),
        "it does not depend on the server's own log"
    );
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_service_that_hangs_is_replaced_with_what_is_engaged_and_a_person_is_told_if_the_next_one_hangs_too()
-> anyhow::Result<()> {
    let dir = folder()?;
    let (address, stop_address) = (free_port()?, free_port()?);
    let (log, token) = (dir.path().join("server.log"), dir.path().join("token"));
    let mut command = serving(dir.path(), address, stop_address)?;
    let children = Children(vec![log.clone(), dir.path().join("data/stop/log")]);
    let _running = Running::start(&mut command, &log)?;
    sign_in_to(address, dir.path().join("data/identity/ca.pem"), &token).await?;
    same_site(address, stop_address)?;
    let first = children.next(STARTED, &BTreeSet::new()).await?;
    let at = stop_address.to_string();
    let printed = until("an answer", LIMIT, async || {
        let engage = ["stop", "--all", "--stop-server", &at, "--reason", "drill", "--no-wait", "-o", "name"];
        let printed = String::from_utf8(tokio::task::block_in_place(|| call(&engage))?.stdout)?;
        Ok((!printed.trim().is_empty()).then_some(printed))
    })
    .await?;
    let stop_id = printed.trim().to_owned();
    signal("STOP", first)?;
    let second = children.next(STARTED, &BTreeSet::from([first])).await?;
    says(&log, "its process is ended").await?;
    let engaged = until("an answer of the next one", LIMIT, async || {
        let asked = StopServiceClient::new(channel(stop_address)?).get_status(v1::GetStatusRequest {}).await.ok();
        Ok(asked.and_then(|answer| answer.into_inner().status))
    })
    .await?;
    let engaged: Vec<_> = engaged.stops.into_iter().filter_map(|engaged| Some(engaged.stop?.stop_id)).collect();
    ensure!(engaged == [stop_id.clone()], "{engaged:?}");
    // Within half a minute it is not ended once more.
    signal("STOP", second)?;
    until("the incident", LIMIT, async || {
        let mut client = FleetServiceClient::new(channel(address)?);
        let answer = client.list_incidents(ListIncidentsRequest::default()).await?.into_inner();
        let codes = answer.incidents.into_iter().filter_map(|incident| Some(incident.reason?.code));
        Ok(codes.into_iter().any(|code| code == Code::StopServiceHung.as_str()).then_some(()))
    })
    .await?;
    let known = BTreeSet::from([first, second]);
    ensure!(children.all(STARTED) == known, "{:?}", children.all(STARTED));
    signal("CONT", second)?;
    until("it to be reset", LIMIT, async || {
        let reset = ["stop", "reset", &stop_id, "--stop-server", &at, "--reason", "all clear"];
        Ok(tokio::task::block_in_place(|| call(&reset))?.status.success().then_some(()))
    })
    .await
}
