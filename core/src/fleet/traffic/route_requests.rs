//! What robots ask of their routes, and in which order they are served.
//!
//! Invariant: the order is class, then age. Two kinds of robots are served before all others: one that lost a place of its released stretch, and one
//! that stands in a passage with no standing place ahead. Others may be waiting for that passage.

use super::routing;
use crate::desired_state::Assignment;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::memory::Waiting;
use crate::fleet::projection::rows::{HolderState, Place, PlaceHolder};
use crate::fleet::projection::state::{self, FleetProjection};
use crate::fleet::tasks::plausible;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{PlaceId, RobotId};
use crate::presence::Presence;
use crate::site::route::{Segment, segments};
use crate::site::{PlaceIx, PlaceKind};
use crate::task::spec::Class;
use crate::task::{Attempt, AttemptPhase};
use crate::time::{Now, SiteTime};
use std::collections::BTreeSet;

/// A robot that needs more of its route.
pub(super) struct Request {
    /// Nothing of its released stretch is missing, and it bars no passage.
    is_patient: bool,
    class: Class,
    since: SiteTime,
    pub robot_id: RobotId,
}

/// Requests of all robots that may drive, the first to be served first. Forgets since when robots wait that ask for nothing any more.
pub(super) fn in_order(view: &mut FleetProjection, board: &Board, now: &Now) -> Vec<Request> {
    let mut requests: Vec<Request> = Vec::new();
    for (robot_id, id) in view.robots_at_work() {
        let Some(live) = board.get(robot_id) else { continue };
        let Some(a) = view.attempt(id) else { continue };
        if !may_drive(view, a, live, board, now) || plausible::keeps_back(view, live).is_err() {
            continue;
        }
        let whole = missing(view, live, a).is_empty();
        if !whole || !is_released(view, robot_id, a) {
            let since = view.waits.get(robot_id).map_or(now.site, |w| w.since);
            let is_patient = whole && !bars_passage(view, robot_id);
            requests.push(Request { is_patient, class: class_of(view, a), since, robot_id: robot_id.clone() });
        }
    }
    let wanting: BTreeSet<RobotId> = requests.iter().map(|r| r.robot_id.clone()).collect();
    view.waits.retain(|r, _| wanting.contains(r));
    requests.sort_by(|a, b| {
        (a.is_patient, a.class, a.since, &a.robot_id).cmp(&(b.is_patient, b.class, b.since, &b.robot_id))
    });
    requests
}

/// Whether the robot stands because it waits for a place.
pub fn waits(view: &FleetProjection, robot_id: &RobotId) -> bool {
    view.waits.contains_key(robot_id)
}

/// Whether another robot waits for a place that has no seat left.
pub fn is_waited_for(view: &FleetProjection, robot_id: &RobotId, place_id: &PlaceId) -> bool {
    let is_full = || {
        let row = view.places.get(place_id.as_str()).map(|place| &place.row);
        row.is_some_and(|row| row.holders.len() >= row.capacity as usize)
    };
    let wants = |wait: &Waiting| wait.for_order.is_none() && wait.places.contains(place_id);
    view.waits.iter().any(|(other, wait)| other != robot_id && wants(wait)) && is_full()
}

/// Whether another robot waits for an order that this one is in the way of.
pub fn is_in_an_orders_way(view: &FleetProjection, robot_id: &RobotId) -> bool {
    let others = view.waits.iter().filter(|(other, _)| *other != robot_id);
    others.filter_map(|(_, wait)| wait.for_order.as_ref()).any(|robots| robots.contains(robot_id))
}

/// The robot is inside a passage and has no standing place to go on to: its task ended there.
pub(super) fn bars_passage(view: &FleetProjection, robot_id: &RobotId) -> bool {
    let mut inside = false;
    for (place, holder) in state::held(view, robot_id) {
        if place.kind == PlaceKind::Standing {
            return false;
        }
        inside |= holder.state == HolderState::Inside;
    }
    inside
}

fn class_of(view: &FleetProjection, a: &Attempt) -> Class {
    let rows = a.attempt.subject.task_id().and_then(|t| view.task(t).zip(view.intake(t)));
    let priority = rows.map_or(9, |(task, intake)| task.priority(intake));
    Class::from_priority(priority, 0)
}

