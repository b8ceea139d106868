//! Why a task is not running and why a robot has no work: the planner's own filters, run again for one of them. Stores nothing.

use super::view::View;
use super::{Board, screen, starts, way};
use crate::ids::{RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::task::Phase;
use crate::time::Now;
use std::collections::{BTreeMap, BTreeSet};

/// Candidates listed one by one; the others only by reason.
const CANDIDATES_MAX: usize = 64;

/// Why one robot is or is not the one.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotCandidate {
    /// Who.
    pub robot_id: RobotId,
    /// Why not. None: eligible.
    pub reason: Option<Reason>,
    /// Millimetres to the first goal. None: no way, or not located.
    pub distance_mm: Option<u64>,
}

/// Why a task is where it is.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskExplanation {
    /// 1 is next. None: not waiting.
    pub position: Option<usize>,
    /// In one word. None: nothing holds it.
    pub verdict: Option<Reason>,
    /// Eligible first, then by distance.
    pub candidates: Vec<RobotCandidate>,
    /// Robots by the first reason against them.
    pub filtered: BTreeMap<Code, u64>,
}

/// Explains one task; none if it is not known or has ended.
pub fn task(view: &View, board: &Board, now: &Now, task_id: &TaskId) -> Option<TaskExplanation> {
    let task = view.task(task_id)?;
    let intake = view.intake(task_id)?;
    let waits = matches!(task.phase, Phase::Queued | Phase::RetryWait | Phase::Suspended);
    let position = view.queue.position(task_id);
    let goal = intake
        .spec
        .next_goal(way::from_step(&intake.spec.steps, task.next_step) as usize)
        .and_then(|g| view.site.find(g));
    let mut candidates = Vec::new();
    let mut filtered = BTreeMap::new();
    for session in view.sessions.values().filter(|_| waits) {
        let robot_id = &session.row.robot_id;
        let pair = screen::pair(view, board, robot_id, task, intake);
        let reason = pair.and_then(|()| screen::robot(view, board, robot_id, now)).err();
        if let Some(reason) = &reason {
            *filtered.entry(reason.code).or_default() += 1;
        }
        let at = board.get(robot_id).and_then(|l| way::find(view, l.report.vitals.waypoint.as_ref()));
        let distance_mm = at.zip(goal).and_then(|(at, goal)| view.router.distance_mm(at, goal));
        candidates.push(RobotCandidate { robot_id: robot_id.clone(), reason, distance_mm });
    }
    candidates.sort_by(|a, b| {
        (a.reason.is_some(), a.distance_mm.unwrap_or(u64::MAX), &a.robot_id).cmp(&(
            b.reason.is_some(),
            b.distance_mm.unwrap_or(u64::MAX),
            &b.robot_id,
        ))
    });
    let eligible = candidates.iter().any(|c| c.reason.is_none());
    candidates.truncate(CANDIDATES_MAX);
    let own = screen::task(view, board, task, intake, now).err().filter(|_| waits);
    let verdict = match (own, waits, eligible, task.phase) {
        (Some(reason), ..) => Some(reason),
        (None, true, false, _) => Some(waits_for_turn(view, task_id, now, Code::WaitingForRobot)),
        (None, true, true, _) => Some(waits_for_turn(view, task_id, now, Code::WaitingInQueue)),
        (None, false, _, Phase::Running) => task.robot_id.as_ref().and_then(|r| place_wait(view, r)),
        (None, false, ..) => task.reason.clone(),
    };
    Some(TaskExplanation { position, verdict, candidates, filtered })
}

/// Why a ready task waits, since when, and what waiting has brought it.
fn waits_for_turn(view: &View, task_id: &TaskId, now: &Now, code: Code) -> Reason {
    let Some(rank) = view.queue.rank(task_id) else { return code.into() };
    let (class, minutes) = (rank.class.as_str(), now.utc.ms_since(rank.since) / 60_000);
    if !rank.promoted {
        return code.into();
    }
    let told = format!("{} Promoted to class {class} after {minutes} min of waiting.", code.help());
    Reason::new(code, told).with("class", class).with("ready_since", rank.since.rfc3339())
}

/// Which places the robot waits for, who has them, and for whom they are kept. None: it waits for none.
pub fn place_wait(view: &View, robot_id: &RobotId) -> Option<Reason> {
    let wait = view.waits.get(robot_id)?;
    let others = |ids: BTreeSet<&RobotId>| {
        let others = ids.into_iter().filter(|id| *id != robot_id);
        others.map(RobotId::as_str).collect::<Vec<_>>().join(" ")
    };
    let rows = wait.places.iter().filter_map(|id| view.places.get(id.as_str()));
    let held_by = others(rows.flat_map(|place| &place.row.holders).map(|holder| &holder.robot_id).collect());
    let known = wait.places.iter().filter_map(|id| view.site.find_place(id));
    let kept_for = others(known.flat_map(|place| starts::awaited(view, place)).collect());
    let message = match (held_by.is_empty(), kept_for.is_empty()) {
        (true, false) => "waits for a place that is kept for a robot that starts there and was not heard yet",
        _ => "waits for a place that another robot holds",
    };
    let places = wait.places.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ");
    let mut reason = Reason::new(Code::PlaceBlocked, message).with("places", places);
    for (key, robots) in [("held_by", held_by), ("kept_for", kept_for)] {
        if !robots.is_empty() {
            reason = reason.with(key, robots);
        }
    }
    Some(reason)
}

/// Why one task does not go to the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskCandidate {
    /// Which.
    pub task_id: TaskId,
    /// Why not. None: eligible.
    pub reason: Option<Reason>,
    /// Millimetres to its first goal.
    pub distance_mm: Option<u64>,
}

/// Why a robot has no work, or what it does.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotExplanation {
    /// None: it may be given work.
    pub verdict: Option<Reason>,
    /// Places it waits for, and who has them. None: it waits for none.
    pub place_wait: Option<Reason>,
    /// Waiting tasks in the order in which they are served.
    pub candidates: Vec<TaskCandidate>,
}

/// Explains one robot; none if it never connected.
pub fn robot(view: &View, board: &Board, now: &Now, robot_id: &RobotId) -> Option<RobotExplanation> {
    view.sessions.get(robot_id.as_str())?;
    let at = board.get(robot_id).and_then(|l| way::find(view, l.report.vitals.waypoint.as_ref()));
    let candidates = view.queue.ready().take(CANDIDATES_MAX).filter_map(|task_id| {
        let task = view.task(task_id)?;
        let intake = view.intake(task_id)?;
        let reason = screen::task(view, board, task, intake, now)
            .and_then(|()| screen::pair(view, board, robot_id, task, intake))
            .err();
        let goal = intake
            .spec
            .next_goal(way::from_step(&intake.spec.steps, task.next_step) as usize)
            .and_then(|g| view.site.find(g));
        let distance_mm = at.zip(goal).and_then(|(at, goal)| view.router.distance_mm(at, goal));
        Some(TaskCandidate { task_id: task_id.clone(), reason, distance_mm })
    });
    Some(RobotExplanation {
        verdict: screen::robot(view, board, robot_id, now).err(),
        place_wait: place_wait(view, robot_id),
        candidates: candidates.collect(),
    })
}
