//! The stop service is a process of its own: while it is heard, no robot is slowed or stood by silence, whatever becomes of the server. When neither is heard for twenty
//! seconds, a robot stands among people and nowhere else.

use crate::harness::{Server, channel, folder, until};
use crate::kill::{all_over, at_work, judge, submit};
use crate::proxy::Proxy;
use crate::robots::{Robots, with_robots};
use crate::rolled_out::{call, done};
use crate::stopped::StopServer;
use anyhow::{Context, ensure};
use midshift_core::robot::StopLevel;
use midshift_core::site::DEMO;
use midshift_proto::common::v1::StopLevel as Shown;
use midshift_proto::stop::v1::GetStatusRequest;
use midshift_proto::stop::v1::stop_service_client::StopServiceClient;
use midshift_proto::task::v1::TaskState;
use midshift_sim::journal::{self, Effect};
use std::collections::BTreeSet;
use std::path::Path;
use std::time::Duration;

const ROBOTS: usize = 6;
const TASKS: usize = 16;
const LIMIT: Duration = Duration::from_secs(60);

/// What a body was told to obey, in order: it boots stopped, and is then told what is stopped.
pub fn obeyed(journal: &Path) -> anyhow::Result<Vec<StopLevel>> {
    let effects = journal::read(journal)?.into_iter().map(|entry| entry.effect);
    Ok(effects.filter_map(|effect| if let Effect::Obeys { level, .. } = effect { Some(level) } else { None }).collect())
}

/// Whether it was only ever let go since its start.
fn was_let_alone(levels: &[StopLevel]) -> bool {
    levels.last() == Some(&StopLevel::None) && levels.iter().skip_while(|level| **level != StopLevel::None).count() == 1
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_killed_again_and_again_silences_no_robot_and_the_end_of_the_stop_service_does()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, ROBOTS)?;
    let mut server = Server::start_for(dir.path(), &site).await?;
    let mut stops = StopServer::start(dir.path(), server.address).await?;
    let (address, line) = (server.address, Some(stops.address));
    let robots = Robots::start_beside(dir.path(), address, address, line, &site).await?;
    submit(address, &site, 31, TASKS).await?;
    for done in [2, 5, 8, 11] {
        at_work(address, done, &BTreeSet::new()).await?;
        server.kill_and_restart().await?;
    }
    let ended = all_over(address, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    let mut client = StopServiceClient::new(channel(stops.address)?);
    let status = client.get_status(GetStatusRequest {}).await?.into_inner().status.unwrap_or_default();
    ensure!(status.robots.len() == ROBOTS && status.stops.is_empty(), "{status:?}");
    for robot in &status.robots {
        let waits = !robot.awaiting_resume.is_empty() || robot.obeys() != Shown::None;
        ensure!(robot.heard_unix_ms > 0 && !waits, "{robot:?}");
    }
    for journal in robots.journals() {
        let levels = obeyed(&journal)?;
        ensure!(was_let_alone(&levels), "{}: {levels:?}", journal.display());
    }

    // The same bodies say so when it is the stop service that is silent.
    stops.kill()?;
    until("every robot stood by silence", LIMIT, async || {
        let all = robots.journals().iter().map(|journal| obeyed(journal)).collect::<anyhow::Result<Vec<_>>>()?;
        Ok(all.iter().all(|levels| levels.last() >= Some(&StopLevel::Halt)).then_some(()))
    })
    .await
}

/// Longer than a robot among people works unheard, and shorter than one elsewhere does.
const CUT_MS: i64 = 20_000;
/// The first moments of it, in which what was on its way arrives.
const SLEW_MS: i64 = 500;
/// Tasks of a robot far from people, and more of them than it does in that time.
const TASKS_AWAY: usize = 5;

