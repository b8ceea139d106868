//! The way back of idle robots: real agents with simulated bodies, on a floor whose rules let all of them out of work at once.

use super::rollouts::{Rollouts, spec};
use super::scene::{Floor, GROUPS, attached};
use crate::child::Child;
use crate::ota::args::OtaArgs;
use crate::ota::release;
use anyhow::ensure;
use midshift_proto::fleet::v1::fleet_service_client::FleetServiceClient;
use midshift_proto::fleet::v1::{AreaPolicy, PutAreaPolicyRequest, SoftwareRules};
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_proto::ota::v1::{Rollout, RolloutPhase};
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;
use tokio::time::Instant;

/// A way there or back takes no longer.
const WITHIN: Duration = Duration::from_secs(180);
/// How often a roll-out is looked at.
const LOOK_EVERY: Duration = Duration::from_millis(20);
/// All robots of an area may be out of work at once, thousandths.
const EVERYBODY_PERMILLE: u32 = 1_000;
/// A wave that is watched for so long stays on trial.
const LONG_MS: u64 = 24 * 3_600_000;

/// One way back.
#[derive(Clone, Debug)]
pub struct RollbackTimes {
    /// Seconds until half of the robots had said that they run what they kept.
    pub half_s: f64,
    /// Seconds until all had.
    pub all_s: f64,
    /// Group commits of the server meanwhile.
    pub groups: f64,
}

/// Both ways of the same robots.
#[derive(Clone, Debug)]
pub struct WentBack {
    /// Of a release on trial, aborted by a person.
    pub on_trial: RollbackTimes,
    /// Of a completed roll-out, taken back by another.
    pub committed: RollbackTimes,
}

/// Brings robots a release and takes it back, twice.
pub async fn measure(args: &OtaArgs) -> anyhow::Result<WentBack> {
    let robots = args.server.back_robots;
    let floor = Floor::make(args.dir.as_ref(), robots * 4)?;
    let mut server = floor.serve().await?;
    floor.people.push(&server).await?;
    let areas: BTreeSet<String> = floor.areas();
    no_budget(&server, &areas).await?;
    let _swarm = floor.swarm(robots)?;
    let mut rollouts = Rollouts::connect(&server).await?;
    attached(&mut server, &mut rollouts, robots).await?;
    let all = [Size::Rest(true)];
    let kept = versions(&mut rollouts).await?;
    ensure!(kept.values().all(|version| !version.is_empty()), "a robot has not said what it runs");

    let (id, count) = ("trial-1", robots as u32);
    begin(&mut rollouts, id, Some(spec(release::label(0), &all, LONG_MS))).await?;
    rollouts.until(id, LOOK_EVERY, WITHIN, |r| r.counts.is_some_and(|c| c.trial == count)).await?;
    let groups = server.ask(GROUPS)?;
    let begun = Instant::now();
    rollouts.abort(id).await?;
    let on_trial = back(&mut server, &mut rollouts, id, &kept, begun, groups).await?;
    rollouts.until(id, LOOK_EVERY, WITHIN, |r| r.phase() == RolloutPhase::Aborted).await?;

    let (id, back_id) = ("kept-1", "kept-1-back");
    begin(&mut rollouts, id, Some(spec(release::label(1), &all, 0))).await?;
    let is_kept = |r: &Rollout| r.phase() == RolloutPhase::Completed && r.counts.is_some_and(|c| c.committed == count);
    rollouts.until(id, LOOK_EVERY, WITHIN, is_kept).await?;
    let (groups, begun) = (server.ask(GROUPS)?, Instant::now());
    rollouts.take_back(id, back_id).await?;
    begin(&mut rollouts, back_id, None).await?;
    let committed = back(&mut server, &mut rollouts, back_id, &kept, begun, groups).await?;
    Ok(WentBack { on_trial, committed })
}

/// Writes one down if there is a spec, and starts it.
async fn begin(
    rollouts: &mut Rollouts,
    id: &str,
    spec: Option<midshift_proto::ota::v1::RolloutSpec>,
) -> anyhow::Result<()> {
    if let Some(spec) = spec {
        rollouts.create(id, spec).await?;
    }
    rollouts.submit_and_approve(id).await?;
    rollouts.start(id).await
}

/// Waits until all robots of a roll-out have said that they went back, and have come with the version they had before.
async fn back(
    server: &mut Child,
    rollouts: &mut Rollouts,
    id: &str,
    kept: &BTreeMap<String, String>,
    begun: Instant,
    groups: u64,
) -> anyhow::Result<RollbackTimes> {
    let (back, count) = (|r: &Rollout| r.counts.map_or(0, |c| c.rolled_back), kept.len() as u32);
    rollouts.until(id, LOOK_EVERY, WITHIN, |r| back(r) * 2 >= count).await?;
    let half_s = begun.elapsed().as_secs_f64();
    rollouts.until(id, LOOK_EVERY, WITHIN, |r| back(r) == count).await?;
    while versions(rollouts).await? != *kept {
        ensure!(begun.elapsed() < WITHIN, "a robot runs something else than before");
        tokio::time::sleep(LOOK_EVERY).await;
    }
    let all_s = begun.elapsed().as_secs_f64();
    Ok(RollbackTimes { half_s, all_s, groups: (server.ask(GROUPS)? - groups) as f64 })
}

/// What each robot runs, as it said.
async fn versions(rollouts: &mut Rollouts) -> anyhow::Result<BTreeMap<String, String>> {
    Ok(rollouts.software().await?.into_iter().map(|row| (row.robot_id, row.version)).collect())
}

/// Lets everybody out of work at once, in every area.
async fn no_budget(server: &Child, areas: &BTreeSet<String>) -> anyhow::Result<()> {
    let mut fleet = FleetServiceClient::new(server.channel().await?);
    for area_id in areas {
        let software = SoftwareRules { off_work_permille: Some(EVERYBODY_PERMILLE), ..SoftwareRules::default() };
        let policy = AreaPolicy { area_id: area_id.clone(), software: Some(software), ..AreaPolicy::default() };
        let request = PutAreaPolicyRequest { policy: Some(policy), ..PutAreaPolicyRequest::default() };
        fleet.put_area_policy(request).await?;
    }
    Ok(())
}
