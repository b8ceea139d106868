//! A site file that changes between two starts: the stored map goes on while something is in the way of the new one.

use crate::harness::{Server, folder, until};
use crate::rolled_out::{call, done};
use crate::room::LIMIT;
use anyhow::ensure;
use midshift_core::site::DEMO;

/// The demo site, in which a station has moved.
fn moved() -> anyhow::Result<String> {
    let (before, after) = ("{ id = \"B03\", at = [20500, 9800]", "{ id = \"B03\", at = [20500, 9900]");
    ensure!(DEMO.contains(before), "the demo site has another B03");
    Ok(DEMO.replace(before, after))
}

/// Incidents that are open, as the command line prints them.
async fn incidents(server: &Server) -> anyhow::Result<String> {
    let address = server.address.to_string();
    let output = call(&["incident", "ls", "--server", &address, "-o", "json"])?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

async fn told(server: &Server, code: &str) -> anyhow::Result<()> {
    until("an incident", LIMIT, async || Ok(incidents(server).await?.contains(code).then_some(()))).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_changed_map_waits_for_a_task_in_its_way_and_is_taken_at_a_start_without_one_or_by_force()
-> anyhow::Result<()> {
    let dir = folder()?;
    let mut server = Server::start(dir.path()).await?;
    let address = server.address.to_string();
    done(&["task", "submit", "--server", &address, "--task-id", "GOES-THERE", "--from", "A01", "--to", "B03"])?;
    server.kill()?;
    server.change_site(&moved()?)?;
    server.restart().await?;
    told(&server, "MAP_NOT_TAKEN").await?;
    ensure!(incidents(&server).await?.contains("GOES-THERE"), "it says what is in the way");

    server.kill()?;
    server.restart_with(&["--force-map"]).await?;
    told(&server, "MAP_FORCED").await?;
    until("the first incident to close", LIMIT, async || {
        Ok((!incidents(&server).await?.contains("MAP_NOT_TAKEN")).then_some(()))
    })
    .await?;

    done(&["task", "cancel", "GOES-THERE", "--server", &address, "--reason", "the station has moved"])?;
    until("nothing to be in the way", LIMIT, async || {
        let open = server.in_states(&[midshift_proto::task::v1::TaskState::Canceled]).await?;
        Ok(open.filter(|tasks| tasks.len() == 1))
    })
    .await?;
    server.kill()?;
    server.change_site(DEMO)?;
    server.restart().await?;
    ensure!(!incidents(&server).await?.contains("MAP_NOT_TAKEN"), "nothing is in the way of the way back");
    Ok(())
}
