//! Composes what each robot should have now and writes it if it differs: desired state is level-triggered, "sent or not" is never stored.
//!
//! Invariant: generations only rise. An offer is anchored once and never again; an unentered grant or a resume that should still stand is
//! anchored anew to the newest heartbeat.

use super::anchor::{anchor, is_worn, next_generation};
use super::routing;
use crate::authority::Authority;
use crate::desired_state::{AreaRules, Assignment, DesiredPolicy, DesiredWork, GrantedPlace, RoutePoint};
use crate::fleet::decision::incidents;
use crate::fleet::decision::plan::Tx;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::{HolderState, RobotHolder};
use crate::fleet::projection::state::{FleetProjection, held};
use crate::fleet::tasks::{attempts, claims, load};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId};
use crate::limits;
use crate::robot::ReportedAttempt;
use crate::robot::WorkState;
use crate::task::{AfterStopping, Attempt, AttemptPhase};
use std::collections::BTreeMap;

/// What a robot may do from this cycle on; `desired` writes it down.
#[derive(Clone, Debug, Default)]
pub struct Releases(pub BTreeMap<RobotId, Release>);

/// A newly released stretch.
#[derive(Clone, Debug)]
pub struct Release {
    /// Another route, if the server chose one.
    pub route: Option<Vec<RoutePoint>>,
    /// Index into the route up to which the robot may drive.
    pub released_index: u32,
}

/// Writes what `robot_id` should have, if it differs from what stands.
pub fn compose(tx: &mut Tx, robot_id: &RobotId, board: &Board, releases: &Releases) {
    let Some(session) = tx.view.sessions.get(robot_id.as_str()).map(|s| s.row.clone()) else { return };
    let stands = tx.view.desired_work.get(robot_id.as_str()).map(|d| d.row.clone());
    let old = stands.clone().unwrap_or_else(|| empty(robot_id));
    let live = board.get(robot_id).map(|l| &**l);
    let attempt = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned();
    let live_attempt = attempt.filter(|a| !a.phase.is_terminal());
    let is_held = is_held(tx.view, robot_id);
    // A robot is let go only with a permission to move, and that needs a heartbeat to be anchored to.
    let resume = resume(tx.view, robot_id, &old, is_held, board);
    let given = live_attempt.as_ref().and_then(|a| assign(tx.view, a, old.assignment.as_ref(), live, releases));
    let unlawful = given.as_ref().filter(|given| !given.is_lawful()).map(|given| given.attempt.clone());
    let new = DesiredWork {
        robot_id: robot_id.clone(),
        generation: old.generation,
        assignment: given.filter(Assignment::is_lawful),
        grants: grants(tx.view, robot_id, &old, board),
        held: is_held || (old.held && resume.is_none()),
        resume,
        closed: closed(&old, live, live_attempt.as_ref().map(|a| &a.attempt), tx.view.held_by(robot_id)),
        maintenance: match tx.view.authority.get(robot_id.as_str()).map(|a| &a.row.holder) {
            Some(RobotHolder::Maintenance(drain_id)) => Some(drain_id.clone()),
            _ => None,
        },
        resumed: tx.view.control.get(robot_id.as_str()).map(|c| c.row.resumed.clone()).unwrap_or_default(),
        load_word: live.and_then(|live| load::word_for(tx.view, live)),
    };
    if let Some(attempt) = unlawful {
        let reason = crate::reason::Reason::from(crate::reason::Code::AssignmentUnlawful).with("attempt", attempt);
        incidents::open_about(tx, reason, Some(robot_id), "attempt");
    }
    let followed = session.followed_work();
    let behind = followed > old.generation;
    if session.applied_work > old.generation {
        claims::outran(tx, robot_id, session.applied_work, behind);
    }
    if stands.is_some() && new == old && !behind {
        return;
    }
    let generation = next_generation(tx.view, robot_id, &tx.now).max(followed + 1);
    tx.put_row(DesiredWork { generation, ..new }, "work.desired");
}

/// A robot nobody has asked anything of.
pub fn empty(robot_id: &RobotId) -> DesiredWork {
    DesiredWork {
        robot_id: robot_id.clone(),
        generation: 0,
        assignment: None,
        grants: Vec::new(),
        held: false,
        resume: None,
        closed: Vec::new(),
        maintenance: None,
        resumed: Vec::new(),
        load_word: None,
    }
}

/// A token of the robot, or of the task of its live attempt, stands.
fn is_held(view: &FleetProjection, robot_id: &RobotId) -> bool {
    let live = view.held_by(robot_id).and_then(|id| view.attempt(id)).filter(|a| !a.phase.is_terminal());
    let task = live.and_then(|a| a.attempt.subject.task_id()).and_then(|t| view.task(t));
    view.robot_holds(robot_id).next().is_some() || task.is_some_and(|t| !t.holds.is_empty())
}

fn assign(
    view: &FleetProjection,
    a: &Attempt,
    old: Option<&Assignment>,
    live: Option<&NewestHeartbeat>,
    releases: &Releases,
) -> Option<Assignment> {
    let then = a.attempt.subject.task_id().and_then(|t| view.task(t)).and_then(|t| t.then);
    let stopping = a.phase == AttemptPhase::Stopping || then.is_some();
    let mut work = match old.filter(|o| o.attempt == a.attempt) {
        Some(old) => old.clone(),
        None => begin(view, a, live)?,
    };
    work.suspend = stopping && then == Some(AfterStopping::Suspended);
    work.stop = stopping && !work.suspend;
    if let Some(release) = releases.0.get(&a.robot_id) {
        if let Some(route) = &release.route {
            work.route = route.clone();
            work.route_number += 1;
        }
        work.released_index = Some(release.released_index);
    }
    Some(work)
}

