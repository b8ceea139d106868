//! A site of several processes loses its database, its software and the list beside its authority. Backup and restore speak TLS to the database; who was taken
//! back stays out by the copy of the list on the machine of the stop service; and what people say of robots since then comes through the public address.

use crate::harness::{Running, channel, command, folder, until};
use crate::identity::{call_as, json, presence};
use crate::restored::run;
use crate::robots::Robots;
use crate::rolled_out::{begin_rollout, call, done};
use crate::room::LIMIT;
use crate::secrets::{heard, keep_secret, secret_part};
use crate::stack::Stack;
use crate::taken_back::{adopt, begin, until_heard};
use anyhow::{Context, bail, ensure};
use midshift_core::reason::Code;
use midshift_core::site::{DEMO, text};
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{UnstickRobotRequest, WriteOffRobotRequest};
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use midshift_proto::telemetry::v1::{ListRobotsRequest, RobotFilter};
use serde_json::Value;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;

const RELEASE: &str = "walk-1.5.0";

/// Lets a person in, makes a backup, and then takes the person and the second robot back and enrols the third: none of that is in the backup. The token.
async fn backed_up(
    stack: &Stack,
    robots: &Robots,
    dir: &Path,
    running: &mut Vec<Running>,
    backup: &[&str],
) -> anyhow::Result<String> {
    let (door, public) = (stack.public, stack.public.to_string());
    for nth in 0..2 {
        running.push(begin(door, robots, dir, nth).await?);
    }
    let made = json(door, &["token", "create", "anna", "--role", "viewer"])?;
    let anna = made["secret"].as_str().context("a secret")?.to_owned();
    keep_secret("a token", secret_part(&anna)?);
    let token_id = made["token"]["tokenId"].as_str().context("an id")?;
    until("her token to be good", LIMIT, async || {
        Ok(call_as(door, &anna, &["robot", "ls"])?.status.success().then_some(()))
    })
    .await?;
    until("the releases", LIMIT, async || {
        let listed = call(&["bundle", "ls", "--server", &public])?;
        Ok(String::from_utf8_lossy(&listed.stdout).contains("1.5.0").then_some(()))
    })
    .await?;
    run(backup)?;
    done(&["token", "revoke", token_id, "--server", &public])?;
    done(&["robot", "revoke", "rbt-02", "--server", &public])?;
    running.push(begin(door, robots, dir, 2).await?);
    Ok(anna)
}

/// Who asks what may not be is told why.
fn refused<T>(answer: Result<T, tonic::Status>) -> anyhow::Result<Option<Code>> {
    match answer {
        Ok(_) => bail!("it was done"),
        Err(status) => Ok(midshift_proto::refusal_of(&status).code),
    }
}

/// Robots that a gateway lists with this label.
async fn labeled(gateway: SocketAddr, key: &str, value: &str) -> anyhow::Result<Vec<String>> {
    let labels = BTreeMap::from([(key.to_owned(), value.to_owned())]);
    let filter = Some(RobotFilter { labels, ..RobotFilter::default() });
    let request = ListRobotsRequest { filter, ..ListRobotsRequest::default() };
    let page = TelemetryServiceClient::new(channel(gateway)?).list_robots(request).await?.into_inner();
    Ok(page.robots.into_iter().map(|robot| robot.robot_id).collect())
}

/// What people say of single robots, at the public address.
async fn robots_are_named(stack: &mut Stack) -> anyhow::Result<()> {
    let public = stack.public.to_string();
    done(&["robot", "label", "rbt-01", "floor=2", "--server", &public])?;
    for nth in 0..2 {
        let gateway = stack.address("telemetry", nth)?;
        until("each gateway to know the label", LIMIT, async || {
            Ok((labeled(gateway, "floor", "2").await? == ["rbt-01"]).then_some(()))
        })
        .await?;
    }
    let rollouts = RolloutServiceClient::new(channel(stack.public)?);
    until("roll-outs to know the robot, which is not stuck", LIMIT, async || {
        let request = UnstickRobotRequest {
            robot_id: "rbt-01".to_owned(),
            reason: "its disk has room".to_owned(),
            ..UnstickRobotRequest::default()
        };
        let code = refused(rollouts.clone().unstick_robot(request).await)?;
        Ok((code == Some(Code::NotStuck)).then_some(()))
    })
    .await?;
    let shown = call(&["robot", "replace", "rbt-01", "--accept-key", "--server", &public])?;
    let said = String::from_utf8_lossy(&shown.stderr).into_owned();
    ensure!(!shown.status.success() && said.contains("there is nothing to take"), "{said}");
    let key = format!("--accept-key={}", "0a".repeat(32));
    done(&["robot", "replace", "rbt-01", &key, "--server", &public])?;
    done(&["robot", "replace", "rbt-01", &key, "--server", &public]).context("what was done is done")
}

