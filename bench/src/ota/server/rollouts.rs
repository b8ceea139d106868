//! Roll-outs as a program asks for them.

use crate::child::Child;
use anyhow::{Context, ensure};
use midshift_proto::convert::duration;
use midshift_proto::ota::v1;
use midshift_proto::ota::v1::rollout_service_client::RolloutServiceClient;
use midshift_proto::ota::v1::rollout_wave::Size;
use std::time::Duration;
use tokio::time::{Instant, sleep};
use tonic::Code;
use tonic::transport::Channel;

/// Most of one page.
const PAGE: u32 = 1_000;
/// A release that was pushed is known by then.
const KNOWN_WITHIN: Duration = Duration::from_secs(10);
/// What is written as the reason of everything.
const WHY: &str = "measured";

/// The way to one server's roll-outs.
pub struct Rollouts(RolloutServiceClient<Channel>);

/// Waves of a roll-out.
pub fn waves(sizes: &[Size]) -> Vec<v1::RolloutWave> {
    sizes.iter().map(|size| v1::RolloutWave { size: Some(size.clone()) }).collect()
}

/// A roll-out of a bundle that waits for nobody's work, and watches a wave for `soak_ms`.
pub fn spec(bundle: String, sizes: &[Size], soak_ms: u64) -> v1::RolloutSpec {
    v1::RolloutSpec {
        bundle,
        waves: waves(sizes),
        allow_full_push: sizes.len() == 1,
        probation: Some(duration(1_000)),
        soak: Some(duration(soak_ms)),
        exposure_tasks: Some(0),
        ..v1::RolloutSpec::default()
    }
}

impl Rollouts {
    /// Over a connection of its own.
    pub async fn connect(server: &Child) -> anyhow::Result<Self> {
        Ok(Self(RolloutServiceClient::new(server.channel().await?)))
    }
    /// Writes one down, once the server knows its bundle.
    pub async fn create(&mut self, id: &str, spec: v1::RolloutSpec) -> anyhow::Result<()> {
        let end = Instant::now() + KNOWN_WITHIN;
        loop {
            let request = v1::CreateRolloutRequest { rollout_id: id.to_owned(), spec: Some(spec.clone()) };
            match self.0.create_rollout(request).await {
                Err(status) if status.code() == Code::NotFound && Instant::now() < end => {
                    sleep(Duration::from_millis(20)).await;
                }
                answer => return answer.map(drop).context("creating a roll-out"),
            }
        }
    }
    /// Brings it to where it can start.
    pub async fn submit_and_approve(&mut self, id: &str) -> anyhow::Result<()> {
        let (rollout_id, etag, reason) = (id.to_owned(), String::new(), WHY.to_owned());
        let submit =
            v1::SubmitRolloutRequest { rollout_id: rollout_id.clone(), etag: etag.clone(), reason: reason.clone() };
        self.0.submit_rollout(submit).await.context("submitting a roll-out")?;
        let approve = v1::ApproveRolloutRequest { rollout_id, etag, reason };
        self.0.approve_rollout(approve).await.context("approving a roll-out")?;
        Ok(())
    }
    /// Starts a roll-out that was approved.
    pub async fn start(&mut self, id: &str) -> anyhow::Result<()> {
        let (rollout_id, reason) = (id.to_owned(), WHY.to_owned());
        let request = v1::StartRolloutRequest { rollout_id, etag: String::new(), reason, supersede: false };
        self.0.start_rollout(request).await.context("starting a roll-out")?;
        Ok(())
    }
    /// Ends it early.
    pub async fn abort(&mut self, id: &str) -> anyhow::Result<()> {
        let etag = self.get(id).await?.etag;
        let request = v1::AbortRolloutRequest { rollout_id: id.to_owned(), etag, reason: WHY.to_owned() };
        self.0.abort_rollout(request).await.context("aborting a roll-out")?;
        Ok(())
    }
    /// Writes one down that takes a completed one back.
    pub async fn take_back(&mut self, of: &str, id: &str) -> anyhow::Result<()> {
        let request = v1::RollBackRolloutRequest { rollout_id: of.to_owned(), new_rollout_id: id.to_owned() };
        self.0.roll_back_rollout(request).await.context("taking a roll-out back")?;
        Ok(())
    }
    /// As it is.
    pub async fn get(&mut self, id: &str) -> anyhow::Result<v1::Rollout> {
        let request = v1::GetRolloutRequest { rollout_id: id.to_owned() };
        let answer = self.0.get_rollout(request).await.context("asking for a roll-out")?;
        answer.into_inner().rollout.context("an answer without a roll-out")
    }
    /// How many robots are where.
    pub async fn counts(&mut self, id: &str) -> anyhow::Result<v1::RolloutCounts> {
        Ok(self.get(id).await?.counts.unwrap_or_default())
    }
    /// Asks again and again until `is_so`; what was counted then.
    pub async fn until(
        &mut self,
        id: &str,
        every: Duration,
        within: Duration,
        is_so: impl Fn(&v1::Rollout) -> bool,
    ) -> anyhow::Result<v1::Rollout> {
        let end = Instant::now() + within;
        loop {
            let rollout = self.get(id).await?;
            if is_so(&rollout) {
                return Ok(rollout);
            }
            ensure!(Instant::now() < end, "{id} does not get on: {:?} {:?}", rollout.phase(), rollout.counts);
            sleep(every).await;
        }
    }
    /// Its robots.
    pub async fn robots(&mut self, id: &str) -> anyhow::Result<Vec<v1::RolloutRobot>> {
        let (mut all, mut page_token) = (Vec::new(), String::new());
        loop {
            let request = v1::ListRolloutRobotsRequest {
                rollout_id: id.to_owned(),
                robot_id: String::new(),
                page_size: PAGE,
                page_token,
            };
            let page = self.0.list_rollout_robots(request).await.context("listing robots")?.into_inner();
            all.extend(page.robots);
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(all);
            }
        }
    }
    /// What robots run, as far as the server knows.
    pub async fn software(&mut self) -> anyhow::Result<Vec<v1::RobotSoftware>> {
        let (mut all, mut page_token) = (Vec::new(), String::new());
        loop {
            let request = v1::ListRobotSoftwareRequest { robot_id: String::new(), page_size: PAGE, page_token };
            let page = self.0.list_robot_software(request).await.context("listing software")?.into_inner();
            all.extend(page.software);
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok(all);
            }
        }
    }
}
