//! Which stop service `midshift stop` addresses, with two sites on one machine.

use crate::doors::TERMINAL;
use crate::harness::{Running, Server, authority, folder, free_port, midshift, midshift_stop, sign_in, token, tool};
use crate::secrets::heard;
use crate::stop_alone::way;
use crate::stopped::StopServer;
use anyhow::{Context, ensure};
use midshift_core::site::CORRIDOR;
use midshift_proto::stop::v1::GetStatusRequest;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::process::{Command, Output};

/// A file of contexts with one site in it: the server, root and token of `of`, and the stop service at `stops`.
fn remember(file: &Path, of: SocketAddr, stops: SocketAddr, site_id: &str) -> anyhow::Result<()> {
    let (root, token) = (std::fs::read_to_string(authority(of)?)?, token(of).context("a token")?);
    let text = format!(
        "current = \"it\"\n[context.it]\nserver = \"{of}\"\nstop_server = \"{stops}\"\nsite_id = \"{site_id}\"\ntoken = \"{token}\"\nauthority_pem = \"\"\"\n{root}\"\"\"\n"
    );
    Ok(std::fs::write(file, text)?)
}

/// `midshift stop` with these contexts, as a script has it.
fn stop(contexts: &Path, arguments: &[&str]) -> anyhow::Result<(Option<i32>, String)> {
    let mut command = Command::new(midshift()?);
    command.env("MIDSHIFT_CONTEXTS", contexts).arg("stop").args(arguments).args(["--reason", "drill"]);
    let Output { status, stderr, .. } = heard(&mut command)?;
    Ok((status.code(), String::from_utf8_lossy(&stderr).into_owned()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_is_meant_for_one_site_engages_nothing_at_another() -> anyhow::Result<()> {
    let (north, south) = (folder()?, folder()?);
    let meant = Server::start(north.path()).await?;
    let other = Server::start_on(south.path(), CORRIDOR).await?;
    let stops = StopServer::start(south.path(), other.address).await?;
    let contexts = north.path().join("contexts.toml");
    remember(&contexts, meant.address, stops.address, "demo")?;
    let (code, said) = stop(&contexts, &["--all", "--no-wait"])?;
    ensure!(code == Some(5) && said.contains("nothing was stopped"), "another root: {code:?} {said}");
    remember(&contexts, other.address, stops.address, "demo")?;
    let (code, said) = stop(&contexts, &["--all", "--no-wait"])?;
    ensure!(code == Some(9) && said.contains("of site corridor, not of demo"), "another site: {code:?} {said}");
    ensure!(stops.engaged().await?.is_empty(), "something is engaged");

    remember(&contexts, other.address, stops.address, "corridor")?;
    let (code, said) = stop(&contexts, &["--area", "nowhere"])?;
    ensure!(code == Some(4) && said.contains("no area nowhere; it has "), "{code:?} {said}");
    ensure!(stops.engaged().await?.is_empty(), "something is engaged");
    let (code, said) = stop(&contexts, &["--robot", "nobody"])?;
    ensure!(code == Some(13) && said.contains("no robot nobody is known"), "{code:?} {said}");
    ensure!(stops.engaged().await?.len() == 1, "an unknown robot is stopped all the same");
    Ok(())
}

#[tokio::test]
async fn a_script_that_nobody_tells_an_address_is_told_what_to_type() -> anyhow::Result<()> {
    let (dir, dead) = (folder()?, free_port()?);
    let (code, said) = stop(&dir.path().join("nobody"), &["--all", "--server", &dead.to_string()])?;
    ensure!(code == Some(2) && said.contains("the same with --stop-server 127.0.0.1:7421"), "{code:?} {said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_needs_no_word_of_a_server_that_hangs_or_is_gone() -> anyhow::Result<()> {
    let dir = folder()?;
    let mut server = Server::start_on(dir.path(), CORRIDOR).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let contexts = dir.path().join("contexts.toml");
    remember(&contexts, server.address, stops.address, "corridor")?;
    server.freeze()?;
    let (code, said) = stop(&contexts, &["--all", "--no-wait"])?;
    ensure!(code == Some(0), "the context knows it: {code:?} {said}");
    let signed_in = |named: &[&str]| {
        let mut command = Command::new(midshift()?);
        sign_in(&mut command, server.address);
        command.env("MIDSHIFT_CONTEXTS", dir.path().join("nobody"));
        heard(command.args(["stop", "--all", "--no-wait", "--reason", "drill", "--server"]).args(named))
    };
    let at = server.address.to_string();
    let refused = signed_in(&[&at])?;
    let said = String::from_utf8_lossy(&refused.stderr);
    ensure!(refused.status.code() == Some(2) && said.contains("the same with --stop-server"), "it hangs: {said}");
    ensure!(stops.engaged().await?.len() == 1, "a script that was refused has engaged nothing");
    let named = signed_in(&[&at, "--stop-server", &stops.address.to_string()])?;
    ensure!(named.status.success(), "the line it was told: {}", String::from_utf8_lossy(&named.stderr));
    ensure!(stops.engaged().await?.len() == 2, "it is engaged");
    server.kill()?;
    let (code, said) = stop(&contexts, &["--area", "hall", "--no-wait"])?;
    ensure!(code == Some(4) && said.contains("no area hall; it has "), "the stop service alone: {code:?} {said}");
    Ok(())
}

/// An address of this machine alone, whose usual port of a stop service no other test has.
fn own_host() -> Ipv4Addr {
    let [_, _, high, low] = std::process::id().to_be_bytes();
    Ipv4Addr::new(127, 77, high, low.max(1))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_person_at_a_terminal_is_shown_the_site_of_a_stop_service_that_stands_alone() -> anyhow::Result<()> {
    let (dir, host) = (folder()?, own_host());
    std::fs::write(dir.path().join("site.toml"), CORRIDOR)?;
    let address = SocketAddr::from((host, 7421));
    let mut service = Command::new(midshift_stop()?);
    service.args(["--insecure", "--listen", &address.to_string(), "--data"]).arg(dir.path());
    service.arg("--site").arg(dir.path().join("site.toml"));
    let _running = Running::start(&mut service, &dir.path().join("stop.log"))?;
    let mut people = StopServiceClient::new(way(address).await?);
    let mut engaged = async || -> anyhow::Result<usize> {
        Ok(people.get_status(GetStatusRequest {}).await?.into_inner().status.unwrap_or_default().stops.len())
    };
    let before = engaged().await?;
    let mut typed = Command::new(tool("MIDSHIFT_TEST_PYTHON")?);
    typed.env_remove("MIDSHIFT_TOKEN").env("MIDSHIFT_CONTEXTS", dir.path().join("nobody")).args(["-c", TERMINAL]);
    typed.arg(midshift()?).args(["stop", "--all", "--no-wait", "--reason", "drill"]);
    typed.args(["--server", &SocketAddr::from((host, 7420)).to_string()]);
    let output = heard(&mut typed)?;
    let shown = String::from_utf8_lossy(&output.stdout).into_owned();
    let site = shown.find(&format!("the stop service at {address} is that of corridor"));
    ensure!(output.status.success() && site.is_some(), "{:?} {shown}", output.status);
    ensure!(shown.find("engaged") > site, "the site is shown first: {shown}");
    ensure!(engaged().await? == before + 1, "the stop is engaged");
    Ok(())
}