/// Levels that a body was told after it was let go for the first time.
fn since_free(journal: &Path) -> anyhow::Result<Vec<StopLevel>> {
    Ok(obeyed(journal)?.into_iter().skip_while(|level| *level != StopLevel::None).collect())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_robot_that_nobody_hears_for_twenty_seconds_works_on_and_one_among_people_stands_until_it_is_resumed()
-> anyhow::Result<()> {
    let dir = folder()?;
    let server = Server::start(dir.path()).await?;
    let stops = StopServer::start(dir.path(), server.address).await?;
    let (link, line) = (Proxy::before(server.address).await?, Proxy::before(stops.address).await?);
    let (people, address) = (server.address, server.address.to_string());
    let starts = ["park-5", "hold-pack"].map(str::to_owned);
    let robots = Robots::start_at(dir.path(), link.address, people, Some(line.address), &starts).await?;
    let [away, among] = <[_; 2]>::try_from(robots.journals()).ok().context("two robots")?;
    done(&["robot", "cordon", "--server", &address, "rbt-02", "--reason", "it stays where people are"])?;
    for _ in 0..TASKS_AWAY {
        done(&["task", "submit", "--server", &address, "--from", "D02", "--to", "B01", "--sku", "SKU-1"])?;
    }
    until("work, and both robots let go", LIMIT, async || {
        let at_work = server.in_states(&[TaskState::Running]).await?.is_some_and(|tasks| !tasks.is_empty());
        let is_free = |journal: &Path| anyhow::Ok(was_let_alone(&obeyed(journal)?));
        Ok((at_work && is_free(&away)? && is_free(&among)?).then_some(()))
    })
    .await?;

    let clock = midshift_process::clock::clock(1000);
    link.sever();
    line.sever();
    let from_ms = clock.now().wall.0;
    until("the end of the cut", LIMIT, async || Ok((clock.now().wall.0 >= from_ms + CUT_MS).then_some(()))).await?;
    let to_ms = clock.now().wall.0;
    link.mend();
    line.mend();
    ensure!(since_free(&among)?.last() >= Some(&StopLevel::Halt), "among people: {:?}", obeyed(&among)?);
    let inside = from_ms + SLEW_MS..to_ms;
    let worked = journal::read(&away)?.into_iter().filter(|entry| inside.contains(&entry.utc_ms));
    let worked = worked.filter(|entry| matches!(entry.effect, Effect::Entered { .. } | Effect::Picked { .. })).count();
    ensure!(worked > 0, "nothing was done inside the cut");

    let silence = until("the robot among people says why it stands", LIMIT, async || {
        let mut client = StopServiceClient::new(channel(stops.address)?);
        let Ok(status) = client.get_status(GetStatusRequest {}).await else { return Ok(None) };
        let robots = status.into_inner().status.unwrap_or_default().robots;
        let told = robots.into_iter().find(|robot| robot.robot_id == "rbt-02").map(|robot| robot.awaiting_resume);
        Ok(told.and_then(|told| told.into_iter().next()))
    })
    .await?;
    let tasks = all_over(people, TASKS_AWAY).await?;
    ensure!(tasks.iter().all(|task| task.state() == TaskState::Succeeded), "{tasks:?}");
    let stood = |entry: &journal::Entry| {
        let obeys = matches!(entry.effect, Effect::Obeys { level, .. } if level >= StopLevel::Halt);
        obeys && inside.contains(&entry.utc_ms)
    };
    ensure!(!journal::read(&away)?.iter().any(stood), "away: {:?}", obeyed(&away)?);
    ensure!(since_free(&among)?.last() >= Some(&StopLevel::Halt), "it was let go by itself: {:?}", obeyed(&among)?);
    until("the resume", LIMIT, async || {
        let resume = ["resume", "--server", &address, "--stop", &silence, "--reason", "nobody is near"];
        Ok(tokio::task::block_in_place(|| call(&resume))?.status.success().then_some(()))
    })
    .await?;
    until("it is let go", LIMIT, async || Ok((obeyed(&among)?.last() == Some(&StopLevel::None)).then_some(()))).await
}
