//! Robots that a plan looks at: those that are free, those whose errand may be broken off, and those that are free soon.
//!
//! Invariant: only a robot that is free gets an offer; the others keep tasks from going to a robot that is farther away.

use crate::energy::{self, RobotEnergy};
use crate::fleet::assignment::estimate::{Rest, USUAL_MM_S};
use crate::fleet::assignment::filters;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::plans::{Free, WeighedRobot};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::may_suspend;
use crate::fleet::traffic::routing;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId, Subject, TaskId};
use crate::site::WaypointIx;
use crate::step::StepKind;
use crate::task::machine::AfterStopping;
use crate::task::spec::Class;
use crate::task::state::Errand;
use crate::task::{Attempt, AttemptPhase};
use crate::time::Now;

/// Robots that are weighed against all tasks at once. Of more of them each task looks for the nearest.
pub const ROBOTS_MAX: usize = 256;
/// Breaking off an errand takes about so long, milliseconds: the word there, braking, and the word back.
pub const RECALL_MS: u64 = 3_000;
/// A thousandth of charge that a robot does not get now counts as so many milliseconds on the way: from the least charge with
/// which it may be called to that with which it need not charge these are some 45 s.
const LOSS_MS_PER_PERMILLE: u64 = 100;
/// The end of a task and the next offer take about so long, milliseconds.
const HAND_OVER_MS: u64 = 500;

/// A robot that a plan looks at.
#[derive(Clone, Debug)]
pub struct Robot {
    /// What its pairs are weighed by.
    pub weighed: WeighedRobot,
    /// Where it is free.
    pub at: WaypointIx,
    /// It must charge before it does anything.
    pub is_low: bool,
    /// What its work costs.
    pub energy: RobotEnergy,
}

impl Robot {
    /// The robot that it is.
    pub fn id(&self) -> &RobotId {
        &self.weighed.robot_id
    }
}

/// Robots that are free, or whose errand may be broken off, by id.
pub fn find_free(view: &FleetProjection, board: &Board, now: &Now) -> Vec<Robot> {
    let when = |robot_id: &RobotId| match view.held_by(robot_id) {
        None => filters::robot(view, board, robot_id, now).is_ok().then_some((Free::Now, 0)),
        Some(AttemptId { subject: Subject::Task(_), .. }) => None,
        Some(_) => {
            let is_it =
                filters::recallable(view, board, robot_id) && filters::in_work(view, board, robot_id, now).is_ok();
            is_it.then_some((Free::AfterErrand, RECALL_MS))
        }
    };
    let robot = |robot_id: &RobotId| {
        let (free, ready_ms) = when(robot_id)?;
        let live = board.get(robot_id)?;
        let at = routing::find(view, live.report.vitals.waypoint.as_ref())?;
        let loss_ms = if free == Free::AfterErrand { loss_ms(view, live, at) } else { 0 };
        let is_low = is_low(view, live, at);
        let robot = robot(view, robot_id, at, free, ready_ms);
        Some(Robot { weighed: WeighedRobot { loss_ms, ..robot.weighed }, is_low, ..robot })
    };
    board.keys().filter_map(robot).collect()
}

/// Robots that break off their errand, or whose task is suspended, by id: most are meant for a task already.
pub fn find_stopping(view: &FleetProjection, board: &Board, now: &Now) -> Vec<Robot> {
    let robot = |(robot_id, attempt): (&RobotId, &AttemptId)| {
        let known = view.attempt(attempt)?;
        if known.phase != AttemptPhase::Stopping || known.accepted.is_none() {
            return None;
        }
        filters::in_work(view, board, robot_id, now).ok()?;
        let live = board.get(robot_id)?;
        let here = routing::find(view, live.report.vitals.waypoint.as_ref())?;
        let Some(task_id) = attempt.subject.task_id() else {
            return Some(robot(view, robot_id, here, Free::Soon, RECALL_MS));
        };
        let is_suspended = view.task(task_id).is_some_and(|task| task.then == Some(AfterStopping::Suspended));
        let (ready_ms, at) = ends_step(view, attempt, live, here).filter(|_| is_suspended)?;
        (!is_low(view, live, at)).then(|| robot(view, robot_id, at, Free::Soon, ready_ms))
    };
    view.robots_at_work().filter_map(robot).collect()
}

/// Robots whose task may be suspended for an urgent one, by id, with that task.
pub fn find_interruptible(view: &FleetProjection, board: &Board, now: &Now) -> Vec<(TaskId, Robot)> {
    let robot = |(robot_id, attempt): (&RobotId, &AttemptId)| {
        let (task_id, live) = (attempt.subject.task_id()?, board.get(robot_id)?);
        let (task, intake) = view.task(task_id).zip(view.intake(task_id))?;
        let is_urgent = Class::from_priority(task.priority(intake), 0) == Class::Urgent;
        if is_urgent || view.attempt(attempt)?.uncertain.is_some() || !may_suspend(view, task_id, live) {
            return None;
        }
        filters::in_work(view, board, robot_id, now).ok()?;
        let here = routing::find(view, live.report.vitals.waypoint.as_ref())?;
        let (ready_ms, at) = ends_step(view, attempt, live, here)?;
        (!is_low(view, live, at)).then(|| (task_id.clone(), robot(view, robot_id, at, Free::Soon, ready_ms)))
    };
    view.robots_at_work().filter_map(robot).collect()
}

