//! Counts what stands still for so long that somebody would ask, and nobody could say why.
//!
//! Called once a sweep. Each time it looks at some robots with work and at some tasks, and goes on where it ended. Invariant: what stands
//! without a reason for [`limits::UNEXPLAINED_AFTER`] is counted once, until it has a reason again.

use super::wait_reasons;
use crate::fleet::assignment::demand::Demand;
use crate::fleet::assignment::filters;
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::ids::{RobotId, TaskId};
use crate::limits;
use crate::projection::RowMap;
use crate::task::{Phase, TaskState};
use crate::time::Now;
use smol_str::SmolStr;
use std::cell::OnceCell;
use std::ops::Bound;

/// Looks at the next robots and tasks.
pub(in crate::fleet) fn count_unexplained(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) {
    let mut found: Vec<(String, bool)> = Vec::new();
    let robots = next(&view.authority, &view.unexplained.robot);
    for id in &robots {
        let Ok(robot_id) = RobotId::parse(id) else { continue };
        let has_work = view.held_by(&robot_id).is_some();
        let why = wait_reasons::of_robot(view, board, &now, &robot_id).is_some_and(|why| wait_reasons::is_told(&why));
        found.push((format!("robot {id}"), !has_work || why));
    }
    let tasks = next(&view.tasks, &view.unexplained.task);
    // Only for tasks that wait for a robot and nothing else.
    let idle = OnceCell::new();
    let find_idle = || board.keys().filter(|id| filters::robot(view, board, id, &now).is_ok()).collect();
    for id in &tasks {
        let task = TaskId::parse(id).ok().and_then(|id| view.task(&id));
        let is_explained = |task| is_explained(view, board, &now, task, || idle.get_or_init(find_idle));
        found.push((format!("task {id}"), task.is_none_or(is_explained)));
    }
    let idle = idle.get().map_or(0, Vec::len);
    plan.slice.count_looks(robots.len() + tasks.len() * (1 + idle));
    (view.unexplained.robot, view.unexplained.task) =
        (robots.into_iter().next_back().unwrap_or_default(), tasks.into_iter().next_back().unwrap_or_default());
    let is_known = |view: &FleetProjection, key: &str| match key.split_once(' ') {
        Some(("task", id)) => view.tasks.contains_key(id),
        Some((_, id)) => view.authority.contains_key(id),
        None => false,
    };
    let mut since = std::mem::take(&mut view.unexplained.since);
    since.retain(|key, _| is_known(view, key));
    for (key, is_explained) in found {
        if is_explained {
            since.remove(&key);
            continue;
        }
        let begun = since.entry(key.clone()).or_insert(Some(now.link));
        if begun.is_some_and(|begun| now.link.since(begun) >= limits::UNEXPLAINED_AFTER) {
            *begun = None;
            plan.report.unexplained.push(key);
        }
    }
    view.unexplained.since = since;
}

/// The next ids of a table behind the last one that was looked at; from the first on where there are none.
fn next<R>(rows: &RowMap<R>, last: &str) -> Vec<SmolStr> {
    let behind = (Bound::Excluded(last), Bound::Unbounded);
    rows.range::<str, _>(behind).take(limits::UNEXPLAINED_LOOKS).map(|(id, _)| id.clone()).collect()
}

/// A task has a reason, or waits for robots that all have one against it: none that is idle could take it.
fn is_explained<'a>(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    task: &TaskState,
    idle: impl Fn() -> &'a Vec<&'a RobotId>,
) -> bool {
    let Some(intake) = view.intake(&task.task_id) else { return true };
    match wait_reasons::of_task(view, board, now, task, intake) {
        Some(why) => wait_reasons::is_told(&why),
        None if task.phase != Phase::Queued => false,
        None => {
            let demand = Demand::new(view, task, intake);
            idle().iter().all(|robot_id| filters::pair(view, board, robot_id, &demand, now).is_err())
        }
    }
}
