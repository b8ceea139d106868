//! From `rollout start` to robots that have their directive.
//!
//! Offered is what a robot has heard, told by the robot; a directive is sent only after its row was committed, so everybody was assigned
//! when the last was offered it. The database is held against that afterwards.

use super::rollouts::{Rollouts, spec};
use super::scene::{Floor, GROUPS, attached};
use super::trace::Trace;
use crate::child::Child;
use crate::ota::args::OtaArgs;
use crate::ota::hearers::{self, NEVER};
use crate::ota::release;
use anyhow::{Context, ensure};
use midshift_proto::ota::v1::rollout_wave::Size;
use std::time::Duration;
use tokio::time::{Instant, sleep};

/// All robots have heard by then.
pub const OFFERED_WITHIN: Duration = Duration::from_secs(300);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(5);
/// The sample that is rolled out.
pub const SAMPLE: usize = 0;
/// The roll-out.
pub const ID: &str = "bench-1";

/// What robots do with a directive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Robots {
    /// They hear it and say nothing.
    Hear,
    /// They say at once that they have taken it, as real ones do.
    Take,
}

/// What one roll-out came to.
#[derive(Clone, Debug)]
pub struct Assigned {
    /// Cores of the server before it, with the robots idle.
    pub idle_cores: f64,
    /// Seconds and CPU seconds until it could start.
    pub written_s: f64,
    pub written_cpu_s: f64,
    /// Seconds from the request to start until its answer.
    pub answered_s: f64,
    /// Until the last robot of the first wave had its directive, and CPU seconds.
    pub first_s: f64,
    pub first_cpu_s: f64,
    /// Until the last of all robots had, and CPU seconds.
    pub all_s: f64,
    pub all_cpu_s: f64,
    /// Group commits until then.
    pub groups: f64,
    /// Cores of the server afterwards, while the robots count as fetching.
    pub after_cores: f64,
}

/// What the roll-out is asked to be: a small wave, and everybody else.
pub fn spec_of(canary: u32, robots: usize) -> midshift_proto::ota::v1::RolloutSpec {
    let canary = canary.min(robots as u32 / 10).max(1);
    spec(release::label(SAMPLE), &[Size::Count(canary), Size::Rest(true)], 600_000)
}

/// Assigns a release to so many robots on a new server.
pub async fn measure(args: &OtaArgs, robots: usize, what: Robots) -> anyhow::Result<Assigned> {
    let floor = Floor::make(args.dir.as_ref(), robots)?;
    let mut server = floor.serve().await?;
    floor.people.push(&server).await?;
    let takes = (what == Robots::Take).then(|| floor.people.bundle(SAMPLE).as_str());
    let mut robots_child = floor.hearers(robots, takes)?;
    let mut rollouts = Rollouts::connect(&server).await?;
    attached(&mut server, &mut rollouts, robots).await?;
    let idle_cores = cores(&server, args.server.idle_seconds).await?;
    let trace = Trace::begin(server.pid());
    let begun = Instant::now();
    rollouts.create(ID, spec_of(args.server.canary, robots)).await?;
    rollouts.submit_and_approve(ID).await?;
    let written = Instant::now();
    let groups = server.ask(GROUPS)?;
    let started = Instant::now();
    rollouts.start(ID).await?;
    let answered_s = started.elapsed().as_secs_f64();
    until_offered(&mut robots_child, robots).await?;
    let groups = (server.ask(GROUPS)? - groups) as f64;
    let mut first = started;
    let mut all = started;
    for robot in rollouts.robots(ID).await? {
        let at = hearers::index(&robot.robot_id).context("a robot of another name")?;
        let age_us = robots_child.ask(&format!("age {at}"))?;
        ensure!(age_us != NEVER, "{} was told nothing", robot.robot_id);
        let told = Instant::now() - Duration::from_micros(age_us);
        all = all.max(told);
        if robot.wave == 0 {
            first = first.max(told);
        }
    }
    let after_cores = cores(&server, args.server.idle_seconds).await?;
    let counts = rollouts.counts(ID).await?;
    ensure!(counts.staging as usize == robots, "not everybody was assigned: {counts:?}");
    let assigned = Assigned {
        idle_cores,
        written_s: (written - begun).as_secs_f64(),
        written_cpu_s: trace.between_s(begun, written),
        answered_s,
        first_s: (first - started).as_secs_f64(),
        first_cpu_s: trace.between_s(started, first),
        all_s: (all - started).as_secs_f64(),
        all_cpu_s: trace.between_s(started, all),
        groups,
        after_cores,
    };
    drop(server);
    floor.read().await?.check(&floor.people, robots, &mut robots_child)?;
    Ok(assigned)
}

/// Waits until all robots have their directive.
pub async fn until_offered(robots_child: &mut Child, robots: usize) -> anyhow::Result<()> {
    let end = Instant::now() + OFFERED_WITHIN;
    loop {
        let offered = robots_child.ask("offered")? as usize;
        if offered >= robots {
            return Ok(());
        }
        ensure!(Instant::now() < end, "{offered} of {robots} robots were offered it");
        sleep(LOOK_EVERY).await;
    }
}

/// Cores that a server keeps busy, over so many seconds.
async fn cores(server: &Child, seconds: u64) -> anyhow::Result<f64> {
    let (cpu_s, begun) = (server.cpu_s()?, Instant::now());
    sleep(Duration::from_secs(seconds.max(1))).await;
    Ok(server.cpu_since_s(cpu_s)? / begun.elapsed().as_secs_f64())
}
