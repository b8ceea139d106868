//! Why a plan chose these pairs: of each task the robots that were weighed for it, from the very costs that decided.
//!
//! Called by the plan for the pairs that it makes.

use super::choices::{Choice, Choices, Scene};
use super::cost;
use crate::fleet::projection::chosen::{NextRobot, PairCost, PlanChoice};
use std::collections::BTreeMap;

/// Robots beside the chosen one that are told of.
const NEXT: usize = 3;

/// What a plan weighed, by task.
pub struct Reasons<'a> {
    choices: &'a Choices,
    /// Of each task that was chosen for its pairs.
    of_task: Vec<Option<Vec<&'a Choice>>>,
    /// Of each robot the task that it goes with.
    took: BTreeMap<usize, usize>,
}

impl<'a> Reasons<'a> {
    /// Of the `pairs` that were chosen, robots with tasks.
    pub fn new(choices: &'a Choices, pairs: &[(usize, usize)]) -> Self {
        let mut of_task: Vec<Option<Vec<&Choice>>> = vec![None; choices.tasks.len()];
        pairs.iter().for_each(|(_, task)| of_task[*task] = Some(Vec::new()));
        for choice in &choices.pairs {
            of_task[choice.task].iter_mut().for_each(|pairs| pairs.push(choice));
        }
        Self { choices, of_task, took: pairs.iter().copied().collect() }
    }

    /// Why this robot for this task.
    pub fn of_task(&mut self, task: usize, robot: usize, scene: &Scene<'_>) -> PlanChoice {
        let mut pairs = self.of_task[task].take().unwrap_or_default();
        let weighed = pairs.len();
        pairs.sort_by_key(|choice| (choice.cost, choice.robot));
        let cost_of = |choice: &Choice| {
            let (robot, urgency) = (&scene.robots[choice.robot], &self.choices.urgencies[choice.task]);
            cost::of_pair(scene.policy, &scene.now, robot, urgency, &choice.pair)
        };
        let cost = pairs.iter().find(|choice| choice.robot == robot).map_or_else(PairCost::default, |c| cost_of(c));
        let next = pairs.iter().filter(|choice| choice.robot != robot).take(NEXT).map(|choice| NextRobot {
            robot_id: scene.robots[choice.robot].robot_id.clone(),
            cost: cost_of(choice),
            took: self.took.get(&choice.robot).map(|task| self.choices.tasks[*task].clone()),
        });
        let robot_id = scene.robots[robot].robot_id.clone();
        PlanChoice { at: scene.now.utc, robot_id, is_given: false, cost, next: next.collect(), weighed }
    }
}
