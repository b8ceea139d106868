//! Why a plan chose these pairs: of each task the robots that were weighed for it, from the very costs that decided.
//!
//! Called by the plan for the pairs that it makes.

use super::matching;
use crate::fleet::projection::chosen::{NextRobot, PairCost, PlanChoice};
use crate::fleet::projection::plans::{Weighed, WeighedPair};
use crate::planner_policy::PlannerPolicy;
use crate::time::Utc;
use std::collections::BTreeMap;

/// Robots beside the chosen one that are told of.
const NEXT: usize = 3;

/// What a plan weighed, by task.
pub struct Reasons<'a> {
    policy: &'a PlannerPolicy,
    at: Utc,
    weighed: &'a Weighed,
    /// Of each task that was chosen for its pairs.
    of_task: Vec<Option<Vec<&'a WeighedPair>>>,
    /// Of each robot the task that it goes with.
    took: BTreeMap<usize, usize>,
}

impl<'a> Reasons<'a> {
    /// Of the `pairs` that were chosen, robots with tasks.
    pub fn new(policy: &'a PlannerPolicy, at: Utc, weighed: &'a Weighed, pairs: &[(usize, usize)]) -> Self {
        let mut of_task: Vec<Option<Vec<&WeighedPair>>> = vec![None; weighed.tasks.len()];
        pairs.iter().for_each(|(_, task)| of_task[*task] = Some(Vec::new()));
        for pair in &weighed.pairs {
            of_task[pair.task].iter_mut().for_each(|pairs| pairs.push(pair));
        }
        Self { policy, at, weighed, of_task, took: pairs.iter().copied().collect() }
    }

    /// Why this robot for this task.
    pub fn of_task(&mut self, task: usize, robot: usize) -> PlanChoice {
        let weighed = self.weighed;
        let pairs = self.of_task[task].take().unwrap_or_default().into_iter();
        let mut costs: Vec<(PairCost, usize)> =
            pairs.map(|pair| (matching::cost_of(self.policy, self.at, weighed, pair), pair.robot)).collect();
        costs.sort_by_key(|(cost, robot)| (cost.sum(), *robot));
        let own = costs.iter().find(|(_, other)| *other == robot);
        let next = costs.iter().filter(|(_, other)| *other != robot).take(NEXT).map(|(cost, other)| NextRobot {
            robot_id: weighed.robots[*other].robot_id.clone(),
            cost: *cost,
            took: self.took.get(other).map(|task| weighed.tasks[*task].task_id.clone()),
        });
        PlanChoice {
            at: self.at,
            robot_id: weighed.robots[robot].robot_id.clone(),
            is_given: false,
            cost: own.map_or_else(PairCost::default, |(cost, _)| *cost),
            next: next.collect(),
            weighed: costs.len(),
        }
    }
}
