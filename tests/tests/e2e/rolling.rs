//! Roll-outs under way on a split stack with a crowd of simulated robots at work, while its processes are killed: a good one, then a bad one.

use crate::harness::{channel, until};
use crate::robots::Robots;
use crate::rolled_out::{begin_rollout, call, done, trust};
use crate::stack::Stack;
use anyhow::{Context, ensure};
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::rollout::rows::RolloutRobot;
use midshift_core::rows::Table;
use midshift_core::site::Site;
use midshift_process::clock::clock;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::{GetRolloutRequest, RolloutCounts};
use midshift_sim::journal::{self, Effect};
use midshift_store::{PostgresConfig, PostgresStore, Store};
use std::collections::BTreeMap;
use std::fmt::{Display, Formatter};
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;

/// Of every hundred robots that a wave may have: the canary, a tenth, the rest.
const WAVES: &str = "1,10%,rest";
/// A roll-out to every robot of a crowd may take so long.
const LIMIT: Duration = Duration::from_secs(900);
const LOOK: Duration = Duration::from_millis(200);
/// From a robot's decision to switch, which must fall within the life of its permission, to what its body writes of it, ms.
const BEGIN_MS: u64 = 2_000;

/// Sample releases, and who robots of a site believe: `samples` gets `keys`, `repository` and `trust.json`.
pub fn prepare(samples: &Path, site: &Site) -> anyhow::Result<()> {
    done(&["bundle", "samples", &samples.display().to_string(), "--config-only"])?;
    Ok(trust(samples, site)?.write(&samples.join("trust.json"))?)
}

/// A roll-out as it is; none while nobody answers.
pub async fn seen(public: SocketAddr, id: &str) -> anyhow::Result<Option<Seen>> {
    let request = GetRolloutRequest { rollout_id: id.to_owned() };
    let answer = RolloutServiceClient::new(channel(public)?).get_rollout(request).await;
    let rollout = answer.ok().and_then(|answer| answer.into_inner().rollout);
    Ok(rollout.map(|rollout| Seen {
        wave: rollout.wave,
        in_flight: rollout.in_flight,
        counts: rollout.counts.unwrap_or_default(),
    }))
}

/// How far a roll-out is.
#[derive(Debug)]
pub struct Seen {
    /// From 0.
    pub wave: u32,
    /// Robots whose drains it has asked for, those that still wait for the rules of their area among them.
    pub in_flight: u32,
    /// Robots by how far they are.
    pub counts: RolloutCounts,
}

/// The roll-out of one release, looked at again and again.
pub struct Rolling {
    id: &'static str,
    public: SocketAddr,
    robots: usize,
    looking: AbortOnDropHandle<anyhow::Result<u32>>,
    enough: CancellationToken,
}

impl Display for Seen {
    fn fmt(&self, f: &mut Formatter<'_>) -> std::fmt::Result {
        let (attempted, kept) = (self.counts.attempted, self.counts.committed);
        write!(f, "wave {}, {} asked, {attempted} permitted, {kept} keep it", self.wave, self.in_flight)
    }
}

impl Rolling {
    /// Pushes the releases of `samples`, and begins with this one.
    pub async fn begin(stack: &Stack, samples: &Path, id: &'static str, robots: usize) -> anyhow::Result<Self> {
        let public = stack.public.to_string();
        done(&["bundle", "push", "--server", &public, &samples.join("repository").display().to_string()])?;
        let quick = ["--waves", WAVES, "--soak", "5s", "--probation", "5s", "--exposure-tasks", "0"];
        done(&[&["rollout", "create", "--server", &public, id][..], &quick].concat())?;
        begin_rollout(&public, id)?;
        let (enough, address) = (CancellationToken::new(), stack.public);
        let tenth = robots.div_ceil(10);
        let sizes = [1, tenth, robots.saturating_sub(1 + tenth)];
        let most = looked_at(address, id, sizes, enough.clone());
        Ok(Self { id, public: address, robots, looking: AbortOnDropHandle::new(tokio::spawn(most)), enough })
    }

    /// How far it is, for a person; an error if more were out of work for it than may be.
    pub async fn stands(&self) -> anyhow::Result<String> {
        ensure!(!self.looking.is_finished(), "{}: nobody looks at it any more", self.id);
        let Some(seen) = seen(self.public, self.id).await? else { return Ok("nobody says".to_owned()) };
        Ok(format!("    {}, of {} robots: {seen}", self.id, self.robots))
    }

