//! What goes on in a long run: submits, watches that come and go, roll-outs and ways back.

use crate::child::Child;
use crate::ota::release::label;
use crate::ota::server::rollouts::{Rollouts, spec};
use crate::submit::transports;
use anyhow::Context;
use midshift_core::site::Site;
use midshift_proto::ota::v1::RolloutPhase;
use midshift_proto::ota::v1::rollout_wave::Size;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{ListTasksRequest, SubmitTaskRequest, TaskState, WatchTasksRequest};
use midshift_proto::telemetry::v1::WatchRobotsRequest;
use midshift_proto::telemetry::v1::telemetry_service_client::TelemetryServiceClient;
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};
use tokio_util::sync::CancellationToken;
use tokio_util::task::AbortOnDropHandle;
use tonic::transport::Channel;

/// Different transports that are submitted over and over.
const TRANSPORTS: usize = 1_000;
/// Tasks that are open when nobody submits any more are over by then, and a roll-out.
const ENDS_WITHIN: Duration = Duration::from_secs(600);
/// How often that is looked at.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// A pair of watches comes so often, and stays so long.
const WATCH_EVERY: Duration = Duration::from_secs(10);
const WATCH_FOR: Duration = Duration::from_secs(60);
/// Most of one page.
const PAGE: u32 = 1_000;

/// Tasks that were acknowledged.
pub struct Submitted {
    client: TaskServiceClient<Channel>,
    requests: Vec<SubmitTaskRequest>,
    ids: BTreeSet<String>,
    took_ms: Vec<f64>,
}

impl Submitted {
    /// Begins with none.
    pub async fn new(server: &Child, site: &Site) -> anyhow::Result<Self> {
        let client = TaskServiceClient::new(server.channel().await?);
        Ok(Self { client, requests: transports(site, TRANSPORTS)?, ids: BTreeSet::new(), took_ms: Vec::new() })
    }

    /// Submits one more.
    pub async fn submit(&mut self) -> anyhow::Result<()> {
        let mut request = self.requests[self.ids.len() % self.requests.len()].clone();
        request.request_id = format!("soak-{:08}", self.ids.len());
        let begun = Instant::now();
        let answer = self.client.submit_task(request).await?.into_inner();
        self.took_ms.push(begun.elapsed().as_secs_f64() * 1e3);
        self.ids.insert(answer.task.context("an answer without a task")?.task_id);
        Ok(())
    }

    /// How long each took since the last time that this was asked, milliseconds.
    pub fn take_times(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.took_ms)
    }

    /// How many.
    pub fn count(&self) -> usize {
        self.ids.len()
    }

    /// Waits until all have an end. Returns how many are not there, and how many have none in time.
    pub async fn await_ends(&self, server: &Child) -> anyhow::Result<(usize, usize)> {
        let end = Instant::now() + ENDS_WITHIN;
        loop {
            let (there, over) = self.list_all(server).await?;
            let (missing, unfinished) = (self.ids.difference(&there).count(), self.ids.difference(&over).count());
            if unfinished == missing || Instant::now() >= end {
                return Ok((missing, unfinished - missing));
            }
            sleep(LOOK_EVERY).await;
        }
    }

    /// Lists the ids of all tasks, and of those that have an end.
    async fn list_all(&self, server: &Child) -> anyhow::Result<(BTreeSet<String>, BTreeSet<String>)> {
        let mut client = TaskServiceClient::new(server.channel().await?);
        let (mut there, mut over, mut page_token) = (BTreeSet::new(), BTreeSet::new(), String::new());
        loop {
            let request = ListTasksRequest { filter: None, page_size: PAGE, page_token };
            let page = client.list_tasks(request).await?.into_inner();
            for task in page.tasks {
                if is_over(task.state()) {
                    over.insert(task.task_id.clone());
                }
                there.insert(task.task_id);
            }
            page_token = page.next_page_token;
            if page_token.is_empty() {
                return Ok((there, over));
            }
        }
    }
}

