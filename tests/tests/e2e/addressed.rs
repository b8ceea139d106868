//! Which stop service `midshift stop` addresses, with two sites on one machine.

use crate::harness::{Server, authority, folder, free_port, midshift, token};
use crate::secrets::heard;
use crate::stopped::StopServer;
use anyhow::{Context, ensure};
use midshift_core::site::CORRIDOR;
use std::net::SocketAddr;
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
