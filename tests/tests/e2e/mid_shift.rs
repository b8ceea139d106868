//! Software in the middle of a shift, over TLS with enrolled robots and one server: a good release reaches all of them while they work and the server is
//! killed, a bad one stops at its canary, and no task is lost. One that hangs ends with its canary too.

use crate::harness::{Server, folder, until};
use crate::kill::{all_over, at_work, judge_journals, submit};
use crate::rolled_out::{Doors, Robot, begin_rollout, call, done, fleet};
use crate::room::LIMIT;
use anyhow::ensure;
use midshift_agent::switch::FACTORY;
use midshift_core::site::{DEMO, text};
use midshift_proto::task::v1::TaskState;
use midshift_sim::journal::{self, Effect};
use std::collections::BTreeSet;

const ROBOTS: usize = 6;
const TASKS: usize = 60;
/// The release that all of them take, and the one that none keeps.
const GOOD: &str = "1.5.0";
const BAD: &str = "1.6.0-bad-at-start";
const HANGS: &str = "1.6.1-hangs";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fleet_takes_a_release_in_the_middle_of_a_shift_and_loses_no_task_though_the_server_is_killed()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = text::parse(DEMO)?;
    let samples = dir.path().join("samples");
    done(&["bundle", "samples", &samples.display().to_string()])?;
    let keys = samples.join("keys").display().to_string();
    let mut server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    let address = server.address.to_string();
    let doors = Doors { people: server.address, robots: server.address, stops: None };
    let (robots, journals) = fleet(dir.path(), &doors, &samples, ROBOTS).await?;
    submit(server.address, &site, 23, TASKS).await?;
    at_work(server.address, 2, &BTreeSet::new()).await?;

    let begin = |version: &str| {
        let (id, quick) = (format!("walk-{version}"), ["--soak", "1s", "--probation", "2s", "--exposure-tasks", "0"]);
        done(&[&["rollout", "create", "--server", &address, &id, "--waves", "1,50%,rest"][..], &quick].concat())?;
        begin_rollout(&address, &id)
    };
    let ended = |version: &str| {
        let id = format!("walk-{version}");
        tokio::task::block_in_place(|| call(&["rollout", "wait", "--server", &address, &id, "--timeout", "180s"]))
    };
    begin(GOOD)?;
    until("the canary keeps it on trial", LIMIT, async || Ok(robots.iter().any(Robot::is_on_trial).then_some(())))
        .await?;
    server.kill_and_restart().await?;
    // The shift is not over yet.
    at_work(server.address, 2, &BTreeSet::new()).await?;
    let waited = ended(GOOD)?;
    ensure!(waited.status.code() == Some(0), "{}", String::from_utf8_lossy(&waited.stderr));
    for robot in &robots {
        robot.keeps(GOOD).await?;
    }
    begin(BAD)?;
    let waited = ended(BAD)?;
    ensure!(waited.status.code() == Some(12), "{}", String::from_utf8_lossy(&waited.stderr));
    let tasks = all_over(server.address, TASKS).await?;
    ensure!(tasks.iter().all(|task| task.state() == TaskState::Succeeded), "{tasks:?}");
    for robot in &robots {
        ensure!(robot.committed()?.as_deref() == Some(GOOD), "{:?}", robot.switch()?);
    }
    judge_journals(&tasks, &BTreeSet::new(), &site, &journals)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_release_that_hangs_on_probation_ends_with_its_canary_which_goes_back() -> anyhow::Result<()> {
    let dir = folder()?;
    let site = text::parse(DEMO)?;
    let samples = dir.path().join("samples");
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    let keys = samples.join("keys").display().to_string();
    let server = Server::start_with(dir.path(), DEMO, &["--ota-keys", &keys]).await?;
    let address = server.address.to_string();
    let doors = Doors { people: server.address, robots: server.address, stops: None };
    let (robots, journals) = fleet(dir.path(), &doors, &samples, 3).await?;
    submit(server.address, &site, 29, TASKS).await?;
    let id = format!("walk-{HANGS}");
    let watched = ["--soak", "1s", "--probation", "5s", "--exposure-tasks", "0"];
    done(&[&["rollout", "create", "--server", &address, &id, "--waves", "1,rest"][..], &watched].concat())?;
    begin_rollout(&address, &id)?;
    let wait = ["rollout", "wait", "--server", &address, &id, "--timeout", "180s"];
    let waited = tokio::task::block_in_place(|| call(&wait))?;
    ensure!(waited.status.code() == Some(12), "{}", String::from_utf8_lossy(&waited.stderr));
    until("everybody on what it came with", LIMIT, async || {
        let mut switches = robots.iter().map(Robot::switch).filter_map(Result::ok);
        Ok(switches.all(|switch| switch.trial.is_none() && switch.running() == FACTORY).then_some(()))
    })
    .await?;
    let mut ran = 0;
    for journal in &journals {
        let is_bad = |effect: &Effect| matches!(effect, Effect::Ran { version } if version == HANGS);
        ran += usize::from(journal::read(journal)?.iter().any(|entry| is_bad(&entry.effect)));
    }
    ensure!(ran == 1, "its canary alone runs it, and {ran} did");
    Ok(())
}
