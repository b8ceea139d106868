//! A server is lost and restored from a backup that is older than the revocations of a token and of a robot, and than the enrolment of another robot: nobody
//! who was taken back comes in again, and the robot that nobody knows is watched until a person adopts it.

use crate::harness::{Running, Server, command, folder, sign_in_to, until};
use crate::identity::{call_as, incidents, json, presence};
use crate::restored::{Engine, run};
use crate::robots::{Robots, enrolment};
use crate::rolled_out::done;
use crate::secrets::{heard, keep_secret, secret_part};
use anyhow::{Context, ensure};
use midshift_core::reason::Code;
use midshift_core::site::{DEMO, Site, text};
use serde_json::Value;
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

const LIMIT: Duration = Duration::from_secs(120);

/// Waits until the server hears the robot, in charge.
pub async fn until_heard(server: SocketAddr, robot_id: &str) -> anyhow::Result<()> {
    until(&format!("{robot_id} in charge"), LIMIT, async || {
        let seen = presence(server, robot_id).await.ok();
        Ok(seen.filter(|(is_observed, is_heard)| !is_observed && *is_heard).map(drop))
    })
    .await
}

/// Enrols the nth robot, and starts it.
pub async fn begin(server: SocketAddr, robots: &Robots, dir: &Path, nth: usize) -> anyhow::Result<Running> {
    let robot_id = format!("rbt-{:02}", nth + 1);
    let secret = enrolment(server, &robot_id).await?.context("a secret")?;
    let running = robots.run(nth, &dir.join(&robot_id), Some(&secret))?;
    until_heard(server, &robot_id).await?;
    Ok(running)
}

/// Waits for the incident of the third robot, adopts it, and waits until it is in charge.
pub async fn adopt(server: SocketAddr) -> anyhow::Result<()> {
    until("the incident of a machine that is not enrolled", LIMIT, async || {
        let told = incidents(server)?;
        let of = |incident: &&Value| {
            incident["robotId"] == "rbt-03" && incident["reason"]["code"] == Code::RobotNotEnrolled.as_str()
        };
        Ok(told.iter().find(of).map(drop))
    })
    .await?;
    done(&["robot", "adopt", "rbt-03", "--server", &server.to_string()])?;
    until_heard(server, "rbt-03").await
}

/// What a person says at the restore.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum With {
    List,
    NewTokens,
}

/// A restore that first asks what a person wants, and the server that starts from it.
async fn restored(server: &mut Server, with: With, restore: &[&str], dir: &Path) -> anyhow::Result<()> {
    let asked = heard(&mut command(restore)?)?;
    let said = String::from_utf8_lossy(&asked.stderr).into_owned();
    ensure!(!asked.status.success() && said.contains("--revocations FILE") && said.contains("re-issue"), "{said}");
    ensure!(!server.data().exists(), "a person must say first");
    if with == With::List {
        let list = dir.join("list");
        run(&[restore, &["--revocations", &list.to_string_lossy()]].concat())?;
        return server.restart().await;
    }
    let told = run(&[restore, &["--identity", "re-issue", "-o", "json"]].concat())?;
    let told: Value = serde_json::from_str(&told)?;
    let token = dir.join("new-token");
    std::fs::write(&token, format!("{}\n", told["token"].as_str().context("a token")?))?;
    let (address, authority) = (server.address, server.data().join("identity/ca.pem"));
    let (started, signed_in) = tokio::join!(server.restart(), sign_in_to(address, authority, &token));
    started.and(signed_in)
}

async fn played(engine: Engine, with: With) -> anyhow::Result<()> {
    let dir = folder()?;
    let site: Site = text::parse(DEMO)?;
    engine.prepare();
    let flags = engine.flags();
    let flags: Vec<&str> = flags.iter().map(String::as_str).collect();
    let mut server = Server::start_with(dir.path(), DEMO, &flags).await?;
    let address = server.address.to_string();
    let robots = Robots::waiting(dir.path(), server.address, &site, 3);
    let mut running = vec![
        begin(server.address, &robots, dir.path(), 0).await?,
        begin(server.address, &robots, dir.path(), 1).await?,
    ];
    let made = json(server.address, &["token", "create", "anna", "--role", "viewer"])?;
    let anna = made["secret"].as_str().context("a secret")?.to_owned();
    keep_secret("a token", secret_part(&anna)?);
    let token_id = made["token"]["tokenId"].as_str().or(made["token"]["token_id"].as_str()).context("an id")?;
    let (data, backup, list) = (server.data(), dir.path().join("backup"), dir.path().join("list"));
    let (data, backup) = (data.to_string_lossy(), backup.to_string_lossy());
    run(&[&["backup", "--data", &data, "--to", &backup][..], &flags].concat())?;
    ensure!(call_as(server.address, &anna, &["robot", "ls"])?.status.success(), "she is known");
    // Of these three the backup knows nothing.
    done(&["token", "revoke", token_id, "--server", &address])?;
    done(&["robot", "revoke", "rbt-02", "--server", &address])?;
    running.push(begin(server.address, &robots, dir.path(), 2).await?);
    std::fs::copy(server.data().join("identity/revocations.jsonl"), &list)?;
    until("the copy of the list beside the stop service", LIMIT, async || {
        let copy = std::fs::read_to_string(server.data().join("stop/revocations.jsonl")).unwrap_or_default();
        Ok((copy == std::fs::read_to_string(&list)?).then_some(()))
    })
    .await?;
    server.kill()?;
    engine.lose(&server.data())?;

    restored(&mut server, with, &[&["restore", "--from", &backup, "--data", &data][..], &flags].concat(), dir.path())
        .await?;
    until_heard(server.address, "rbt-01").await?;
    adopt(server.address).await?;
    let refused = call_as(server.address, &anna, &["robot", "ls"])?;
    ensure!(refused.status.code() == Some(6), "her token was revoked: {refused:?}");
    if with == With::NewTokens {
        // Robots are as they were at the backup, as it was said.
        done(&["robot", "revoke", "rbt-02", "--server", &address])?;
    }
    let seen = presence(server.address, "rbt-02").await?;
    ensure!(seen == (false, false) || with == With::NewTokens, "a revoked robot is connected: {seen:?}");
    until("the revoked robot to be gone", LIMIT, async || {
        Ok((presence(server.address, "rbt-02").await? == (false, false)).then_some(()))
    })
    .await?;
    let identities = json(server.address, &["robot", "identities"])?;
    let robots = identities["robots"].as_array().cloned().unwrap_or_default();
    let keyless: Vec<&Value> =
        robots.iter().filter(|robot| robot["keySha256"].as_str().unwrap_or_default().is_empty()).collect();
    ensure!(keyless.len() == 1 && keyless[0]["robotId"] == "rbt-02", "{robots:?}");
    let rows = json(server.address, &["audit", "ls", "--action", "backup.restore"])?;
    ensure!(rows["rows"].as_array().is_some_and(|rows| rows.len() == 1), "{rows}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_revoked_after_a_backup_of_sqlite_stays_out_by_the_list() -> anyhow::Result<()> {
    played(Engine::Sqlite, With::List).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_revoked_after_a_backup_of_postgresql_stays_out_by_the_list() -> anyhow::Result<()> {
    played(Engine::Postgres("taken_back"), With::List).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn all_tokens_end_where_they_are_issued_anew_and_a_robot_that_nobody_knows_is_adopted() -> anyhow::Result<()> {
    played(Engine::Sqlite, With::NewTokens).await
}
