//! The planner `fifo-nearest`: ready tasks in the order of the queue; each goes to the nearest eligible idle robot, the least loaded first on a tie.
//!
//! Called by `assign`.

use super::candidates::{Candidate, Pool};
use super::{errands, filters, offers};
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::errand_reports;
use crate::ids::RobotId;
use crate::time::Now;
use std::collections::BTreeSet;

/// Gives ready tasks to idle robots, each assignment an item of its own, and gives back who is still idle: of those that were `heard` if
/// no task is ready, and nobody while the walk along the queue goes on in the next turn.
///
/// A walk offers every ready task to the robots that are idle when it begins. Robots that found nothing walk again once they are heard;
/// until then they are offered only tasks that are new.
pub fn plan(
    view: &mut FleetProjection,
    board: &Board,
    now: Now,
    heard: &BTreeSet<RobotId>,
    plan: &mut Plan,
) -> Vec<Candidate> {
    let wanted = !view.queue.is_empty();
    let can_work = |r: &RobotId| filters::robot(view, board, r, &now).is_ok();
    let can_recall = |r: &RobotId| filters::recallable(view, board, r);
    let (mut idle, mut errands) = if wanted {
        (Pool::on_board(view, board, board.keys(), can_work), Pool::on_board(view, board, board.keys(), can_recall))
    } else {
        let wants_errand = |r: &RobotId| board.get(r).is_some_and(|live| errands::wants_any(view, live)) && can_work(r);
        (Pool::on_board(view, board, heard, wants_errand), Pool::default())
    };
    let present: BTreeSet<RobotId> = idle.robots().chain(errands.robots()).cloned().collect();
    let mut walk = view.queue.walk(&present, heard);
    idle.retain(&walk.robots);
    errands.retain(&walk.robots);
    let mut recalled = errand_reports::count_stopping(view);
    while !(idle.is_empty() && errands.is_empty()) {
        if plan.is_cut() {
            view.queue.pause(walk);
            return Vec::new();
        }
        let Some(task_id) = view.queue.next(&mut walk) else { break };
        let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
        plan.report.looked += 1;
        plan.slice.count_looks(1);
        if filters::task(view, board, task, intake, &now).is_err() {
            continue;
        }
        if let Some(robot_id) = idle.take_nearest(view, board, task, intake, &now, &mut plan.slice) {
            let (task, intake) = (task.clone(), intake.clone());
            plan.decide(view, now, "fleet", |tx| offers::offer(tx, &task, &intake, &robot_id, board));
            plan.report.offers += 1;
            continue;
        }
        if recalled > 0 {
            recalled -= 1;
        } else if let Some(robot_id) = errands.take_nearest(view, board, task, intake, &now, &mut plan.slice) {
            plan.decide(view, now, "fleet", |tx| errand_reports::stop_errand(tx, &robot_id));
        }
    }
    let left = idle.robots().chain(errands.robots()).cloned().collect();
    plan.report.more |= view.queue.end(&walk, left, &present);
    idle.rest().collect()
}
