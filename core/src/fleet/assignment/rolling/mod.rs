//! The planner `rolling`: all that may be given now is weighed at once, and what is given costs least in sum.
//!
//! Robots that are free soon are weighed too, so that no robot drives far to a task that another will stand beside. What is
//! meant for them is memory of this process, no row and no promise.
//!
//! In reading order: `robots` that may take something; what a pair costs (`cost`); which pairs are weighed (`choices`); the
//! pairs of least cost (`least_cost`). Called by `assign`. Invariants:
//! 1. A task of a higher class goes first, and as many tasks are given as can be.
//! 2. The same rows, heartbeats and memory give the same pairs, in whatever order they came.

mod choices;
mod cost;
mod least_cost;
mod robots;

use super::candidates::Candidate;
use super::{filters, offers};
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::errand_reports;
use crate::ids::{RobotId, TaskId};
use crate::limits;
use crate::planner_policy::PlannerPolicy;
use crate::time::Now;
use choices::{Choices, Finder};
use robots::{Free, Robot};
use std::collections::{BTreeMap, BTreeSet};

/// Robots that are weighed against all tasks at once. Of more of them each task looks for the nearest.
const ROBOTS_MAX: usize = 256;
/// Of so many robots each is weighed for the first tasks in the queue, half as many again.
const FIRST_PER_TWO_ROBOTS: usize = 3;

/// Gives ready tasks to robots that are free, each assignment an item of its own, and gives back who is free still.
pub fn plan(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    policy: &PlannerPolicy,
    plan: &mut Plan,
) -> Vec<Candidate> {
    let mut robots = robots::gather(view, board, &now, policy.horizon_ms);
    let free = robots.iter().filter(|robot| robot.free != Free::Soon).count();
    if free > ROBOTS_MAX {
        robots.retain(|robot| robot.free != Free::Soon || robot.ready_ms == robots::RECALL_MS);
    } else {
        keep_first(&mut robots);
    }
    let is_present = |robot: &&Robot| robot.free != Free::Soon;
    let present: BTreeSet<RobotId> = robots.iter().filter(is_present).map(|robot| robot.robot_id.clone()).collect();
    let choices = find_choices(view, board, now, heard, policy, &robots, &present, plan);
    let pairs = choose(view, board, &now, &robots, choices);
    let mut taken = BTreeSet::new();
    let mut meant = BTreeMap::new();
    for (robot, task_id) in pairs {
        let Robot { robot_id, free, .. } = &robots[robot];
        match free {
            Free::Now => {
                let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
                let (task, intake) = (task.clone(), intake.clone());
                plan.decide(view, now, "fleet", |tx| offers::offer(tx, &task, &intake, robot_id, board));
                plan.report.offers += 1;
                taken.insert(robot_id.clone());
            }
            Free::AfterErrand => {
                plan.decide(view, now, "fleet", |tx| errand_reports::stop_errand(tx, robot_id));
                meant.insert(task_id, robot_id.clone());
            }
            Free::Soon => drop(meant.insert(task_id, robot_id.clone())),
        }
    }
    view.meant.put(meant, now.site);
    let left = robots.into_iter().filter(|robot| robot.free == Free::Now && !taken.contains(&robot.robot_id));
    left.map(|robot| Candidate { robot_id: robot.robot_id, at: robot.at, tasks: robot.tasks }).collect()
}

/// Leaves out robots that are free late, where there are more than are weighed.
fn keep_first(robots: &mut Vec<Robot>) {
    let mut order: Vec<usize> = (0..robots.len()).collect();
    order.sort_by_key(|at| (robots[*at].free == Free::Soon, robots[*at].ready_ms, *at));
    let kept: BTreeSet<usize> = order.into_iter().take(ROBOTS_MAX).collect();
    let mut at = 0..;
    robots.retain(|_| at.next().is_some_and(|at| kept.contains(&at)));
}