/// A restored release is rolled out, and what came of it is one document.
async fn a_roll_out_is_reported(public: SocketAddr) -> anyhow::Result<()> {
    let (address, all) = (public.to_string(), ["--waves", "rest", "--allow-full-push", "--soak", "0s"]);
    done(&[&["rollout", "create", "--server", &address, RELEASE][..], &all].concat())?;
    begin_rollout(&address, RELEASE)?;
    let rollouts = RolloutServiceClient::new(channel(public)?);
    until("the robot of the roll-out, which is heard", LIMIT, async || {
        let request = WriteOffRobotRequest {
            rollout_id: RELEASE.to_owned(),
            robot_id: "rbt-01".to_owned(),
            reason: "it burnt".to_owned(),
            ..WriteOffRobotRequest::default()
        };
        let code = refused(rollouts.clone().write_off_robot(request).await)?;
        Ok((code == Some(Code::RobotNotLost)).then_some(()))
    })
    .await?;
    let report = ["rollout", "report", RELEASE, "--server", &address, "-o"];
    let document = until("a report that names the robot", LIMIT, async || {
        let document: Value = serde_json::from_str(&run(&[&report[..], &["json"]].concat())?)?;
        let names = |robots: &Vec<Value>| robots.iter().any(|robot| robot["robotId"] == "rbt-01");
        Ok(document["robots"].as_array().is_some_and(names).then_some(document))
    })
    .await?;
    ensure!(document["rollout"]["rolloutId"] == RELEASE, "{document}");
    ensure!(document["events"].as_array().is_some_and(|events| !events.is_empty()), "{document}");
    let page = run(&[&report[..], &["html"]].concat())?;
    ensure!(page.starts_with("<!doctype html>") && page.contains("rbt-01"), "{page}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_split_site_comes_back_with_the_list_of_its_stop_machine_and_hears_people_at_its_public_address()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = text::parse(DEMO)?;
    let shown = |path: &str| dir.path().join(path).display().to_string();
    done(&["bundle", "samples", &shown("samples"), "--config-only"])?;
    let mut stack = Stack::start(dir.path(), DEMO, &[], &["--ota-keys", &shown("samples/keys")]).await?;
    let (door, public, url) = (stack.public, stack.public.to_string(), stack.url().to_owned());
    done(&["bundle", "push", "--server", &public, &shown("samples/repository")])?;
    // The machine of the stop service: nothing of the lost ones is on it.
    let apart = dir.path().join("apart");
    std::fs::create_dir(&apart)?;
    let mut follower = stack.follower(0, &apart)?;
    let robots = Robots::waiting(dir.path(), stack.robots, &site, 3);
    let mut running = Vec::new();
    let (data, backup) = (shown("data"), shown("backup"));
    let back_up = ["backup", "--data", &data, "--store", &url, "--to", &backup];
    let anna = backed_up(&stack, &robots, dir.path(), &mut running, &back_up).await?;
    let (list, copy) =
        (dir.path().join("identity/identity/revocations.jsonl"), apart.join("data/stop/revocations.jsonl"));
    let read = |path: &Path| std::fs::read_to_string(path).unwrap_or_default();
    until("the copy of the list on the machine of the stop service", LIMIT, async || {
        let kept = read(&list);
        Ok((!kept.is_empty() && read(&copy) == kept).then_some(()))
    })
    .await?;
    follower.kill()?;
    stack.kill_all()?;
    stack.lose_database()?;
    std::fs::remove_dir_all(&data)?;
    std::fs::remove_file(&list)?;

    let restore = ["restore", "--from", &backup, "--data", &data, "--store", &url];
    let asked = heard(&mut command(&restore)?)?;
    let said = String::from_utf8_lossy(&asked.stderr).into_owned();
    ensure!(!asked.status.success() && said.contains("--revocations FILE"), "{said}");
    run(&[&restore[..], &["--revocations", &copy.to_string_lossy()]].concat())?;
    stack.restart_all().await?;
    until_heard(door, "rbt-01").await?;
    adopt(door).await?;
    let denied = call_as(door, &anna, &["robot", "ls"])?;
    ensure!(denied.status.code() == Some(6), "her token was revoked: {denied:?}");
    until("the revoked robot to be gone", LIMIT, async || {
        Ok((presence(door, "rbt-02").await? == (false, false)).then_some(()))
    })
    .await?;
    ensure!(!read(&list).is_empty(), "the list goes on beside the authority");
    let rows = until("the row of the restore", LIMIT, async || {
        let rows = json(door, &["audit", "ls", "--action", "backup.restore"])?["rows"].as_array().cloned();
        Ok(rows.filter(|rows| !rows.is_empty()))
    })
    .await?;
    ensure!(rows.len() == 1, "processes that share a data folder write it once: {rows:?}");
    robots_are_named(&mut stack).await?;
    a_roll_out_is_reported(door).await
}
