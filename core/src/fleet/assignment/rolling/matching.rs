//! The pairs of least cost, of what a plan weighed and of nothing else: the same decision can be made once more of its record, by the same rules or
//! by others.
//!
//! Called by the plan, and by who replays one. Invariant: the same input gives the same pairs.

use super::{cost, least_cost};
use crate::fleet::projection::chosen::PairCost;
use crate::fleet::projection::plans::{Weighed, WeighedPair};
use crate::planner_policy::PlannerPolicy;
use crate::time::Utc;

/// The pairs that cost least in sum, as indices of robots and tasks, by robot.
pub fn choose_pairs(policy: &PlannerPolicy, now: Utc, weighed: &Weighed) -> Vec<(usize, usize)> {
    let (robots, tasks) = (weighed.robots.len(), weighed.tasks.len());
    let costs: Vec<i64> = weighed.pairs.iter().map(|pair| cost_of(policy, now, weighed, pair).sum()).collect();
    let largest = costs.iter().map(|cost| cost.abs()).max().unwrap_or(0);
    let are_robots_rows = robots <= tasks;
    let mut rows = vec![Vec::new(); robots.min(tasks)];
    for (pair, cost) in weighed.pairs.iter().zip(costs) {
        let worth = cost::worth(weighed.tasks[pair.task].class, largest, robots.min(tasks));
        let (row, column) = if are_robots_rows { (pair.robot, pair.task) } else { (pair.task, pair.robot) };
        rows[row].push((column, cost - worth));
    }
    let pairs = least_cost::pair_up(&rows, robots.max(tasks)).into_iter().enumerate();
    let pairs = pairs.filter_map(|(row, column)| Some((row, column?)));
    let mut pairs: Vec<_> =
        pairs.map(|(row, column)| if are_robots_rows { (row, column) } else { (column, row) }).collect();
    pairs.sort_unstable();
    pairs
}

/// What one of the pairs costs before the worth of its class.
pub fn cost_of(policy: &PlannerPolicy, now: Utc, weighed: &Weighed, pair: &WeighedPair) -> PairCost {
    cost::of_pair(policy, now, &weighed.robots[pair.robot], &weighed.tasks[pair.task], pair)
}