fn is_over(state: TaskState) -> bool {
    matches!(state, TaskState::Succeeded | TaskState::Failed | TaskState::Canceled | TaskState::Expired)
}

/// Something that goes on beside until it is stopped.
pub struct Beside<T> {
    stop: CancellationToken,
    task: AbortOnDropHandle<anyhow::Result<T>>,
}

impl<T: Send + 'static> Beside<T> {
    fn begin<F: Future<Output = anyhow::Result<T>> + Send + 'static>(
        work: impl FnOnce(CancellationToken) -> F,
    ) -> Self {
        let stop = CancellationToken::new();
        let task = AbortOnDropHandle::new(tokio::spawn(work(stop.clone())));
        Self { stop, task }
    }

    /// Lets it come to its end.
    pub async fn stop(self) -> anyhow::Result<T> {
        self.stop.cancel();
        self.task.await.context("what went on beside panicked")?
    }

    /// Whether it goes on; what does not has failed, and [`Self::stop`] says how.
    pub fn goes_on(&self) -> bool {
        !self.task.is_finished()
    }
}

/// Roll-outs and ways back so far.
#[derive(Debug, Default)]
pub struct Released {
    pub ended: usize,
    pub aborted: usize,
}

/// Rolls a release out to all robots and takes it back, again and again, with a pause between.
pub async fn release_again_and_again(server: &Child, pause: Duration) -> anyhow::Result<Beside<Released>> {
    let mut rollouts = Rollouts::connect(server).await?;
    Ok(Beside::begin(async move |stop| {
        let mut released = Released::default();
        for number in 1.. {
            let (id, back) = (format!("soak-{number}"), format!("soak-{number}-back"));
            for (id, of) in [(&id, None), (&back, Some(&id))] {
                match of {
                    None => rollouts.create(id, spec(label(0), &[Size::Rest(true)], 0)).await?,
                    Some(of) => rollouts.take_back(of, id).await?,
                }
                rollouts.submit_and_approve(id).await?;
                rollouts.start(id).await?;
                let is_over = |phase| matches!(phase, RolloutPhase::Completed | RolloutPhase::Aborted);
                let rollout = rollouts.until(id, LOOK_EVERY, ENDS_WITHIN, |r| is_over(r.phase())).await?;
                released.ended += 1;
                released.aborted += usize::from(rollout.phase() == RolloutPhase::Aborted);
                if timeout(pause, stop.cancelled()).await.is_ok() {
                    return Ok(released);
                }
            }
        }
        Ok(released)
    }))
}

/// Opens watches of tasks and of robots, reads them, and lets go of them after a while.
pub async fn watch_again_and_again(server: &Child) -> anyhow::Result<Beside<()>> {
    let channel = server.channel().await?;
    Ok(Beside::begin(async move |stop| {
        let mut watches = JoinSet::new();
        while timeout(WATCH_EVERY, stop.cancelled()).await.is_err() {
            watches.spawn(timeout(WATCH_FOR, watch_tasks(channel.clone())));
            watches.spawn(timeout(WATCH_FOR, watch_robots(channel.clone())));
            while let Some(ended) = watches.try_join_next() {
                // One that was not over in its time was as it should be.
                if let Ok(watched) = ended? {
                    watched?;
                }
            }
        }
        Ok(())
    }))
}

async fn watch_tasks(channel: Channel) -> anyhow::Result<()> {
    let mut watch = TaskServiceClient::new(channel).watch_tasks(WatchTasksRequest::default()).await?.into_inner();
    while watch.message().await?.is_some() {}
    Ok(())
}

async fn watch_robots(channel: Channel) -> anyhow::Result<()> {
    let request = WatchRobotsRequest::default();
    let mut watch = TelemetryServiceClient::new(channel).watch_robots(request).await?.into_inner();
    while watch.message().await?.is_some() {}
    Ok(())
}
