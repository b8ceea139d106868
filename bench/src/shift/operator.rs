//! The simulated person at the screen: answers tasks in NEEDS_OPERATOR, by the call that any operator has.
//!
//! An answer comes some minutes after a task began to wait, and says what is true of the item:
//! 1. It was put down where it was to go: done by hand.
//! 2. A robot carries it: the task goes on there, once the server lets the robot go on. As long as the service does not show that the robot
//!    has begun with it, the robot was not heard since, and nothing is said: another robot would fetch a second item.
//! 3. Nobody carries it: it lies where it was picked, and the task begins anew.
//!
//! Invariant: the person knows the floor and what the service shows, and no row.

use super::clock::VirtualClock;
use super::task_records::TaskRecords;
use midshift_agent::body::{Body, Checked};
use midshift_core::ids::{RobotId, TaskId};
use midshift_core::step::StepKind;
use midshift_proto::access::local;
use midshift_proto::task::v1::task_service_server::TaskService as Face;
use midshift_proto::task::v1::{GetTaskRequest, Resolution, ResolveTaskRequest, Task};
use midshift_sim::fleet::Fleet;
use midshift_sim::world::lock;
use midshift_task::TaskService;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// The list of tasks that wait is looked at this often.
const ROUND: Duration = Duration::from_secs(5);
/// Seconds until a task that waits is answered: as long as a person on the floor takes to come.
const ANSWERS_AFTER_S: std::ops::RangeInclusive<u64> = 120..=300;

/// A person at the screen.
pub struct Operator {
    tasks: TaskService,
    fleet: Arc<Fleet>,
    records: Arc<TaskRecords>,
    clock: Arc<VirtualClock>,
    rng: ChaCha8Rng,
    /// When each task that waits is answered, milliseconds since the beginning.
    due_ms: BTreeMap<TaskId, u64>,
}

impl Operator {
    /// A person who has seen nothing yet.
    pub fn new(
        tasks: TaskService,
        fleet: Arc<Fleet>,
        records: Arc<TaskRecords>,
        clock: Arc<VirtualClock>,
        seed: u64,
    ) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6f70_6572_6174);
        Self { tasks, fleet, records, clock, rng, due_ms: BTreeMap::new() }
    }

    /// Answers what waits until it is dropped.
    ///
    /// # Errors
    /// A task that the service does not show.
    pub async fn run(mut self) -> anyhow::Result<()> {
        loop {
            tokio::time::sleep(ROUND).await;
            let waiting = self.records.tasks_that_ask();
            self.due_ms.retain(|task_id, _| waiting.contains(task_id));
            for task_id in waiting {
                let now_ms = self.clock.elapsed_ms();
                let rng = &mut self.rng;
                let comes_ms = || now_ms + 1_000 * rng.random_range(ANSWERS_AFTER_S);
                if *self.due_ms.entry(task_id.clone()).or_insert_with(comes_ms) <= now_ms {
                    self.answer(&task_id).await?;
                }
            }
        }
    }

    /// Answers one task, unless it must wait until its robot is heard. A refusal is asked again in the next round.
    async fn answer(&self, task_id: &TaskId) -> anyhow::Result<()> {
        let request = GetTaskRequest { task_id: task_id.to_string() };
        let task = self.tasks.get_task(local(request)).await?.into_inner().task.unwrap_or_default();
        let Some(resolution) = self.choose_resolution(task_id, &task) else { return Ok(()) };
        let request = ResolveTaskRequest {
            task_id: task_id.to_string(),
            etag: task.etag,
            resolution: resolution.into(),
            reason: "looked at the floor".to_owned(),
            ..ResolveTaskRequest::default()
        };
        if self.tasks.resolve_task(local(request)).await.is_ok() {
            self.records.note_answer();
        }
        Ok(())
    }

    fn choose_resolution(&self, task_id: &TaskId, task: &Task) -> Option<Resolution> {
        let found = match (self.is_delivered(task_id, task), self.is_carried(task_id)) {
            (true, _) => Resolution::Succeeded,
            (false, true) if task.opened_robot_id.is_empty() => return None,
            (false, true) => Resolution::Requeue,
            (false, false) if task.opened_robot_id.is_empty() => Resolution::Requeue,
            (false, false) => Resolution::RequeuePutBack,
        };
        task.allowed_resolutions.contains(&found.into()).then_some(found)
    }

    fn is_delivered(&self, task_id: &TaskId, task: &Task) -> bool {
        let place = StepKind::Action { name: "place".to_owned(), params: serde_json::Map::new() };
        let last = RobotId::parse(&task.robot_id).ok().and_then(|robot_id| self.fleet.robot(&robot_id));
        last.is_some_and(|robot| robot.check(&place, Some(task_id)) == Checked::Done)
    }

    fn is_carried(&self, task_id: &TaskId) -> bool {
        let is_for_task = |world| {
            let world = lock(world);
            world.carrying().any(|(_, carried)| carried.work.as_ref().is_some_and(|work| work.task_id == *task_id))
        };
        self.fleet.worlds().iter().any(is_for_task)
    }
}
