//! Processes of real agents with simulated bodies at a server, and the wait until it has all their sessions.

use crate::child::{Child, SESSIONS};
use anyhow::{Context, ensure};
use std::path::Path;
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// Processes that the robots are split over.
pub const SIMULATORS: usize = 2;
/// All robots are attached by then.
const ATTACH_WITHIN: Duration = Duration::from_secs(300);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Starts all robots of a site, beside the first core.
pub fn start_robots(server: &Child, map: &Path, robots: usize) -> anyhow::Result<Vec<Child>> {
    let (address, map) = (server.address.to_string(), map.to_str().context("a path that is no text")?);
    (0..SIMULATORS)
        .map(|part| {
            let of = |part: usize| (robots * part / SIMULATORS).to_string();
            let (all, from, to) = (robots.to_string(), of(part), of(part + 1));
            let role = ["robots", "--server", &address, "--site", map, "--robots", &all, "--from", &from, "--to", &to];
            Child::start(&role, Some(1 + part))
        })
        .collect()
}

/// Waits until a server has the sessions of so many robots.
pub async fn await_sessions(server: &mut Child, robots: usize) -> anyhow::Result<()> {
    let end = Instant::now() + ATTACH_WITHIN;
    while (server.ask(SESSIONS)? as usize) < robots {
        ensure!(Instant::now() < end, "{} of {robots} robots are attached", server.ask(SESSIONS)?);
        sleep(LOOK_EVERY).await;
    }
    Ok(())
}
