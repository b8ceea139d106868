//! The work that `dev` gives itself over gRPC, like any other client: a steady backlog, a Poisson stream, or a task list.
//!
//! Invariant: background work has priority 7, so that a user's own task goes first. It stops when asked to, but never between a call and
//! its answer: what was submitted is what was acknowledged.

use anyhow::{Context, bail};
use midshift_cli::task_list::request;
use midshift_core::fleet::rows::Place;
use midshift_core::ids::TaskId;
use midshift_core::rows::Table;
use midshift_core::site::Site;
use midshift_core::time::Clock;
use midshift_proto::task::v1::task_service_client::TaskServiceClient;
use midshift_proto::task::v1::{self, SubmitTaskRequest, SubmitTasksRequest};
use midshift_sim::workload::{Workload, WorkloadConfig};
use midshift_store::Store;
use std::collections::{BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio_util::sync::CancellationToken;
use tonic::transport::Channel;

/// How much work there is to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pressure {
    /// So many open tasks, refilled as they end.
    KeepOpen(usize),
    /// So many an hour of site time, never more than the backlog.
    Rate {
        /// Tasks an hour of site time.
        per_hour: f64,
        /// Open tasks at most.
        backlog: usize,
    },
}

/// Where the tasks come from.
pub enum Source {
    /// Drawn for the site.
    Drawn(Box<Workload>),
    /// Read from a list, which may end.
    Listed(VecDeque<SubmitTaskRequest>),
}

impl Source {
    /// Drawn transports between the stations of a site.
    pub fn drawn(site: &Site, seed: u64) -> anyhow::Result<Self> {
        let workload = Workload::new(WorkloadConfig::background(seed), site)
            .context("the site has no two stations to carry between")?;
        Ok(Self::Drawn(Box::new(workload)))
    }
    fn next(&mut self) -> Option<SubmitTaskRequest> {
        match self {
            Self::Drawn(workload) => Some(request(&workload.next_transport())),
            Self::Listed(list) => list.pop_front(),
        }
    }
}

/// Tasks that the client was acknowledged for, one entry a request.
pub type Acknowledged = Arc<Mutex<Vec<TaskId>>>;

/// A client that keeps up the pressure.
pub struct Background {
    /// How much.
    pub pressure: Pressure,
    /// Where its tasks come from.
    pub source: Source,
    /// How the request ids of this run begin, and of no other.
    pub run_id: String,
    /// Both clocks.
    pub clock: Arc<dyn Clock>,
    /// What was acknowledged so far, for whoever reports.
    pub acknowledged: Acknowledged,
    /// Open tasks now, counted by whoever looks at the rows.
    pub open: Arc<dyn Fn() -> usize + Send + Sync>,
}

/// How often the client looks, real time.
const LOOK_EVERY: Duration = Duration::from_millis(50);
/// So long work waits for robots that do not come, real time.
const ROBOTS_COME: Duration = Duration::from_secs(30);
/// Tasks of one call.
const BURST: usize = 500;

/// Waits until fleet knows where each of so many robots stands, or until they have had time enough. A robot that nobody has heard of yet may stand in
/// a place that is given to another one.
pub async fn all_stand(store: &dyn Store, robots: usize) -> anyhow::Result<()> {
    let known = async {
        loop {
            let places = store.snapshot(&[Table::PlaceGrant]).await?;
            let mut standing = BTreeSet::new();
            for row in &places.rows {
                standing.extend(row.decode::<Place>()?.holders.into_iter().map(|holder| holder.robot_id));
            }
            if standing.len() >= robots {
                return Ok(());
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    };
    tokio::time::timeout(ROBOTS_COME, known).await.unwrap_or_else(|_| {
        tracing::warn!(robots, "not every robot has come; work begins without the others");
        Ok(())
    })
}

impl Background {
    /// Submits until `stop`, or until its list is over.
    pub async fn run(mut self, channel: Channel, stop: CancellationToken) -> anyhow::Result<()> {
        let mut client = TaskServiceClient::new(channel);
        let mut number = 0_u64;
        let mut due = self.clock.now().site;
        loop {
            let open = (self.open)();
            let mut wanted = match self.pressure {
                Pressure::KeepOpen(target) => target.saturating_sub(open),
                Pressure::Rate { backlog, .. } => {
                    let late = self.clock.now().site >= due && open < backlog;
                    usize::from(late)
                }
            };
            if let (Pressure::Rate { per_hour, .. }, true) = (self.pressure, wanted > 0 || self.clock.now().site >= due)
            {
                due = self.clock.now().site + self.gap(per_hour);
            }
            wanted = wanted.min(BURST);
            let mut items = Vec::with_capacity(wanted);
            for _ in 0..wanted {
                let Some(mut request) = self.source.next() else { break };
                number += 1;
                request.request_id = format!("{}{number}", self.run_id);
                items.push(SubmitTasksRequest { item: Some(request) });
            }
            if !items.is_empty() {
                let sent = items.len();
                let answer =
                    client.submit_tasks(tokio_stream::iter(items)).await.context("submitting the run's own work")?;
                self.note(&answer.into_inner(), sent)?;
            }
            tokio::select! {
                () = stop.cancelled() => return Ok(()),
                () = tokio::time::sleep(LOOK_EVERY) => {}
            }
        }
    }

    fn gap(&mut self, per_hour: f64) -> midshift_core::time::SiteDuration {
        match &mut self.source {
            Source::Drawn(workload) => workload.next_gap(per_hour),
            Source::Listed(_) => midshift_core::time::SiteDuration((3_600_000.0 / per_hour.max(1e-6)) as u64),
        }
    }

    fn note(&self, answer: &v1::SubmitTasksResponse, sent: usize) -> anyhow::Result<()> {
        use v1::submit_task_result::Outcome;
        let mut acknowledged = self.acknowledged.lock().unwrap_or_else(PoisonError::into_inner);
        for result in &answer.results {
            match &result.outcome {
                Some(Outcome::TaskId(id)) => acknowledged.push(TaskId::parse(id)?),
                Some(Outcome::Refusal(refusal)) => bail!("background task refused: {refusal:?}"),
                None => bail!("background task got no outcome"),
            }
        }
        if answer.results.len() != sent {
            bail!("sent {sent} tasks, {} answered", answer.results.len());
        }
        Ok(())
    }
}
