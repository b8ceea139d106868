//! What holds changes of software on a site of several processes over PostgreSQL, as people say it and are told of it
//! at its public address: a pin, a freeze, a pause, a clock in doubt, a bundle that is taken back. By the bodies'
//! journals nobody changes while any of it stands.

use crate::harness::{folder, until};
use crate::identity::json;
use crate::rolled_out::{Doors, begin_rollout, call, done, fleet};
use crate::room::LIMIT;
use crate::stack::Stack;
use anyhow::ensure;
use midshift_agent::clock::wall;
use midshift_core::reason::Code;
use midshift_core::site::DEMO;
use midshift_sim::journal::{self, Effect};
use serde_json::Value;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

const RELEASE: &str = "walk-1.5.0";
const NEXT: &str = "walk-1.5.1";
/// The robot that changes, and one that a person keeps at what it runs.
const ROBOT: &str = "rbt-01";
const PINNED: &str = "rbt-02";
/// Areas of the site.
const AREAS: [&str; 3] = ["hall", "packing", "quality"];
/// Of the shared data folder: the newest time that the processes of before did not doubt, unix ms.
const BELIEVED: &str = "clock-believed";
/// So long before a start that the start is doubted, milliseconds: 8 days.
const OFF_MS: i64 = 8 * 24 * 3_600_000;
/// There where the network has set the clock of this machine: then no start is doubted.
const SYNCED: &str = "/run/systemd/timesync/synchronized";

fn freeze(public: &str, stands: bool) -> anyhow::Result<()> {
    let stands = stands.to_string();
    AREAS.into_iter().try_for_each(|area| done(&["area", "put", "--server", public, area, "--frozen", &stands]))
}

/// Begins to roll a release out to all at once.
fn begin(public: &str, release: &str) -> anyhow::Result<()> {
    let quick = ["--waves", "rest", "--allow-full-push", "--soak", "0s", "--probation", "1s", "--exposure-tasks", "0"];
    done(&[&["rollout", "create", "--server", public, release][..], &quick].concat())?;
    begin_rollout(public, release)
}

/// Waits until `rollout explain` gives a robot this reason.
async fn until_told(public: &str, release: &str, robot: &str, code: Code) -> anyhow::Result<()> {
    until(&format!("{robot} in {release}: {}", code.as_str()), LIMIT, async || {
        let told = call(&["rollout", "explain", "--server", public, release, robot, "-o", "json"])?;
        let told: Value = serde_json::from_slice(&told.stdout).unwrap_or_default();
        let codes = [&told["robot"]["blockedBy"]["code"], &told["reason"]["code"]];
        Ok(codes.into_iter().any(|told| told == code.as_str()).then_some(()))
    })
    .await
}

/// Asks what may not be; what is said of that.
fn refused(arguments: &[&str]) -> anyhow::Result<String> {
    let refused = call(arguments)?;
    ensure!(refused.status.code() == Some(9), "{arguments:?}: {refused:?}");
    Ok(String::from_utf8_lossy(&refused.stderr).into_owned())
}

/// When the body of this journal first began to run a version of software; none: never.
fn began(journal: &Path, version: &str) -> anyhow::Result<Option<i64>> {
    let ran = |effect: &Effect| matches!(effect, Effect::Ran { version: began } if began == version);
    Ok(journal::read(journal)?.into_iter().find(|entry| ran(&entry.effect)).map(|entry| entry.utc_ms))
}

/// All processes start again after eight days, as they see it: nothing is signed until a person accepts the clock.
async fn a_clock_in_doubt(stack: &mut Stack, data: &Path) -> anyhow::Result<()> {
    let (public, data_folder) = (stack.public.to_string(), data.display().to_string());
    stack.kill_all()?;
    std::fs::write(data.join(BELIEVED), (wall().0 - OFF_MS).to_string())?;
    stack.restart_all().await?;
    if Path::new(SYNCED).exists() {
        say!("the network has set the clock here: nothing is doubted");
        return until_told(&public, RELEASE, ROBOT, Code::BlockedByPause).await;
    }
    until_told(&public, RELEASE, ROBOT, Code::ClockDoubted).await?;
    let look = ["doctor", "--server", &public, "--stop-server", "127.0.0.1:1", "--data", &data_folder, "-o", "json"];
    let found = call(&look)?;
    let found = String::from_utf8_lossy(&found.stdout);
    ensure!(found.contains("the server signs nothing since"), "{found}");
    done(&["doctor", "--accept-clock", "--data", &data_folder])?;
    until_told(&public, RELEASE, ROBOT, Code::BlockedByPause).await?;
    until("the word to be taken", LIMIT, async || {
        let found = call(&look)?;
        Ok((!String::from_utf8_lossy(&found.stdout).contains("signs nothing")).then_some(()))
    })
    .await?;
    until("the row of the word", LIMIT, async || {
        let rows = json(stack.public, &["audit", "ls", "--action", "clock.accept"])?;
        Ok(rows["rows"].as_array().is_some_and(|rows| !rows.is_empty()).then_some(()))
    })
    .await
}