    /// Waits for its end with this exit code of `rollout wait`; how far it came. More robots asked than its wave has is an error.
    pub async fn ends(self, code: i32) -> anyhow::Result<RolloutCounts> {
        let (public, id) = (self.public.to_string(), self.id);
        let limit = format!("{}s", LIMIT.as_secs());
        until("somebody answers", LIMIT, || seen(self.public, id)).await?;
        let waited =
            tokio::task::block_in_place(|| call(&["rollout", "wait", "--server", &public, id, "--timeout", &limit]))?;
        let said = String::from_utf8_lossy(&waited.stderr).into_owned();
        ensure!(waited.status.code() == Some(code), "{id}: {:?} {said}", waited.status.code());
        self.enough.cancel();
        let most = self.looking.await.context("looking at it")??;
        // It is over when each robot is past its probation; what each keeps it writes a moment later.
        let counts = until("what each robot keeps", LIMIT, async || {
            let seen = seen(self.public, id).await?;
            Ok(seen.map(|seen| seen.counts).filter(|counts| counts.committing == 0))
        })
        .await?;
        say!(
            "{id}: {} of {} robots keep it, {} were permitted, at most {most} were asked at once",
            counts.committed,
            self.robots,
            counts.attempted
        );
        Ok(counts)
    }
}

/// The most robots that its drains were ever asked of at once, those that still waited for the area among them. An error when they are more than its wave, of
/// which these are the sizes.
pub async fn looked_at(
    public: SocketAddr,
    id: &str,
    sizes: [usize; 3],
    enough: CancellationToken,
) -> anyhow::Result<u32> {
    let mut most = 0;
    let mut look = tokio::time::interval(LOOK);
    while enough.run_until_cancelled(look.tick()).await.is_some() {
        let Some(seen) = seen(public, id).await? else { continue };
        let wave = sizes.get(seen.wave as usize).copied().unwrap_or_default();
        ensure!(seen.in_flight as usize <= wave, "{id}: its wave has {wave} robots: {seen:?}");
        most = most.max(seen.in_flight);
    }
    Ok(most)
}

/// What the planner keeps of each robot of a roll-out.
async fn rows(stack: &Stack, site: &Site, id: &str) -> anyhow::Result<BTreeMap<RobotId, RolloutRobot>> {
    let store = PostgresStore::open(&PostgresConfig::new(stack.url()), site.site_id().clone(), clock(1000)).await?;
    let snapshot = store.snapshot(&[Table::RolloutRobot]).await?;
    store.close().await;
    let rows = snapshot.rows.iter().map(|row| row.decode::<RolloutRobot>()).collect::<Result<Vec<_>, _>>()?;
    Ok(rows.into_iter().filter(|row| row.rollout_id.as_str() == id).map(|row| (row.robot_id.clone(), row)).collect())
}

/// The most robots that were out of work for a roll-out at once: from the moment at which each got no new work until its probation was over.
pub async fn most_out_of_work(stack: &Stack, site: &Site, id: &str) -> anyhow::Result<usize> {
    let mut turns = Vec::new();
    for row in rows(stack, site, id).await?.values() {
        if let Some((out, back)) = row.moments.draining.zip(row.moments.on_trial) {
            turns.extend([(out.0, 1), (back.0, -1)]);
        }
    }
    // Who comes back makes room for who goes in the same millisecond.
    turns.sort_unstable();
    let (mut now, mut most) = (0_i64, 0);
    for (_, turn) in turns {
        now += turn;
        most = most.max(now);
    }
    Ok(usize::try_from(most)?)
}

/// By the bodies' own journals: how often each robot began to run this release, which it did while its drain held it, within the life of its
/// permission, and before the server heard of it.
pub async fn ran_in_their_drains(
    stack: &Stack,
    site: &Site,
    robots: &Robots,
    id: &str,
    version: &str,
) -> anyhow::Result<BTreeMap<RobotId, usize>> {
    let rows = rows(stack, site, id).await?;
    let mut ran = BTreeMap::new();
    for path in robots.journals() {
        for entry in journal::read(&path)? {
            let (Effect::Ran { version: began }, Some(robot)) = (&entry.effect, &entry.robot_id) else { continue };
            if began != version {
                continue;
            }
            *ran.entry(robot.clone()).or_insert(0) += 1;
            let moments =
                &rows.get(robot).with_context(|| format!("{robot} ran {version} and is not in {id}"))?.moments;
            let held =
                moments.held.with_context(|| format!("{robot} ran {version} and was never held: {moments:?}"))?;
            ensure!(held.0 <= entry.utc_ms, "{robot} ran {version} at {} before {moments:?}", entry.utc_ms);
            let permitted = moments
                .granted_link
                .with_context(|| format!("{robot} ran {version} and was never permitted: {moments:?}"))?;
            let after_ms = entry.utc_ms - permitted.wall_unix_ms.0;
            ensure!(
                (0..=(limits::ACTIVATION_VALID.as_ms() + BEGIN_MS).cast_signed()).contains(&after_ms),
                "{robot} ran {version} {after_ms} ms after its permission: {moments:?}"
            );
            ensure!(moments.switched.is_none_or(|at| entry.utc_ms <= at.0), "{robot} ran {version} again: {moments:?}");
        }
    }
    Ok(ran)
}
