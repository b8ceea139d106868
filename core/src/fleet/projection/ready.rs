//! Ready tasks by what they need of a robot and by where they begin, so that a robot finds those that are near it and for it.
//!
//! `index` puts a task anew when its rows change; the planner `rolling` reads.
//! Invariant: exactly the tasks that have a turn in the queue and whose goals are on the map are here, each once.

use super::queue::Rank;
use crate::ids::{RobotId, TaskId};
use crate::site::WaypointIx;
use crate::task::{TaskIntake, TaskState};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What a robot must have for a task: equal for all tasks that the same robots can do.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Need {
    /// Actions of its steps, and capabilities of its selector.
    capabilities: BTreeSet<String>,
    labels: BTreeMap<String, String>,
    payload_g: u32,
    minimum_software: Option<String>,
}

impl Need {
    fn of_intake(intake: &TaskIntake) -> Self {
        let (spec, selector) = (&intake.spec, &intake.spec.selector);
        let capabilities = spec.actions().into_iter().chain(selector.capabilities.iter().map(String::as_str));
        Self {
            capabilities: capabilities.map(str::to_owned).collect(),
            labels: selector.labels.clone(),
            payload_g: selector.payload_g,
            minimum_software: selector.minimum_software.clone(),
        }
    }
}

/// One ready task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReadyTask {
    /// Where it stands in the queue.
    pub rank: Rank,
    /// The only robot that it may go to; none: any that has what it needs.
    pub bound_to: Option<RobotId>,
    /// What it needs.
    pub need: Arc<Need>,
    /// Where its robot goes first; none: nowhere.
    pub goal: Option<WaypointIx>,
}

/// Tasks of one need, by where they begin, each in the order in which they are served.
pub type ByGoal = BTreeMap<Option<WaypointIx>, BTreeSet<Rank>>;

/// Ready tasks, found by need and goal.
#[derive(Clone, Debug, Default)]
pub struct ReadyTasks {
    tasks: BTreeMap<TaskId, ReadyTask>,
    by_need: BTreeMap<Arc<Need>, ByGoal>,
    by_robot: BTreeMap<RobotId, BTreeSet<Rank>>,
}

impl ReadyTasks {
    /// The task, if it is ready.
    pub fn get(&self, task_id: &TaskId) -> Option<&ReadyTask> {
        self.tasks.get(task_id)
    }
    /// Tasks that any robot may do that has what they need, by need.
    pub fn by_need(&self) -> impl Iterator<Item = (&Arc<Need>, &ByGoal)> {
        self.by_need.iter()
    }
    /// Tasks that only this robot may do.
    pub fn bound_to(&self, robot_id: &RobotId) -> impl Iterator<Item = &Rank> {
        self.by_robot.get(robot_id).into_iter().flatten()
    }

    /// Puts a task where it is found; with no rank it is not ready. True: it is found elsewhere or by others than before.
    pub(super) fn put_task(
        &mut self,
        task_id: &TaskId,
        rank: Option<&Rank>,
        rows: Option<(&TaskState, &TaskIntake)>,
        find: impl Fn(&crate::ids::WaypointId) -> Option<WaypointIx>,
    ) -> bool {
        let new = rank.zip(rows).and_then(|(rank, (task, intake))| {
            let from = crate::step::from_step(&intake.spec.steps, task.next_step);
            let need = Need::of_intake(intake);
            let need = self.by_need.get_key_value(&need).map_or_else(|| Arc::new(need), |(known, _)| known.clone());
            let bound_to = task.opened_robot_id.as_ref().or(task.pinned_robot(intake)).cloned();
            // Where the map has lost a goal of it no robot can go.
            let goals: Option<Vec<WaypointIx>> = intake.spec.goals(from as usize).map(find).collect();
            Some(ReadyTask { rank: rank.clone(), bound_to, need, goal: goals?.first().copied() })
        });
        if self.tasks.get(task_id) == new.as_ref() {
            return false;
        }
        if let Some(old) = self.tasks.remove(task_id) {
            self.take_out(&old);
        }
        let Some(new) = new else { return true };
        match &new.bound_to {
            Some(robot_id) => self.by_robot.entry(robot_id.clone()).or_default().insert(new.rank.clone()),
            None => {
                let by_goal = self.by_need.entry(new.need.clone()).or_default();
                by_goal.entry(new.goal).or_default().insert(new.rank.clone())
            }
        };
        self.tasks.insert(task_id.clone(), new);
        true
    }

    fn take_out(&mut self, old: &ReadyTask) {
        match &old.bound_to {
            Some(robot_id) => {
                let Some(ranks) = self.by_robot.get_mut(robot_id) else { return };
                ranks.remove(&old.rank);
                if ranks.is_empty() {
                    self.by_robot.remove(robot_id);
                }
            }
            None => {
                let Some(by_goal) = self.by_need.get_mut(&old.need) else { return };
                if let Some(ranks) = by_goal.get_mut(&old.goal) {
                    ranks.remove(&old.rank);
                    if ranks.is_empty() {
                        by_goal.remove(&old.goal);
                    }
                }
                if by_goal.is_empty() {
                    self.by_need.remove(&old.need);
                }
            }
        }
    }
}