/// A new attempt, with the whole way through all its goals from where the robot is.
fn begin(view: &FleetProjection, a: &Attempt, live: Option<&NewestHeartbeat>) -> Option<Assignment> {
    let here = routing::find(view, live.and_then(|l| l.report.vitals.waypoint.as_ref()));
    let (steps, timeout_ms, resume_step, speed) = match a.attempt.subject.task_id() {
        Some(task_id) => {
            let spec = &view.intake(task_id)?.spec;
            (spec.steps.clone(), spec.timeout_ms, view.task(task_id)?.next_step, spec.speed_limit_mm_s)
        }
        None => (attempts::steps(view, a), attempts::ERRAND_TIMEOUT.as_ms(), 0, None),
    };
    let from_step = crate::step::from_step(&steps, resume_step);
    let goals = routing::goals(&view.site, &steps, from_step)?;
    let route = match here {
        Some(here) => routing::route(view, here, None, &goals)?,
        None => return None,
    };
    Some(Assignment {
        attempt: a.attempt.clone(),
        offer: a.offer,
        timeout_ms: timeout_ms - timeout_ms * limits::AGENT_TIMEOUT_EARLIER_PERMILLE / 1000,
        steps,
        from_step,
        resume_step: resume_step.max(from_step),
        route_number: 1,
        route,
        released_index: Some(0),
        stop: false,
        suspend: false,
        speed_limit_mm_s: speed,
    })
}

/// Listed, and may not be entered: no session has this epoch. It is renewed with the robot's next heartbeat.
const NOT_YET: Authority = Authority { session_epoch: 1, hb: 0, valid_ms: 1 };

fn grants(view: &FleetProjection, robot_id: &RobotId, old: &DesiredWork, board: &Board) -> Vec<GrantedPlace> {
    let live = board.get(robot_id).map(|l| &**l);
    let listed = held(view, robot_id).filter(|(_, h)| h.state != HolderState::Revoking);
    listed
        .map(|(place, holder)| {
            let known = old.grants.iter().find(|g| g.place_id == place.place_id && g.grant_id == holder.grant_id);
            let known = known.and_then(|g| g.entry);
            let entry = match holder.state {
                HolderState::Inside | HolderState::Revoking => None,
                HolderState::Granted => known
                    .filter(|e| !is_worn(e, live))
                    .or_else(|| anchor(view, robot_id, board, limits::PLACE_ENTRY_VALID))
                    .or(known)
                    .or(Some(NOT_YET)),
            };
            GrantedPlace { place_id: place.place_id.clone(), grant_id: holder.grant_id, entry }
        })
        .collect()
}

fn resume(
    view: &FleetProjection,
    robot_id: &RobotId,
    old: &DesiredWork,
    is_held: bool,
    board: &Board,
) -> Option<Authority> {
    if is_held {
        return None;
    }
    let live = board.get(robot_id);
    let paused = live.is_some_and(|l| l.report.attempts.iter().any(|a| a.state == WorkState::Paused));
    match old.resume {
        None if old.held => anchor(view, robot_id, board, limits::RESUME_VALID),
        Some(known) if paused && is_worn(&known, live.map(|l| &**l)) => {
            anchor(view, robot_id, board, limits::RESUME_VALID).or(Some(known))
        }
        known => known,
    }
}

/// Attempts that the robot may forget. One that is over stays until it holds the robot no more: its end is yet to be judged.
fn closed(
    old: &DesiredWork,
    live: Option<&NewestHeartbeat>,
    current: Option<&AttemptId>,
    holder: Option<&AttemptId>,
) -> Vec<AttemptId> {
    let Some(live) = live else { return old.closed.clone() };
    let may_go = |r: &&ReportedAttempt| match r.state {
        WorkState::StepUnknown => Some(&r.attempt) != current,
        state => state.is_over() && Some(&r.attempt) != holder,
    };
    let mut closed: Vec<AttemptId> = live.report.attempts.iter().filter(may_go).map(|r| r.attempt.clone()).collect();
    closed.sort();
    closed
}

/// Finds robots whose permissions expire while they stand unused.
pub fn find_expiring_permissions(view: &FleetProjection, board: &Board) -> Vec<RobotId> {
    let worn = |d: &DesiredWork| {
        let live = || board.get(&d.robot_id).map(|l| &**l);
        if d.held && live().is_some() && !is_held(view, &d.robot_id) {
            return true;
        }
        let mut entries = d.grants.iter().filter_map(|g| g.entry.as_ref()).chain(d.resume.as_ref());
        entries.any(|a| is_worn(a, live()))
    };
    view.desired_work.values().filter(|d| worn(&d.row)).map(|d| d.row.robot_id.clone()).collect()
}

/// Writes the rules of all areas for a robot, if they differ from what stands.
pub fn compose_policy(tx: &mut Tx, robot_id: &RobotId) {
    let areas: Vec<_> = tx
        .view
        .site
        .areas()
        .iter()
        .map(|a| AreaRules { without_people: !a.people, ..tx.view.policy(&a.area_id).into() })
        .collect();
    let old = tx.view.desired_policy.get(robot_id.as_str()).map(|d| d.row.clone());
    if old.as_ref().is_some_and(|o| o.areas == areas) {
        return;
    }
    let generation = (old.map_or(0, |o| o.generation) + 1).max(tx.now.wall.0.max(0) as u64);
    tx.put_row(DesiredPolicy { robot_id: robot_id.clone(), generation, areas }, "policy.desired");
}
