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
use choices::{Choices, Finder, Scene};
use robots::{Free, ROBOTS_MAX, Robot};
use std::collections::BTreeSet;

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
    let free = robots::find_free(view, board, &now);
    if free.is_empty() {
        return Vec::new();
    }
    let present: BTreeSet<RobotId> = free.iter().map(|robot| robot.robot_id.clone()).collect();
    let mut robots = robots::find_stopping(view, board);
    let room = ROBOTS_MAX.saturating_sub(free.len() + robots.len());
    if room > 0 {
        let mut soon = robots::find_soon(view, board, &now, policy.horizon_ms);
        soon.sort_by_key(|robot| robot.ready_ms);
        robots.extend(soon.into_iter().take(room));
    }
    robots.extend(free);
    robots.sort_by(|a, b| a.robot_id.cmp(&b.robot_id));
    let scene = Scene { board, now, policy, robots: &robots };
    let choices = if present.len() > ROBOTS_MAX {
        find_by_task(view, scene, heard, &present, plan)
    } else {
        find_by_robot(view, scene, heard, &present, plan)
    };
    let pairs = choose(view, scene, choices);
    let mut taken = BTreeSet::new();
    let mut meant = Vec::new();
    let mut decided = 0;
    for (robot, task_id) in pairs {
        // The first is decided whatever it took to find it: else a turn might do nothing, and the next one the same.
        if decided > 0 && plan.is_cut() {
            break;
        }
        decided += usize::from(robots[robot].free != Free::Soon);
        let Robot { robot_id, free, ready_ms, .. } = &robots[robot];
        let is_free_at = now.utc.plus_ms(*ready_ms);
        match free {
            Free::Now => {
                let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
                let (task, intake) = (task.clone(), intake.clone());
                plan.decide(view, now, "fleet", |tx| offers::offer(tx, &task, &intake, robot_id, board));
                // What the store would refuse was given up, and must not be tried again at once.
                if view.held_by(robot_id).is_some() {
                    plan.report.offers += 1;
                    taken.insert(robot_id.clone());
                }
            }
            Free::AfterErrand => {
                plan.decide(view, now, "fleet", |tx| errand_reports::stop_errand(tx, robot_id));
                meant.push((task_id, robot_id.clone(), is_free_at));
            }
            Free::Soon => meant.push((task_id, robot_id.clone(), is_free_at)),
        }
    }
    view.meant.put_plan(meant, now.site);
    // Those that are left may be near to tasks that were not weighed for them.
    plan.report.more |= !taken.is_empty() && taken.len() < present.len();
    let left = robots.into_iter().filter(|robot| robot.free == Free::Now && !taken.contains(&robot.robot_id));
    left.map(|robot| Candidate { robot_id: robot.robot_id, at: robot.at, tasks: robot.tasks }).collect()
}

/// Of each robot its nearest tasks, and of the first tasks all robots. A robot that found nothing is shown new tasks alone
/// until it is heard.
fn find_by_robot(
    view: &mut FleetProjection,
    scene: Scene<'_>,
    heard: &BTreeSet<RobotId>,
    present: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Choices {
    let rested = view.queue.rested(present, heard);
    let news = view.queue.take_news();
    let mut nothing = BTreeSet::new();
    let mut finder = Finder::new(view, scene);
    for (robot, Robot { robot_id, .. }) in scene.robots.iter().enumerate() {
        if rested.contains(robot_id) && news.len() <= ROBOTS_MAX {
            for rank in &news {
                finder.add(robot, &rank.task_id);
            }
        } else if !finder.find_tasks(robot, &mut plan.slice) && present.contains(robot_id) {
            nothing.insert(robot_id.clone());
        }
    }
    let first = (present.len() - rested.len()) * FIRST_PER_TWO_ROBOTS / 2;
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
fn find_by_task(
    view: &mut FleetProjection,
    scene: Scene<'_>,
    heard: &BTreeSet<RobotId>,
    present: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Choices {
    let mut walk = view.queue.walk(present, heard);
    let mut finder = Finder::new(view, scene);
    let (mut found, mut is_over) = (0, false);
    while found < limits::DECISIONS_PER_STAGE && !plan.slice.is_spent() {
        let Some(task_id) = view.queue.next(&mut walk) else {
            is_over = true;
            break;
        };
        plan.report.looked += 1;
        found += usize::from(finder.find_robots(&task_id, &mut plan.slice));
    }
    let choices = finder.into_choices();
    // Whoever is weighed and given nothing walks again; only behind tasks that nobody could do a walk goes on.
    match (is_over, found) {
        (true, 0) => plan.report.more |= view.queue.end(&walk, present.clone(), present),
        (true, _) => {}
        (false, 0) => {
            plan.report.more = true;
            view.queue.pause(walk);
        }
        (false, _) => plan.report.more = true,
    }
    choices
}

/// The pairs of least cost, as indices of robots with ids of tasks.
fn choose(view: &FleetProjection, scene: Scene<'_>, mut choices: Choices) -> Vec<(usize, TaskId)> {
    let Scene { board, now, robots, .. } = scene;
    let could = |robot: usize, task_id: &TaskId| {
        let rows = view.task(task_id).zip(view.intake(task_id));
        rows.is_some_and(|(task, intake)| {
            filters::pair(view, board, &robots[robot].robot_id, task, intake, &now).is_ok()
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