/// An accepted attempt of a robot that is heard, not held and not told to stop.
pub(super) fn may_drive(view: &FleetProjection, a: &Attempt, live: &NewestHeartbeat, board: &Board, now: &Now) -> bool {
    let working = matches!(
        a.phase,
        AttemptPhase::Accepted | AttemptPhase::Navigating | AttemptPhase::Executing | AttemptPhase::Paused
    );
    let robot_id = &a.robot_id;
    let session =
        view.sessions.get(robot_id.as_str()).is_some_and(|s| s.row.session_epoch == live.report.session_epoch);
    let held = view.desired_work.get(robot_id.as_str()).is_some_and(|d| d.row.held);
    working && session && !held && a.uncertain.is_none() && liveness::presence(board, robot_id, now) == Presence::Online
}

pub(super) fn assignment<'a>(view: &'a FleetProjection, robot_id: &RobotId, a: &Attempt) -> Option<&'a Assignment> {
    let desired = &view.desired_work.get(robot_id.as_str())?.row;
    desired.assignment.as_ref().filter(|x| x.attempt == a.attempt)
}

fn is_released(view: &FleetProjection, robot_id: &RobotId, a: &Attempt) -> bool {
    let Some(work) = assignment(view, robot_id, a) else { return true };
    let end = work.route.len().saturating_sub(1) as u32;
    work.released_index.is_some_and(|r| r >= end) || next_segment(view, robot_id, a, work).is_none()
}

/// The robot stands at the end of what was released to it, and there is more that could be.
pub fn is_out_of_route(view: &FleetProjection, live: &NewestHeartbeat, a: &Attempt) -> bool {
    let Some(work) = assignment(view, &live.robot_id, a) else { return false };
    let Some(listed) = live.report.attempts.iter().find(|r| r.attempt == a.attempt) else { return false };
    let released = work.released_index.unwrap_or(0);
    let stands = live.report.vitals.speed_mm_s == 0 && listed.route_index >= released;
    stands && !is_released(view, &live.robot_id, a)
}

/// The next stretch to release, if it is time for it: not before the step behind the last one is done, and at most one ahead.
pub(super) fn next_segment(
    view: &FleetProjection,
    robot_id: &RobotId,
    a: &Attempt,
    work: &Assignment,
) -> Option<Segment> {
    let route = routing::indices(&view.site, &work.route)?;
    let released = work.released_index.unwrap_or(0) as usize;
    let segment = segments(&view.site, &route).into_iter().find(|s| s.end > released)?;
    let leads_to = work.route.iter().skip(segment.start + 1).find_map(|p| p.ends_step);
    if !segment.places().is_empty()
        && work.route[segment.start].ends_step.is_some()
        && leads_to.is_some_and(|step| a.step_index < step)
    {
        return None;
    }
    let is_unentered = |(place, holder): &(&Place, &PlaceHolder)| {
        place.kind == PlaceKind::Standing && holder.state == HolderState::Granted
    };
    let unentered = state::held(view, robot_id).filter(is_unentered).count();
    (unentered <= 1).then_some(segment)
}

/// Places on the released stretch ahead that a standing robot does not hold: a passage that its route crosses a second time, or grants that
/// it lost with its memory. Only a settled, newest report tells.
pub(super) fn missing(view: &FleetProjection, live: &NewestHeartbeat, a: &Attempt) -> Vec<PlaceIx> {
    let standing = live.report.vitals.speed_mm_s == 0;
    let Some(reported) = live.report.attempts.iter().find(|r| r.attempt == a.attempt) else { return Vec::new() };
    let Some(work) = assignment(view, &live.robot_id, a) else { return Vec::new() };
    if !standing || !liveness::is_settled(view, live) || !liveness::is_fresh(view, live) {
        return Vec::new();
    }
    let released = work.released_index.unwrap_or(0) as usize;
    let ahead = work.route.iter().take(released + 1).skip(reported.route_index as usize + 1);
    let needed = ahead.flat_map(|p| p.passages.iter().chain(&p.standing));
    let held = |id: &PlaceId| view.places.get(id.as_str()).is_some_and(|p| p.row.holder(&live.robot_id).is_some());
    let lost: BTreeSet<PlaceIx> = needed.filter(|id| !held(id)).filter_map(|id| view.site.find_place(id)).collect();
    lost.into_iter().collect()
}