#[expect(clippy::too_many_arguments, reason = "the same of every stage, and what was gathered")]
fn find_choices(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    policy: &PlannerPolicy,
    robots: &[Robot],
    present: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Choices {
    if present.len() > ROBOTS_MAX {
        return find_by_task(view, board, now, heard, policy, robots, present, plan);
    }
    let rested = view.queue.rested(present, heard);
    let news = view.queue.take_news();
    let mut nothing = BTreeSet::new();
    let mut finder = Finder::new(view, board, now, policy, robots);
    for (robot, Robot { robot_id, .. }) in robots.iter().enumerate() {
        if rested.contains(robot_id) && news.len() <= ROBOTS_MAX {
            for rank in &news {
                finder.add(robot, &rank.task_id);
            }
        } else if !finder.find_tasks(robot, &mut plan.slice) && present.contains(robot_id) {
            nothing.insert(robot_id.clone());
        }
    }
    let first = robots.len() * FIRST_PER_TWO_ROBOTS / 2;
    let mut found = 0;
    for task_id in view.queue.ready().take(4 * first) {
        plan.report.looked += 1;
        found += usize::from(finder.find_robots(task_id, &mut plan.slice));
        if found >= first {
            break;
        }
    }
    let choices = finder.into_choices();
    view.queue.let_rest(nothing);
    choices
}

/// Where there are more robots than can be weighed against all tasks: of each of the first tasks the nearest robots.
#[expect(clippy::too_many_arguments, reason = "the same of every stage, and what was gathered")]
fn find_by_task(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    policy: &PlannerPolicy,
    robots: &[Robot],
    present: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Choices {
    let mut walk = view.queue.walk(present, heard);
    let mut finder = Finder::new(view, board, now, policy, robots);
    let mut found = 0;
    let mut is_over = false;
    while found < limits::DECISIONS_PER_STAGE && !plan.slice.is_spent() {
        let Some(task_id) = view.queue.next(&mut walk) else {
            is_over = true;
            break;
        };
        plan.report.looked += 1;
        found += usize::from(finder.find_robots(&task_id, &mut plan.slice));
    }
    let choices = finder.into_choices();
    // Who is weighed and given nothing walks again; else the walk goes on behind those that nobody could do.
    match (is_over, found) {
        (true, 0) => plan.report.more |= view.queue.end(&walk, present.clone(), present),
        (false, 0) => {
            plan.report.more = true;
            view.queue.pause(walk);
        }
        (_, _) => plan.report.more = true,
    }
    choices
}

/// The pairs of least cost, as indices of robots with ids of tasks.
fn choose(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    robots: &[Robot],
    mut choices: Choices,
) -> Vec<(usize, TaskId)> {
    let could = |robot: usize, task_id: &TaskId| {
        let rows = view.task(task_id).zip(view.intake(task_id));
        rows.is_some_and(|(task, intake)| {
            filters::pair(view, board, &robots[robot].robot_id, task, intake, now).is_ok()
        })
    };
    loop {
        let pairs = pair_up(robots.len(), &choices);
        let is_lost = |(robot, task): &&(usize, usize)| {
            robots[*robot].free == Free::AfterErrand && !could(*robot, &choices.tasks[*task])
        };
        let lost: BTreeSet<(usize, usize)> = pairs.iter().filter(is_lost).copied().collect();
        if lost.is_empty() {
            return pairs.into_iter().map(|(robot, task)| (robot, choices.tasks[task].clone())).collect();
        }
        choices.pairs.retain(|choice| !lost.contains(&(choice.robot, choice.task)));
    }
}

/// Pairs of robot and task whose cost is least in sum, by robot.
fn pair_up(robots: usize, choices: &Choices) -> Vec<(usize, usize)> {
    let tasks = choices.tasks.len();
    let largest = choices.pairs.iter().map(|choice| choice.cost.abs()).max().unwrap_or(0);
    let are_robots_rows = robots <= tasks;
    let mut rows = vec![Vec::new(); robots.min(tasks)];
    for choice in &choices.pairs {
        let worth = cost::worth(choices.urgencies[choice.task].class, largest, robots.min(tasks));
        let (row, column) = if are_robots_rows { (choice.robot, choice.task) } else { (choice.task, choice.robot) };
        rows[row].push((column, choice.cost - worth));
    }
    let pairs = least_cost::pair_up(&rows, robots.max(tasks)).into_iter().enumerate();
    let pairs = pairs.filter_map(|(row, column)| Some((row, column?)));
    let mut pairs: Vec<_> =
        pairs.map(|(row, column)| if are_robots_rows { (row, column) } else { (column, row) }).collect();
    pairs.sort_unstable();
    pairs
}
