//! Filters: why a robot gets no work, and why it does not get this task. The same functions serve the planner and the explanations.
//!
//! Invariant: a filter gives a reason; nothing is ever "just not chosen".

use super::demand::Demand;
use crate::fleet::facts::{disbelief, maps, repair, unanswered_offers};
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::RobotHolder;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::eligibility::{another_could, bound, decided_by_people, fits, reported};
use crate::fleet::tasks::{claims, load, plausible};
use crate::fleet::traffic::{engaged_stops, routing};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{RobotId, Subject};
use crate::limits;
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::site::WaypointIx;
use crate::task::{AttemptPhase, Phase, TaskIntake, TaskState};
use crate::time::Now;

/// Whether the robot could be given work if nothing had it: nothing that lasts keeps it from work.
pub fn in_work(view: &FleetProjection, board: &Board, robot_id: &RobotId, now: &Now) -> Result<(), Reason> {
    match liveness::presence(board, robot_id, now) {
        Presence::Online => {}
        Presence::Suspect => return Err(Code::RobotSuspect.into()),
        Presence::Offline => return Err(Code::RobotOffline.into()),
    }
    let Some(live) = board.get(robot_id) else { return Err(Code::RobotOffline.into()) };
    engaged_stops::check_stops(view, robot_id, Some(live))?;
    decided_by_people(view, robot_id, Some(live))?;
    reported(live)?;
    plausible::keeps_back(view, live)?;
    disbelief::check_believed(view, robot_id)?;
    if let Some(why) = maps::differs(view, live) {
        return Err(why);
    }
    claims::broken(view, robot_id).map_or(Ok(()), Err)
}

/// Whether the robot can be given any work at all now.
pub fn robot(view: &FleetProjection, board: &Board, robot_id: &RobotId, now: &Now) -> Result<(), Reason> {
    let (session, live) = (view.sessions.get(robot_id.as_str()).map(|s| &s.row), board.get(robot_id));
    let Some((session, live)) = session.zip(live) else { return Err(Code::RobotOffline.into()) };
    in_work(view, board, robot_id, now)?;
    match view.authority.get(robot_id.as_str()).map(|a| &a.row.holder) {
        None | Some(RobotHolder::None) => {}
        Some(RobotHolder::Attempt(id)) => return Err(Reason::from(Code::RobotBusy).with("attempt", id)),
        Some(RobotHolder::Maintenance(id)) => return Err(Reason::from(Code::RobotBusy).with("maintenance", id)),
    }
    // An older heartbeat knows neither what has ended since nor where the robot stands now.
    let current = session.session_epoch == live.report.session_epoch && liveness::is_fresh(view, live);
    if let Some(attempt) = repair::unknown_attempt(view, live) {
        let since = view.unknown.get(robot_id).filter(|(known, _)| known == attempt).map(|(_, since)| *since);
        let is_old = since.is_some_and(|since| now.link.since(since) >= limits::ATTEMPT_UNKNOWN_AFTER);
        let code = if is_old { Code::AttemptUnknown } else { Code::RobotReconciling };
        return Err(Reason::from(code).with("attempt", attempt));
    }
    if !current {
        return Err(Code::RobotReconciling.into());
    }
    unanswered_offers::check_answering(view, robot_id, now)?;
    if routing::find(view, live.report.vitals.waypoint.as_ref()).is_none() {
        return Err(Code::RobotUnlocated.into());
    }
    Ok(())
}

/// Whether this robot, apart from being busy, may be given this task.
pub fn pair(
    view: &FleetProjection,
    board: &Board,
    robot_id: &RobotId,
    demand: &Demand<'_>,
    now: &Now,
) -> Result<(), Reason> {
    let Some(session) = view.sessions.get(robot_id.as_str()).map(|s| &s.row) else {
        return Err(Code::RobotOffline.into());
    };
    fits(view, session, demand.task, demand.intake)?;
    pair_if_able(view, board, robot_id, demand, now)
}

/// As [`pair`], of a robot that has what the task needs.
pub(super) fn pair_if_able(
    view: &FleetProjection,
    board: &Board,
    robot_id: &RobotId,
    demand: &Demand<'_>,
    now: &Now,
) -> Result<(), Reason> {
    let Demand { task, intake, .. } = demand;
    bound(robot_id, task, intake)?;
    prefer_others(view, robot_id, task, intake, now)?;
    let Some(live) = board.get(robot_id) else { return Err(Code::RobotOffline.into()) };
    just_refused(view, live, task)?;
    let load = load::carried(view, live);
    if let Some(load) = load
        && !load::is_item_of(load, task, intake)
    {
        return Err(load::explain_load(view, robot_id, load));
    }
    let here = routing::find(view, live.report.vitals.waypoint.as_ref()).ok_or(Code::RobotUnlocated)?;
    let goals = demand.goals()?;
    place(view, here, goals)?;
    if routing::is_too_long(view, here, goals, demand.legs_mm(here)?.sum()) {
        return Err(Reason::from(Code::RouteTooLong).with("points_max", limits::ROUTE_POINTS_MAX));
    }
    // The charge must last for all of it and the way to a charger behind it, with a reserve.
    let energy = view.energy_of(robot_id);
    let Some(trip) = demand.trip_home(view, energy, here, load.is_some())? else { return Ok(()) };
    let mandatory = u64::from(view.policy(&view.site.area_of(here).area_id).charge_mandatory_permille);
    let needed = (trip.needed_permille() + limits::CHARGE_RESERVE_PERMILLE).max(mandatory);
    let has = u64::from(live.report.vitals.battery_permille);
    if has < needed {
        return Err(Reason::from(Code::BatteryLow).with("battery_permille", has).with("needed_permille", needed));
    }
    Ok(())
}

