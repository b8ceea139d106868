//! A stop service by itself: it works when nobody takes what it says, and `serve` has it there again when it is gone.

use crate::harness::{Running, folder, free_port, midshift, until};
use anyhow::{Context, ensure};
use midshift_core::site::DEMO;
use midshift_proto::stop::v1;
use midshift_proto::stop::v1::scope::Scope as W;
use midshift_proto::stop::v1::stop_link_service_client::StopLinkServiceClient;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::Path;
use std::process::Command;
use std::time::Duration;
use tokio_stream::StreamExt;
use tonic::transport::Channel;

const LIMIT: Duration = Duration::from_secs(60);

/// A way to it, when there is one.
async fn way(address: SocketAddr) -> anyhow::Result<Channel> {
    until("the stop service", LIMIT, async || {
        Ok(Channel::from_shared(format!("http://{address}"))?.connect().await.ok())
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_service_whose_log_takes_nothing_engages_tells_and_resets() -> anyhow::Result<()> {
    let dir = folder()?;
    let address = free_port()?;
    let mut command = Command::new("sh");
    command.args(["-c", "exec \"$0\" \"$@\" 2>/dev/full"]).arg(midshift()?).env("MIDSHIFT_LOG", "debug");
    command.args(["stop", "serve", "--insecure", "--listen", &address.to_string(), "--data"]).arg(dir.path());
    let mut running = Running::start(&mut command, &dir.path().join("said.log"))?;
    let channel = way(address).await?;
    let attend = v1::Attend { robot_id: "r1".to_owned(), boot_id: "b".to_owned(), ..v1::Attend::default() };
    let first = v1::AttendRequest { message: Some(v1::attend_request::Message::Attend(attend)) };
    let up = tokio_stream::once(first).chain(tokio_stream::pending());
    let mut line = StopLinkServiceClient::new(channel.clone()).attend(up).await?.into_inner();
    let mut people = StopServiceClient::new(channel);
    let scope = Some(v1::Scope { scope: Some(W::Fleet(v1::Fleet {})) });
    let mut engaged = people.engage(v1::EngageRequest { scope, ..v1::EngageRequest::default() }).await?.into_inner();
    let engaged = engaged.message().await?.context("an answer")?;
    ensure!(engaged.durable, "{engaged:?}");
    let stop_id = engaged.stop.context("a stop")?.stop_id;
    let request = v1::ResetRequest { stop_id: stop_id.clone(), reason: "all clear".to_owned() };
    ensure!(people.reset(request).await?.into_inner().was_engaged, "it was not engaged");
    let (mut is_engaged, mut is_reset) = (false, false);
    while !is_reset {
        let message = tokio::time::timeout(LIMIT, line.message()).await??.context("the line goes on")?;
        if let Some(v1::attend_response::Message::Told(told)) = message.message {
            is_engaged |= told.stops.iter().any(|stop| stop.stop_id == stop_id);
            is_reset |= told.resets.iter().any(|reset| reset.stop_id == stop_id);
        }
    }
    ensure!(is_engaged && !running.has_ended()?, "it was told of the reset alone, or the service is gone");
    Ok(())
}

/// The stop services that a server has started, by process; killed when the test lets them go: they outlive the server.
struct Children<'a>(&'a Path);

impl Children<'_> {
    fn all(&self) -> BTreeSet<u32> {
        let said = std::fs::read_to_string(self.0).unwrap_or_default();
        let started = said.lines().filter(|line| line.contains("a stop service was started"));
        let named = started.filter_map(|line| line.split("process=").nth(1)?.split_whitespace().next()?.parse().ok());
        named.collect()
    }
    async fn next(&self, before: &BTreeSet<u32>) -> anyhow::Result<u32> {
        until("one more stop service", LIMIT, async || Ok(self.all().difference(before).next().copied())).await
    }
}

fn signal(name: &str, process: u32) -> anyhow::Result<()> {
    let sent = Command::new("kill").args(["-s", name, &process.to_string()]).output()?;
    ensure!(sent.status.success(), "kill -s {name} {process}: {}", sent.status);
    Ok(())
}

impl Drop for Children<'_> {
    fn drop(&mut self) {
        // Those that the test has ended are gone.
        self.all().into_iter().for_each(|process| drop(signal("KILL", process)));
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn serve_starts_the_stop_service_again_however_it_ended_and_what_it_said_is_in_its_folder() -> anyhow::Result<()>
{
    let dir = folder()?;
    std::fs::write(dir.path().join("site.toml"), DEMO)?;
    let (address, stop_address) = (free_port()?.to_string(), free_port()?);
    let log = dir.path().join("server.log");
    let mut command = Command::new(midshift()?);
    command.env("NO_COLOR", "1").args(["serve", "--insecure", "--data"]).arg(dir.path().join("data"));
    command.arg("--site").arg(dir.path().join("site.toml"));
    command.args(["--listen", &address, "--stop-listen", &stop_address.to_string()]);
    let children = Children(&log);
    let _running = Running::start(&mut command, &log)?;
    let mut known = BTreeSet::new();
    for name in ["KILL", "TERM"] {
        let process = children.next(&known).await?;
        known.insert(process);
        way(stop_address).await?;
        signal(name, process)?;
    }
    children.next(&known).await?;
    let status = StopServiceClient::new(way(stop_address).await?).get_status(v1::GetStatusRequest {}).await;
    ensure!(status.is_ok(), "{status:?}");
    let said = std::fs::read_to_string(dir.path().join("data/stop/log"))?;
    ensure!(said.matches("stop service opened").count() == 3, "{said}");
    ensure!(
        !std::fs::read_to_string(&log)?.contains("stop service opened"),
        "it does not depend on the server's own log"
    );
    Ok(())
}