/// Robots whose task ends within `horizon_ms`, by id.
pub fn find_soon(view: &FleetProjection, board: &Board, now: &Now, horizon_ms: u64) -> Vec<Robot> {
    let robot = |(robot_id, attempt): (&RobotId, &AttemptId)| {
        let (ready_ms, at) = ends_soon(view, board, attempt, robot_id, horizon_ms)?;
        if is_low(view, board.get(robot_id)?, at) {
            return None;
        }
        filters::in_work(view, board, robot_id, now).ok()?;
        Some(robot(view, robot_id, at, Free::Soon, ready_ms))
    };
    view.robots_at_work().filter_map(robot).collect()
}

fn robot(view: &FleetProjection, robot_id: &RobotId, at: WaypointIx, free: Free, ready_ms: u64) -> Robot {
    let tasks = view.control.get(robot_id.as_str()).map_or(0, |c| c.row.tasks);
    let weighed = WeighedRobot { robot_id: robot_id.clone(), free, ready_ms, loss_ms: 0, tasks };
    Robot { weighed, at, is_low: false, energy: *view.energy_of(robot_id) }
}

/// Whether a robot must charge before it does anything, on a site where it can.
fn is_low(view: &FleetProjection, live: &NewestHeartbeat, at: WaypointIx) -> bool {
    let least = view.policy(&view.site.area_of(at).area_id).charge_mandatory_permille;
    live.report.vitals.battery_permille < least && view.site.chargers().next().is_some()
}

/// What a robot loses whose charging is broken off.
fn loss_ms(view: &FleetProjection, live: &NewestHeartbeat, at: WaypointIx) -> u64 {
    let held = view.held_by(&live.robot_id).and_then(|attempt| view.attempt(attempt));
    if held.is_none_or(|attempt| attempt.errand != Some(Errand::Charge)) {
        return 0;
    }
    let enough = view.policy(&view.site.area_of(at).area_id).charge_opportunistic_permille;
    u64::from(enough.saturating_sub(live.report.vitals.battery_permille)) * LOSS_MS_PER_PERMILLE
}

/// When and where the robot ends its task, if it is on its last way or there, nothing is in its way, and that is within the
/// horizon.
fn ends_soon(
    view: &FleetProjection,
    board: &Board,
    attempt: &AttemptId,
    robot_id: &RobotId,
    horizon_ms: u64,
) -> Option<(u64, WaypointIx)> {
    let task_id = attempt.subject.task_id()?;
    let known = view.attempt(attempt)?;
    let is_at_work = matches!(known.phase, AttemptPhase::Navigating | AttemptPhase::Executing | AttemptPhase::Accepted);
    if horizon_ms == 0 || !is_at_work || known.uncertain.is_some() || view.waits.contains_key(robot_id) {
        return None;
    }
    let (intake, live) = (view.intake(task_id)?, board.get(robot_id)?);
    let step = step_of(known, live);
    if intake.spec.goals(step).nth(1).is_some() {
        return None;
    }
    let rest = Rest::of_task(view, intake, step, live);
    let ready_ms = rest.usual_ms() + HAND_OVER_MS;
    (ready_ms <= horizon_ms).then_some((ready_ms, rest.ends_at?))
}

/// When and where the robot ends the step that it is at.
fn ends_step(
    view: &FleetProjection,
    attempt: &AttemptId,
    live: &NewestHeartbeat,
    here: WaypointIx,
) -> Option<(u64, WaypointIx)> {
    let step = view.intake(attempt.subject.task_id()?)?.spec.steps.get(step_of(view.attempt(attempt)?, live))?;
    let (step_ms, at) = match &step.kind {
        StepKind::Goto { waypoint } => {
            let goal = view.site.find(waypoint)?;
            (view.router.distance_mm(here, goal)? * 1_000 / USUAL_MM_S, goal)
        }
        StepKind::Wait { duration_ms } => (*duration_ms, here),
        StepKind::Action { .. } => (energy::HANDLE.as_ms(), here),
    };
    Some((step_ms + HAND_OVER_MS, at))
}

/// The step that a robot is at, as it says or as it is known.
fn step_of(known: &Attempt, live: &NewestHeartbeat) -> usize {
    let listed = live.report.attempts.iter().find(|listed| listed.attempt == known.attempt);
    listed.map_or(known.step_index, |listed| listed.step_index.max(known.step_index)) as usize
}
