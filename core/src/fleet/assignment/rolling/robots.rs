//! Robots that a plan looks at: those that are free, those whose errand may be broken off, and those that are free soon.
//!
//! Invariant: only a robot that is free gets an offer; the others keep tasks from going to a robot that is farther away.

use crate::fleet::assignment::estimate::Rest;
use crate::fleet::assignment::filters;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::traffic::routing;
use crate::ids::{AttemptId, RobotId};
use crate::site::WaypointIx;
use crate::task::AttemptPhase;
use crate::time::Now;

/// Breaking off an errand takes about so long, milliseconds: the word there, braking, and the word back.
pub const RECALL_MS: u64 = 3_000;
/// The end of a task and the next offer take about so long, milliseconds.
const HAND_OVER_MS: u64 = 500;

/// From when on a robot could do a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Free {
    /// Now.
    Now,
    /// Once its errand was broken off.
    AfterErrand,
    /// By itself, soon.
    Soon,
}

/// A robot that a plan looks at.
#[derive(Clone, Debug)]
pub struct Robot {
    /// Which one.
    pub robot_id: RobotId,
    /// Where it is free.
    pub at: WaypointIx,
    /// From when on.
    pub free: Free,
    /// In so many milliseconds.
    pub ready_ms: u64,
    /// Tasks that it was given so far.
    pub tasks: u64,
}

/// All robots that are free, or are so within `horizon_ms`, by id.
pub fn gather(view: &FleetProjection, board: &Board, now: &Now, horizon_ms: u64) -> Vec<Robot> {
    let robot = |robot_id: &RobotId| {
        let (free, ready_ms, at) = when_free(view, board, robot_id, now, horizon_ms)?;
        let tasks = view.control.get(robot_id.as_str()).map_or(0, |c| c.row.tasks);
        Some(Robot { robot_id: robot_id.clone(), at, free, ready_ms, tasks })
    };
    board.keys().filter_map(robot).collect()
}

fn when_free(
    view: &FleetProjection,
    board: &Board,
    robot_id: &RobotId,
    now: &Now,
    horizon_ms: u64,
) -> Option<(Free, u64, WaypointIx)> {
    let here = || routing::find(view, board.get(robot_id)?.report.vitals.waypoint.as_ref());
    let Some(attempt) = view.held_by(robot_id) else {
        return filters::robot(view, board, robot_id, now).is_ok().then(here)?.map(|at| (Free::Now, 0, at));
    };
    if view.attempt(attempt)?.errand.is_some() {
        if filters::recallable(view, board, robot_id) {
            return here().map(|at| (Free::AfterErrand, RECALL_MS, at));
        }
        let is_stopping = view.attempt(attempt)?.phase == AttemptPhase::Stopping;
        return is_stopping.then(here)?.map(|at| (Free::Soon, RECALL_MS, at));
    }
    let (ready_ms, at) = ends_soon(view, board, attempt, robot_id, horizon_ms)?;
    filters::in_work(view, board, robot_id, now).is_ok().then_some((Free::Soon, ready_ms, at))
}

/// When and where the robot ends its task, if nothing is in its way and that is within the horizon.
fn ends_soon(
    view: &FleetProjection,
    board: &Board,
    attempt: &AttemptId,
    robot_id: &RobotId,
    horizon_ms: u64,
) -> Option<(u64, WaypointIx)> {
    let known = view.attempt(attempt)?;
    let is_at_work = matches!(known.phase, AttemptPhase::Navigating | AttemptPhase::Executing | AttemptPhase::Accepted);
    if horizon_ms == 0 || !is_at_work || known.uncertain.is_some() || view.waits.contains_key(robot_id) {
        return None;
    }
    let (intake, live) = (view.intake(attempt.subject.task_id()?)?, board.get(robot_id)?);
    let listed = live.report.attempts.iter().find(|listed| listed.attempt == *attempt);
    let step = listed.map_or(known.step_index, |listed| listed.step_index.max(known.step_index));
    let rest = Rest::of_task(view, intake, step as usize, live);
    let ready_ms = rest.usual_ms() + HAND_OVER_MS;
    (ready_ms <= horizon_ms).then_some((ready_ms, rest.ends_at?))
}
