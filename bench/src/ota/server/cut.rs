//! A server that is killed while it assigns, and started again on what it left.

use super::assign::{ID, OFFERED_WITHIN, spec_of, until_offered};
use super::rollouts::Rollouts;
use super::scene::{Floor, attached};
use crate::ota::args::OtaArgs;
use anyhow::ensure;
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// It is killed once so many of a hundred robots have heard.
const KILL_AT_PERCENT: usize = 30;
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(1);
/// How often the new one is asked how far it is; each look costs it some milliseconds with ten thousand robots.
const ASK_EVERY: Duration = Duration::from_millis(50);

/// What one kill came to. Ready is the moment when the new server takes connections.
#[derive(Clone, Debug)]
pub struct Cut {
    /// Robots whose directive was in the database when it was dead.
    pub before: f64,
    /// Seconds from the start of the new one to ready.
    pub ready_s: f64,
    /// From ready until one more robot was assigned, at the latest: it was asked for then.
    pub first_s: f64,
    /// From ready until all were assigned, and CPU seconds from its start.
    pub all_s: f64,
    pub cpu_s: f64,
    /// From ready until every robot was attached again and had heard.
    pub offered_s: f64,
}

/// Kills one. None: it had assigned everybody before it was dead.
pub async fn measure(args: &OtaArgs, robots: usize) -> anyhow::Result<Option<Cut>> {
    let floor = Floor::make(args.dir.as_ref(), robots)?;
    let mut server = floor.serve().await?;
    floor.people.push(&server).await?;
    let mut robots_child = floor.hearers(robots, None)?;
    let mut rollouts = Rollouts::connect(&server).await?;
    attached(&mut server, &mut rollouts, robots).await?;
    rollouts.create(ID, spec_of(args.server.canary, robots)).await?;
    rollouts.submit_and_approve(ID).await?;
    // The answer may never come.
    let start = async {
        let _ = rollouts.start(ID).await;
        std::future::pending::<anyhow::Result<()>>().await
    };
    let enough = async {
        while (robots_child.ask("offered")? as usize) * 100 < robots * KILL_AT_PERCENT {
            sleep(LOOK_EVERY).await;
        }
        anyhow::Ok(())
    };
    tokio::select! {
        started = start => started?,
        enough = enough => enough?,
        () = sleep(OFFERED_WITHIN) => ensure!(false, "nobody was offered anything"),
    }
    // SIGKILL.
    drop(server);
    let before = floor.read().await?.assigned();
    let begun = Instant::now();
    let server = floor.serve().await?;
    let ready = Instant::now();
    if before == robots {
        return Ok(None);
    }
    let mut rollouts = Rollouts::connect(&server).await?;
    let assigned = |left: u32| robots - left as usize;
    let more = |r: &midshift_proto::ota::v1::Rollout| r.counts.is_some_and(|c| assigned(c.waiting) > before);
    rollouts.until(ID, ASK_EVERY, OFFERED_WITHIN, more).await?;
    let first_s = ready.elapsed().as_secs_f64();
    let all = |r: &midshift_proto::ota::v1::Rollout| r.counts.is_some_and(|c| c.waiting == 0);
    rollouts.until(ID, ASK_EVERY, OFFERED_WITHIN, all).await?;
    let (all_s, cpu_s) = (ready.elapsed().as_secs_f64(), server.cpu_s()?);
    until_offered(&mut robots_child, robots).await?;
    let offered_s = ready.elapsed().as_secs_f64();
    drop(server);
    floor.read().await?.check(&floor.people, robots, &mut robots_child)?;
    Ok(Some(Cut { before: before as f64, ready_s: (ready - begun).as_secs_f64(), first_s, all_s, cpu_s, offered_s }))
}