/// Keeps a task for a while from a robot that failed it, as long as another could do it.
fn prefer_others(
    view: &FleetProjection,
    robot_id: &RobotId,
    task: &TaskState,
    intake: &TaskIntake,
    now: &Now,
) -> Result<(), Reason> {
    let waited_ms = now.ms_since(task.queued_since);
    let is_early = waited_ms < limits::OTHERS_FIRST.as_ms();
    let has_failed = task.opened_robot_id.is_none() && task.failed_robots.contains(robot_id);
    if has_failed && is_early && another_could(view, task, intake, robot_id) {
        let told = "The robot failed this task, and for a while it is kept for another that could do it.";
        let left_ms = limits::OTHERS_FIRST.as_ms() - waited_ms;
        return Err(Reason::new(Code::ExcludedAfterFailure, told).with("again_in_ms", left_ms));
    }
    Ok(())
}

/// A robot that refused this task is asked again only once it has said something newer.
fn just_refused(view: &FleetProjection, live: &NewestHeartbeat, task: &TaskState) -> Result<(), Reason> {
    let last = task.attempt_id().and_then(|id| view.attempt(&id)).filter(|a| a.robot_id == live.robot_id);
    match last {
        Some(a)
            if a.phase == AttemptPhase::Refused
                && a.offer.session_epoch == live.report.session_epoch
                && live.report.hb <= a.offer.hb =>
        {
            Err(a.refusal.clone().unwrap_or_else(|| Code::RobotReconciling.into()))
        }
        _ => Ok(()),
    }
}

/// No closed place may bar the way to a goal, nor be one.
fn place(view: &FleetProjection, here: WaypointIx, goals: &[WaypointIx]) -> Result<(), Reason> {
    let closed = routing::closed(view);
    if closed.is_empty() {
        return Ok(());
    }
    let mut at = here;
    for goal in goals {
        if view.router.field_around(*goal, closed).distance_mm(at).is_none() {
            return Err(Reason::from(Code::PlaceOccupied).with("goal", view.site.name_of(*goal)));
        }
        at = *goal;
    }
    Ok(())
}

/// Whether the task may be offered now, whatever the robots.
pub fn task(
    view: &FleetProjection,
    board: &Board,
    task: &TaskState,
    intake: &TaskIntake,
    now: &Now,
) -> Result<(), Reason> {
    if let Some(reason) = view.unknown_rows.of_task(&task.task_id) {
        return Err(reason.clone());
    }
    match task.phase {
        Phase::Queued => {}
        Phase::RetryWait => return Err(Code::WaitingForRetry.into()),
        _ => return Err(Code::NotAllowedNow.into()),
    }
    if let Some(robot_id) = &task.robot_id
        && view.held_by(robot_id) == task.attempt_id().as_ref()
        && task.epoch > 0
        && liveness::lease_stands(view, board, robot_id, now)
    {
        return Err(Reason::from(Code::RobotReconciling).with("robot_id", robot_id));
    }
    view.wait_of(task, intake, now.utc).reason().map_or(Ok(()), Err)
}

/// An idle-looking errand that may be broken off for a task: parking, or charging above the area's threshold.
pub fn recallable(view: &FleetProjection, board: &Board, robot_id: &RobotId) -> bool {
    let Some(id) = view.held_by(robot_id) else { return false };
    let Some(a) = view.attempt(id) else { return false };
    let Subject::Errand { .. } = id.subject else { return false };
    if decided_by_people(view, robot_id, None).is_err() {
        return false;
    }
    let working = matches!(
        a.phase,
        AttemptPhase::Accepted | AttemptPhase::Navigating | AttemptPhase::Executing | AttemptPhase::Paused
    );
    let Some(live) = board.get(robot_id) else { return false };
    let enough = routing::find(view, live.report.vitals.waypoint.as_ref()).is_some_and(|at| {
        live.report.vitals.battery_permille > view.policy(&view.site.area_of(at).area_id).charge_preemptible_permille
    });
    working && a.uncertain.is_none() && (a.errand == Some(crate::task::state::Errand::Park) || enough)
}
