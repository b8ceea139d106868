//! `sim run`, signed in, beside robots that have the names it would give.

use crate::harness::{Running, Server, command, folder, until};
use crate::robots::enrolled;
use anyhow::{Context, ensure};
use midshift_core::ids::RobotId;
use midshift_proto::identity::v1::ListRobotIdentitiesRequest;
use midshift_proto::identity::v1::identity_service_client::IdentityServiceClient;
use midshift_proto::telemetry::v1::GetRobotRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

const LIMIT: Duration = Duration::from_secs(60);

/// Keys of the machines of a site, by robot.
async fn keys(server: &Server) -> anyhow::Result<BTreeMap<String, String>> {
    let request = ListRobotIdentitiesRequest { page_size: 100, ..Default::default() };
    let page = IdentityServiceClient::new(server.channel()?).list_robot_identities(request).await?.into_inner();
    Ok(page.robots.into_iter().map(|robot| (robot.robot_id, robot.key_sha256)).collect())
}

/// Waits until a robot has another machine than before.
async fn has_another_key(server: &Server, robot_id: &str, before: &str) -> anyhow::Result<()> {
    until("another machine", LIMIT, || async {
        Ok(keys(server).await?.get(robot_id).is_some_and(|key| key != before).then_some(()))
    })
    .await
}

/// Two simulated robots.
fn simulated(server: &Server, more: &[&str]) -> anyhow::Result<Command> {
    let address = server.address.to_string();
    command(&[&["sim", "run", "--server", &address, "--robots", "2", "--no-stop", "--no-faults"][..], more].concat())
}

fn start(server: &Server, more: &[&str], dir: &Path) -> anyhow::Result<Running> {
    Running::start(&mut simulated(server, more)?, &dir.join("simulated.log"))
}

#[tokio::test(flavor = "multi_thread")]
async fn simulated_robots_take_no_name_from_a_robot_that_never_said_it_is_simulated() -> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    // A machine that is switched on tomorrow.
    enrolled(server.address, &RobotId::parse("rbt-02")?).await?;
    let before = keys(&server).await?;
    let refused = simulated(&server, &[])?.output()?;
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    ensure!(refused.status.code() == Some(1), "{said}");
    ensure!(["rbt-02", "--prefix", "--replace"].iter().all(|word| said.contains(word)), "{said}");
    ensure!(keys(&server).await? == before, "nobody is enrolled beside it either");

    // Under other names they work, and the next run takes the places of the one before.
    let others = ["--prefix", "sim-"];
    let first = start(&server, &others, dir.path())?;
    until("a simulated robot that is heard", LIMIT, || async {
        let request = GetRobotRequest { robot_id: "sim-02".to_owned() };
        Ok(TelemetryServiceClient::new(server.channel()?).get_robot(request).await.ok().map(drop))
    })
    .await?;
    drop(first);
    let key = keys(&server).await?.remove("sim-02").context("it was enrolled")?;
    let again = start(&server, &others, dir.path())?;
    has_another_key(&server, "sim-02", &key).await?;
    drop(again);

    let _given_away = start(&server, &["--replace"], dir.path())?;
    has_another_key(&server, "rbt-02", &before["rbt-02"]).await
}