/// It is released: the robot takes it, the pinned one does not, and the document of it says so.
fn released(public: SocketAddr, journals: &[PathBuf]) -> anyhow::Result<()> {
    let (address, from_ms) = (public.to_string(), wall().0);
    done(&["rollout", "resume", "--server", &address, RELEASE, "--reason", "all was looked at"])?;
    let wait = ["rollout", "wait", "--server", &address, RELEASE, "--timeout", "120s"];
    let waited = tokio::task::block_in_place(|| call(&wait))?;
    ensure!(waited.status.code() == Some(0), "{}", String::from_utf8_lossy(&waited.stderr));
    let began_ms = began(&journals[0], "1.5.0")?;
    ensure!(began_ms.is_some_and(|at| at >= from_ms), "{ROBOT} began at {began_ms:?}, and was held until {from_ms}");
    ensure!(began(&journals[1], "1.5.0")?.is_none(), "{PINNED} keeps what it runs");
    let document = json(public, &["rollout", "report", RELEASE])?;
    let robots = document["robots"].as_array().cloned().unwrap_or_default();
    let robots: Vec<_> = robots.iter().map(|robot| robot["robotId"].as_str().unwrap_or_default()).collect();
    ensure!(robots == [ROBOT], "{document}");
    Ok(())
}

/// A bundle is taken back while its roll-out waits: nobody runs it.
async fn taken_back(public: &str, journals: &[PathBuf]) -> anyhow::Result<()> {
    freeze(public, true)?;
    begin(public, NEXT)?;
    until_told(public, NEXT, ROBOT, Code::BlockedByWindow).await?;
    let revoked = call(&["bundle", "revoke", "--server", public, NEXT, "--reason", "it limps"])?;
    let said = String::from_utf8_lossy(&revoked.stdout).into_owned() + &String::from_utf8_lossy(&revoked.stderr);
    ensure!(revoked.status.success() && said.contains("is taken back"), "{said}");
    freeze(public, false)?;
    until_told(public, NEXT, ROBOT, Code::BlockedByPause).await?;
    done(&["rollout", "abort", "--server", public, NEXT, "--reason", "it limps"])?;
    let wait = ["rollout", "wait", "--server", public, NEXT, "--for", "ended", "--timeout", "120s"];
    let waited = tokio::task::block_in_place(|| call(&wait))?;
    ensure!(waited.status.code() == Some(12), "{}", String::from_utf8_lossy(&waited.stderr));
    for journal in journals {
        ensure!(began(journal, "1.5.1")?.is_none(), "{} ran what was taken back", journal.display());
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn on_a_split_site_each_hold_of_a_roll_out_is_told_with_its_reason_and_nobody_changes_behind_it()
-> anyhow::Result<()> {
    let dir = folder()?;
    let samples = dir.path().join("samples");
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    let keys = samples.join("keys").display().to_string();
    let mut stack = Stack::start(dir.path(), DEMO, &[], &["--ota-keys", &keys]).await?;
    let (public, data) = (stack.public.to_string(), dir.path().join("data"));
    let doors = Doors { people: stack.public, robots: stack.robots, stops: None };
    let (robots, journals) = fleet(dir.path(), &doors, &samples, 2).await?;
    let pin = ["robot", "pin", PINNED, "--server", &public, "--reason", "it is being measured"];
    until("roll-outs to know the robot", LIMIT, async || Ok(call(&pin)?.status.success().then_some(()))).await?;
    until("the release", LIMIT, async || {
        let listed = call(&["bundle", "ls", "--server", &public])?;
        Ok(String::from_utf8_lossy(&listed.stdout).contains("1.5.1").then_some(()))
    })
    .await?;

    freeze(&public, true)?;
    begin(&public, RELEASE)?;
    until_told(&public, RELEASE, ROBOT, Code::BlockedByWindow).await?;
    until_told(&public, RELEASE, PINNED, Code::SkippedPinned).await?;
    let said = refused(&["rollout", "write-off", "--server", &public, RELEASE, ROBOT, "--reason", "nobody finds it"])?;
    ensure!(said.contains("is not out of work for this roll-out"), "{said}");
    let said = refused(&["robot", "unstick", "--server", &public, ROBOT, "--reason", "its disk has room"])?;
    ensure!(said.contains("is not stuck on its way back"), "{said}");
    done(&["rollout", "pause", "--server", &public, RELEASE, "--reason", "somebody looks"])?;
    freeze(&public, false)?;
    until_told(&public, RELEASE, ROBOT, Code::BlockedByPause).await?;

    a_clock_in_doubt(&mut stack, &data).await?;
    released(stack.public, &journals)?;
    robots[0].keeps("1.5.0").await?;
    taken_back(&public, &journals).await?;
    done(&["robot", "unpin", PINNED, "--server", &public])
}
