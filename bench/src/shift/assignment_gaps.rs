//! Watches for work that could go on and is not given: ready tasks that stay named for a robot which is soon free, and
//! robots that idle beside a ready task which is named for nobody. Read from what the planner explains to people.
//!
//! A question is a turn of the planner. So it is asked of small fleets only, whose planner has a turn at each event.

use super::control_plane::ControlPlane;
use super::expected_starts::{ExpectedStarts, StartCounts};
use super::task_records::TaskRecords;
use midshift_core::ids::{RobotId, TaskId};
use midshift_proto::fleet::v1::TaskExplanation;
use midshift_sim::fleet::Fleet;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// A task may be named so long for a robot that is soon free, milliseconds.
const NAMED_MAX_MS: u64 = 30_000;
/// A robot may idle so long, and a task wait, before they count, milliseconds.
const IDLE_MAX_MS: u64 = 5_000;
/// The fact of a reason that says what is waited for, and its words where that is a robot which is soon free.
const WAITS_FOR: (&str, &str) = ("waits_for", "it is free soon");

/// What was seen so far.
#[derive(Clone, Copy, Debug, Default)]
pub struct AssignmentGaps {
    /// Tasks that were named for longer than they may.
    pub named_too_long: u64,
    /// Time that robots idled beyond what they may, beside a task that they could do; summed over all, milliseconds.
    pub idle_ms: u64,
    /// Tasks that were told when they would get a robot.
    pub starts: StartCounts,
}

/// The watch over one fleet.
pub struct AssignmentWatch {
    fleet: Arc<Fleet>,
    records: Arc<TaskRecords>,
    /// Since when each task is named, and each robot without a task, milliseconds since the beginning.
    named: BTreeMap<TaskId, u64>,
    idle: BTreeMap<RobotId, u64>,
    too_long: BTreeSet<TaskId>,
    starts: ExpectedStarts,
    looked_ms: u64,
    idle_ms: u64,
}

impl AssignmentWatch {
    /// Nothing was seen yet.
    pub fn new(fleet: Arc<Fleet>, records: Arc<TaskRecords>) -> Self {
        let (named, idle, too_long, starts) = Default::default();
        Self { fleet, records, named, idle, too_long, starts, looked_ms: 0, idle_ms: 0 }
    }

    /// What was seen so far.
    pub fn gaps(&self) -> AssignmentGaps {
        let starts = self.starts.counts(&self.records, self.looked_ms);
        AssignmentGaps { named_too_long: self.too_long.len() as u64, idle_ms: self.idle_ms, starts }
    }

    /// Looks at tasks that wait and at robots that idle.
    ///
    /// # Errors
    /// The planner does not answer.
    pub async fn look_for_gaps(&mut self, plane: &ControlPlane, now_ms: u64) -> anyhow::Result<()> {
        let since_look_ms = now_ms - std::mem::replace(&mut self.looked_ms, now_ms);
        if plane.is_planner_away() {
            // Nobody names anything.
            (self.named, self.idle) = Default::default();
            return Ok(());
        }
        let waiting = self.records.waiting_tasks();
        let busy = self.records.busy_robots();
        let robots = self.fleet.robots().iter().map(|robot| robot.robot_id());
        let idle = robots.filter(|robot_id| !busy.contains(*robot_id));
        self.idle = idle.map(|id| (id.clone(), self.idle.get(id).copied().unwrap_or(now_ms))).collect();
        let mut named = BTreeMap::new();
        for explained in &plane.explain_tasks(waiting.keys()).await? {
            let task_id = TaskId::parse(&explained.task_id)?;
            self.starts.note_told(&task_id, explained, now_ms);
            if !is_named(explained) {
                continue;
            }
            let since = self.named.get(&task_id).copied().unwrap_or(now_ms);
            named.insert(task_id, since);
        }
        self.named = named;
        let over = self.named.iter().filter(|(_, since)| now_ms - **since > NAMED_MAX_MS);
        self.too_long.extend(over.map(|(task_id, _)| task_id.clone()));
        let waits = |task_id: &TaskId, since: u64| now_ms - since > IDLE_MAX_MS && !self.named.contains_key(task_id);
        let unnamed: BTreeSet<&str> =
            waiting.iter().filter(|(id, since)| waits(id, **since)).map(|(id, _)| id.as_str()).collect();
        for (robot_id, _) in self.idle.iter().filter(|(_, since)| now_ms - **since > IDLE_MAX_MS) {
            if unnamed.is_empty() {
                break;
            }
            let explained = plane.explain_robot(robot_id).await?;
            let mut could_do = explained.candidates.iter().filter(|candidate| candidate.reason.is_none());
            if explained.verdict.is_none() && could_do.any(|candidate| unnamed.contains(candidate.task_id.as_str())) {
                self.idle_ms += since_look_ms;
            }
        }
        Ok(())
    }
}

/// Whether a task that waits is named for a robot which is soon free.
fn is_named(explained: &TaskExplanation) -> bool {
    let waits_for = explained.verdict.as_ref().and_then(|verdict| verdict.metadata.get(WAITS_FOR.0));
    waits_for.is_some_and(|what| what.contains(WAITS_FOR.1))
}
