//! Why the newest plans chose the robot that they chose: what the pair cost, and the next robots with what they would have cost.
//!
//! `assignment::rolling` notes it from the costs that decided; the explanations read. Memory of this process: no row, and gone with a start.
//! Invariant: of each task the newest choice, and of some thousand tasks at most.

use crate::ids::{RobotId, TaskId};
use crate::time::Utc;
use std::collections::{BTreeMap, VecDeque};

/// What one pair costs by its terms, each as it was weighed: thousandths of a millisecond on the way. The least sum over all pairs is chosen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PairCost {
    /// Until the robot is free.
    pub ready: i64,
    /// Its way to the first goal.
    pub way: i64,
    /// It failed the task before.
    pub failed: i64,
    /// Charge that it would not get now.
    pub charge: i64,
    /// Energy that its way takes beside that of a usual robot: less than 0 if less.
    pub energy: i64,
    /// How late it would be there: at most 0.
    pub lateness: i64,
    /// How long the task has waited: at most 0.
    pub age: i64,
    /// The task was meant for it in the plan before: at most 0.
    pub kept: i64,
    /// Tasks that it was given so far: breaks ties.
    pub tie: i64,
}

impl PairCost {
    /// Units of a millisecond. What is below only breaks ties.
    pub const UNITS_PER_MS: i64 = 1_000;

    /// All terms.
    pub const fn sum(&self) -> i64 {
        self.ready
            + self.way
            + self.failed
            + self.charge
            + self.energy
            + self.lateness
            + self.age
            + self.kept
            + self.tie
    }
}

/// A robot that was weighed for a task and not chosen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NextRobot {
    /// Which robot.
    pub robot_id: RobotId,
    /// What it would have cost.
    pub cost: PairCost,
    /// What it was given, or is meant for, in the same plan. None: nothing.
    pub took: Option<TaskId>,
}

/// What a plan chose for one task.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PlanChoice {
    /// UTC, site clock, of the plan.
    pub at: Utc,
    /// The robot.
    pub robot_id: RobotId,
    /// It was offered the task; else the task is only meant for it.
    pub is_given: bool,
    /// What the pair cost.
    pub cost: PairCost,
    /// The next three, cheapest first.
    pub next: Vec<NextRobot>,
    /// Robots that were weighed for the task.
    pub weighed: usize,
}

/// The newest choices. Volatile.
#[derive(Clone, Debug, Default)]
pub struct Chosen {
    of_task: BTreeMap<TaskId, PlanChoice>,
    /// Tasks, the one first that was first chosen for.
    order: VecDeque<TaskId>,
}

impl Chosen {
    /// Tasks of which the choice is known.
    const MAX: usize = 4_096;

    /// What was chosen for a task last. None: nothing, or that is forgotten.
    pub fn get(&self, task_id: &TaskId) -> Option<&PlanChoice> {
        self.of_task.get(task_id)
    }

    /// Notes what a plan chose.
    pub(in crate::fleet) fn note_choice(&mut self, task_id: TaskId, choice: PlanChoice) {
        if self.of_task.insert(task_id.clone(), choice).is_none() {
            self.order.push_back(task_id);
        }
        while self.order.len() > Self::MAX {
            let oldest = self.order.pop_front();
            oldest.map(|task_id| self.of_task.remove(&task_id));
        }
    }
}
