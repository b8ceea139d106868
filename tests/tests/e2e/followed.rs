//! Fleet stop of a split stack, on a folder of its own as on another host: of two processes beside it one follows, and when that is killed the other does.

use crate::harness::{folder, until};
use crate::kill::{all_over, at_work, judge, submit};
use crate::robots::{Robots, with_robots};
use crate::rolled_out::done;
use crate::stack::Stack;
use crate::stopped::{StopServer, judge_stops, until_held};
use midshift_core::site::{DEMO, text};
use std::collections::BTreeSet;
use std::time::Duration;

const ROBOTS: usize = 6;
const TASKS: usize = 24;
const LIMIT: Duration = Duration::from_secs(60);

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_beside_a_split_stack_is_followed_by_one_process_and_by_the_next_when_that_is_killed()
-> anyhow::Result<()> {
    let dir = folder()?;
    let site = with_robots(DEMO, ROBOTS)?;
    let stack = Stack::start(dir.path(), &text::render(&site), &["--no-software"], &[]).await?;
    let apart = dir.path().join("apart");
    std::fs::create_dir(&apart)?;
    std::fs::copy(&stack.site, apart.join("site.toml"))?;
    let mut first = stack.follower(0, &apart)?;
    until("the first one to follow", LIMIT, async || {
        Ok(apart.join("data/stop/principals.snapshot").exists().then_some(()))
    })
    .await?;
    let _second = stack.follower(1, &apart)?;
    until("the second one to wait", LIMIT, async || {
        let said = std::fs::read_to_string(apart.join("follower-1.log")).unwrap_or_default();
        Ok(said.contains("another process follows this stop service").then_some(()))
    })
    .await?;
    let stops = StopServer::start(&apart, stack.public).await?;
    let robots = Robots::start_beside(dir.path(), stack.robots, stack.public, Some(stops.address), &site).await?;
    submit(stack.public, &site, 7, TASKS).await?;
    at_work(stack.public, 4, &BTreeSet::new()).await?;

    let stop_id = stops.stop(&["--all"])?;
    until_held(stack.public, &robots.ids(), &format!("stop:{stop_id}")).await?;
    first.kill()?;
    stops.reset(&stop_id)?;
    until_held(stack.public, &robots.ids(), &format!("resume:{stop_id}")).await?;
    let public = stack.public.to_string();
    done(&["task", "resume", "--server", &public, "--stop-id", &stop_id, "--reason", "all clear"])?;

    let ended = all_over(stack.public, TASKS).await?;
    judge(&ended, &BTreeSet::new(), &site, &robots)?;
    judge_stops(robots.journals())?;
    done(&["stop", "verify", "--data", &apart.join("data").display().to_string()])
}
