//! Takes robots from tasks that may be interrupted, for urgent ones that would wait longer.
//!
//! Called by `assign` behind a plan that is whole. Invariants:
//! 1. Only an urgent task takes, and none that came up by waiting; what gives way is not urgent, `preemptible`, not opened, and its
//!    robot carries nothing.
//! 2. The urgent task is begun sooner than by any robot that is free soon, by more than both drives: there, and back.
//! 3. A task gives way at most once in `PAUSE`, as far as this process remembers.

use super::robots::{self, Robot};
use crate::fleet::assignment::demand::Demand;
use crate::fleet::assignment::estimate::USUAL_MM_S;
use crate::fleet::assignment::filters;
use crate::fleet::decision::plan::Plan;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::eligibility;
use crate::fleet::tasks::transitions::{News, apply_event};
use crate::fleet::traffic::routing;
use crate::ids::TaskId;
use crate::planner_policy::PlannerPolicy;
use crate::reason::{Code, Reason};
use crate::site::WaypointIx;
use crate::task::Event;
use crate::task::spec::Class;
use crate::time::{Now, SiteDuration};

/// A task that gave way does not do so again for so long, site time.
const PAUSE: SiteDuration = SiteDuration::from_secs(600);
/// Urgent tasks that a turn looks at.
const TASKS_MAX: usize = 8;

/// Suspends what urgent tasks need the robots of.
pub fn plan(view: &mut FleetProjection, board: &Board, now: Now, policy: &PlannerPolicy, plan: &mut Plan) {
    let ready = view.queue.ready().take(TASKS_MAX);
    let urgent: Vec<TaskId> = ready.filter(|task_id| is_urgent(view, task_id)).cloned().collect();
    // A plan that goes on may find a robot yet.
    if urgent.is_empty() || plan.report.more {
        return;
    }
    view.gave_way.retain(|_, since| now.site.since(*since) < PAUSE);
    let mut soon = robots::find_stopping(view, board, &now);
    soon.extend(robots::find_soon(view, board, &now, policy.horizon_ms));
    let mut at_work = robots::find_interruptible(view, board, &now);
    at_work.retain(|(task_id, _)| !view.gave_way.contains_key(task_id));
    for task_id in urgent {
        if plan.is_cut() || at_work.is_empty() {
            return;
        }
        let Some((task, intake)) = view.task(&task_id).zip(view.intake(&task_id)) else { continue };
        let Some(goal) = view.ready.get(&task_id).map(|ready| ready.goal) else { continue };
        if filters::task(view, board, task, intake, &now).is_err() {
            continue;
        }
        let fits = |robot: &Robot| {
            let session = view.sessions.get(robot.id().as_str());
            session.is_some_and(|session| eligibility::fits(view, &session.row, task, intake).is_ok())
        };
        let demand = Demand::new(view, task, intake);
        let can = |robot: &Robot| filters::pair(view, board, robot.id(), &demand, &now).is_ok();
        let awaited = nearest(view, goal, soon.iter(), fits);
        let taken = nearest(view, goal, at_work.iter().map(|(_, robot)| robot), can);
        let gains = |(eta_ms, way_ms, _): &(u64, u64, usize)| {
            awaited.as_ref().is_none_or(|(awaited_ms, ..)| eta_ms + 2 * way_ms < *awaited_ms)
        };
        if let Some((.., nth)) = taken.filter(gains) {
            let (gives_way, robot) = at_work.swap_remove(nth);
            let why = Reason::from(Code::UrgentSuspend).with("robot_id", robot.id()).with("task_id", &task_id);
            plan.decide(view, now, "fleet", |tx| {
                apply_event(tx, &gives_way, News::from_event(Event::Suspend, Some(&why)));
            });
            view.gave_way.insert(gives_way, now.site);
        } else if let Some((.., nth)) = awaited {
            soon.swap_remove(nth);
        }
    }
}

fn is_urgent(view: &FleetProjection, task_id: &TaskId) -> bool {
    view.queue.rank(task_id).is_some_and(|rank| rank.class == Class::Urgent && !rank.promoted)
}

/// Of robots that can, the one that is first at a goal: in how many milliseconds, how many of them on the way there, and its index.
fn nearest<'r>(
    view: &FleetProjection,
    goal: Option<WaypointIx>,
    robots: impl Iterator<Item = &'r Robot>,
    can: impl Fn(&Robot) -> bool,
) -> Option<(u64, u64, usize)> {
    let field = goal.map(|goal| view.router.field_around(goal, routing::closed(view)));
    let eta = |(nth, robot): (usize, &Robot)| {
        let way_mm = field.as_ref().map_or(Some(0), |field| field.distance_mm(robot.at))?;
        let way_ms = way_mm * 1_000 / USUAL_MM_S;
        Some((robot.weighed.ready_ms + way_ms, way_ms, nth))
    };
    robots.enumerate().filter(|(_, robot)| can(robot)).filter_map(eta).min()
}
