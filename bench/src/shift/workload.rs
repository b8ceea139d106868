//! The workloads of a shift: how many tasks are asked for, when, and how urgent each is.

use super::clock::VirtualClock;
use super::floor::TaskSource;
use super::task_records::TaskRecords;
use anyhow::Context;
use midshift_core::ids::TaskId;
use midshift_core::task::spec::Class;
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as Face;
use midshift_proto::task::v1::{SubmitTaskRequest, submit_task_request::Body};
use midshift_task::TaskService;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::sync::Arc;
use std::time::Duration;
use tokio::time::Instant;

/// Waiting tasks for each robot while a shift is saturated.
const BACKLOG_PER_ROBOT: usize = 3;
/// Priority of urgent tasks, of 0 to 9; all others have that of their list.
const URGENT_PRIORITY: i32 = 0;
/// Priority of a task that says none.
const PRIORITY_UNSAID: i32 = 5;

/// When tasks come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Arrivals {
    /// There are always some that wait, a fixed number for each robot.
    Saturated,
    /// A Poisson process of so many in an hour.
    Steady {
        /// Tasks in an hour, on average.
        per_hour: f64,
    },
    /// So many at once, again and again.
    Waves {
        /// Tasks of each wave.
        tasks: usize,
        /// Time between two waves.
        every: Duration,
    },
}

/// What is asked of a fleet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Demand {
    /// When tasks come.
    pub arrivals: Arrivals,
    /// Of a thousand tasks so many are urgent.
    pub urgent_permille: u32,
}

/// Asks for tasks, one after the other.
pub struct Client {
    tasks: TaskService,
    source: TaskSource,
    records: Arc<TaskRecords>,
    clock: Arc<VirtualClock>,
    rng: ChaCha8Rng,
    urgent_permille: u32,
    asked: u64,
}

impl Client {
    /// A client that has asked for nothing yet.
    pub fn new(
        tasks: TaskService,
        source: TaskSource,
        records: Arc<TaskRecords>,
        clock: Arc<VirtualClock>,
        seed: u64,
    ) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed ^ 0x636c_6965_6e74);
        Self { tasks, source, records, clock, rng, urgent_permille: 0, asked: 0 }
    }

    /// Asks for what is demanded until it is dropped.
    ///
    /// # Errors
    /// A task that is refused.
    pub async fn run(mut self, demand: Demand, robots: usize) -> anyhow::Result<()> {
        self.urgent_permille = demand.urgent_permille;
        // When the next ones come: by the time, however long a submit takes.
        let mut next = Instant::now();
        match demand.arrivals {
            Arrivals::Saturated => loop {
                while self.records.counts().waiting < robots * BACKLOG_PER_ROBOT {
                    self.submit().await?;
                }
                self.records.changed().await;
            },
            Arrivals::Steady { per_hour } => loop {
                let gap_h = -(1.0 - self.rng.random::<f64>()).ln() / per_hour.max(1e-6);
                next += Duration::from_secs_f64(gap_h * 3_600.0);
                tokio::time::sleep_until(next).await;
                self.submit().await?;
            },
            Arrivals::Waves { tasks, every } => loop {
                for _ in 0..tasks {
                    self.submit().await?;
                }
                next += every;
                tokio::time::sleep_until(next).await;
            },
        }
    }

    async fn submit(&mut self) -> anyhow::Result<()> {
        let (mut request, goals) = self.source.next_task();
        self.asked += 1;
        let task_id = TaskId::parse(&format!("TASK-{:07}", self.asked))?;
        let is_urgent = self.rng.random_range(0..1_000) < self.urgent_permille;
        let priority = priority_mut(&mut request).context("a task of a form without a priority")?;
        if is_urgent {
            *priority = Some(URGENT_PRIORITY);
        }
        let class = Class::from_priority(priority.unwrap_or(PRIORITY_UNSAID) as u8, 0);
        request.task_id = task_id.to_string();
        self.records.add(task_id, class, goals, self.clock.elapsed_ms());
        self.tasks.submit_task(local(request)).await?;
        Ok(())
    }
}

fn priority_mut(request: &mut SubmitTaskRequest) -> Option<&mut Option<i32>> {
    match &mut request.body {
        Some(Body::Flat(flat)) => Some(&mut flat.priority),
        Some(Body::Spec(spec)) => Some(&mut spec.priority),
        Some(Body::Nested(_) | Body::Typed(_)) | None => None,
    }
}
