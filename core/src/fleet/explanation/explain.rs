//! Why a task is not running and why a robot has no work: the planner's own filters, run again for one of them. Stores nothing.

use super::wait_reasons;
use crate::energy::RobotEnergy;
use crate::fleet::assignment::demand::Demand;
use crate::fleet::assignment::filters;
use crate::fleet::decision::report::WAITS_FOR;
use crate::fleet::facts::misreads;
use crate::fleet::projection::chosen::PlanChoice;
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::start_estimates::StartEstimate;
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::load;
use crate::fleet::traffic::{closed_places, routing};
use crate::ids::{RobotId, TaskId};
use crate::limits;
use crate::reason::{Code, Reason};
use crate::task::{Phase, TaskState};
use crate::time::{Now, Utc};
use std::collections::BTreeMap;

/// Candidates listed one by one; the others only by reason.
const CANDIDATES_MAX: usize = 64;

/// Why one robot is or is not the one.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotCandidate {
    /// The robot that was considered.
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
    /// UTC, when its robot will be free; now, if as many are eligible as tasks go before it; else the middle of `start`. None: nobody can tell.
    pub expected: Option<Utc>,
    /// Between when and when tasks got a robot lately that stood as it does. None: it is not ready, or too few did.
    pub start: Option<StartEstimate>,
    /// Why the newest plan that gave it to a robot, or meant it for one, chose that robot. None: none did, or that is forgotten.
    pub choice: Option<PlanChoice>,
}

/// Explains one task; none if it is not known or has ended.
pub fn task(view: &FleetProjection, board: &Board, now: &Now, task_id: &TaskId) -> Option<TaskExplanation> {
    let known = view.task(task_id);
    let waits = known.is_none_or(|t| matches!(t.phase, Phase::Queued | Phase::RetryWait | Phase::Suspended));
    if let Some(reason) = view.unknown_rows.of_task(task_id).filter(|_| waits) {
        return Some(unknown(reason.clone()));
    }
    let task = known?;
    let intake = view.intake(task_id)?;
    let position = view.queue.position(task_id);
    let goal = intake
        .spec
        .next_goal(crate::step::from_step(&intake.spec.steps, task.next_step) as usize)
        .and_then(|g| view.site.find(g));
    let demand = Demand::new(view, task, intake);
    let mut candidates = Vec::new();
    let mut filtered = BTreeMap::new();
    let robots = waits.then(|| screened(view, board, now));
    for (robot_id, against) in robots.into_iter().flatten() {
        let reason = filters::pair(view, board, robot_id, &demand, now).err().or_else(|| against.clone());
        let reason = reason.map(|why| closed_places::name_closed(view, why));
        if let Some(reason) = &reason {
            *filtered.entry(reason.code).or_default() += 1;
        }
        let at = board.get(robot_id).and_then(|l| routing::find(view, l.report.vitals.waypoint.as_ref()));
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
    let awaited = match task.pinned_robot(intake) {
        Some(pinned) => candidates.iter().find(|c| c.robot_id == *pinned).map_or_else(|| absent(pinned), awaited),
        None => candidates.first().map_or_else(|| "a robot: none has connected".to_owned(), awaited),
    };
    let closed = candidates.iter().find_map(|c| barring(c.reason.as_ref())).filter(|_| !eligible).cloned();
    let eligible_ones = candidates.iter().filter(|c| c.reason.is_none()).count();
    let is_next = position.is_some_and(|position| position <= eligible_ones);
    let meant = wait_reasons::meant_for(view, now, task);
    // Who is busy comes back; of one that is kept from work nobody knows.
    let is_awaited = |c: &RobotCandidate| c.reason.as_ref().is_none_or(|why| why.code == Code::RobotBusy);
    let outlook = view.start_outlook(task_id, now.utc).filter(|_| candidates.iter().any(is_awaited));
    let start = outlook.and_then(|outlook| view.starts.estimate(&outlook, now.utc));
    let expected = meant.map(|meant| meant.free.max(now.utc)).or_else(|| is_next.then_some(now.utc));
    let expected = expected.or_else(|| start.map(|start| start.p50));
    candidates.truncate(CANDIDATES_MAX);
    let code = if eligible { Code::WaitingInQueue } else { Code::WaitingForRobot };
    let turn = || {
        let why = waits_for_turn(view, task_id, now, code).with(WAITS_FOR, awaited);
        closed.into_iter().fold(why, |mut why, closed| {
            why.message = format!("{} {}", why.text(), closed.text());
            why
        })
    };
    let verdict = wait_reasons::of_task(view, board, now, task, intake).or_else(|| waits.then(turn));
    let verdict = verdict.or_else(|| task.reason.clone());
    let expected = expected.filter(|_| position.is_some());
    let choice = view.chosen.get(task_id).cloned();
    Some(TaskExplanation { position, verdict, candidates, filtered, expected, start, choice })
}

/// Why each robot with a session gets no work, looked at once for all explanations of a turn.
fn screened<'v>(view: &'v FleetProjection, board: &Board, now: &Now) -> &'v BTreeMap<RobotId, Option<Reason>> {
    let against = |robot_id: &RobotId| filters::robot(view, board, robot_id, now).err();
    let robots = || view.sessions.values().map(|session| session.row.robot_id.clone());
    view.screened.get_or_init(|| robots().map(|robot_id| (robot_id.clone(), against(&robot_id))).collect())
}

/// Questions that one turn answers where there are so many robots: at least one, however many.
pub fn per_turn(robots: usize) -> usize {
    (limits::ROBOTS_ASKED_PER_TURN / robots.max(1)).max(1)
}

/// A task that is not in the projection: how it ended, or that the planner has not read it yet.
pub fn stored(task: &TaskState) -> TaskExplanation {
    let unread = || Reason::from(Code::WaitingInQueue).with(WAITS_FOR, "the planner: it has not read the task yet");
    let verdict = Some(if task.phase.is_terminal() { wait_reasons::ended(task) } else { unread() });
    only(verdict)
}

/// A task one of whose rows holds a value of a newer version.
pub fn unknown(reason: Reason) -> TaskExplanation {
    let verdict = Some(reason.with(WAITS_FOR, "the newer version of the server"));
    only(verdict)
}

fn only(verdict: Option<Reason>) -> TaskExplanation {
    let (candidates, filtered) = (Vec::new(), BTreeMap::new());
    TaskExplanation { position: None, verdict, candidates, filtered, expected: None, start: None, choice: None }
}

/// The robot that a task waits for, and what keeps that one.
fn awaited(candidate: &RobotCandidate) -> String {
    match candidate {
        RobotCandidate { robot_id, reason: Some(why), .. } => format!("robot {robot_id}: {}", why.code),
        candidate => format!("robot {}", candidate.robot_id),
    }
}

fn absent(robot_id: &RobotId) -> String {
    format!("robot {robot_id}: it has not connected")
}

/// Why a ready task waits, since when, and what waiting has brought it.
fn waits_for_turn(view: &FleetProjection, task_id: &TaskId, now: &Now, code: Code) -> Reason {
    let Some(rank) = view.queue.rank(task_id) else { return code.into() };
    let (class, minutes) = (rank.class.as_str(), now.utc.ms_since(rank.since) / 60_000);
    if !rank.promoted {
        return code.into();
    }
    let told = format!("{} Promoted to class {class} after {minutes} min of waiting.", code.help());
    Reason::new(code, told).with("class", class).with("ready_since", rank.since.rfc3339())
}

/// Why one task does not go to the robot.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskCandidate {
    /// The task that was considered.
    pub task_id: TaskId,
    /// Why not. None: eligible.
    pub reason: Option<Reason>,
    /// Millimetres to its first goal.
    pub distance_mm: Option<u64>,
}

/// Why a robot has no work, or what it does.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotExplanation {
    /// What it does or waits for. None: it may be given work.
    pub verdict: Option<Reason>,
    /// Waiting tasks in the order in which they are served.
    pub candidates: Vec<TaskCandidate>,
    /// What its work costs, by which it is planned.
    pub energy: RobotEnergy,
}

/// Explains one robot; none if it never connected, nor was refused.
pub fn robot(view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId) -> Option<RobotExplanation> {
    let refused = misreads::unheard(view, board, now, robot_id);
    if !view.unknown_rows.names(robot_id) && refused.is_none() {
        view.sessions.get(robot_id.as_str())?;
    }
    let energy = *view.energy_of(robot_id);
    if let Err(unread) = view.unknown_rows.check_robot(robot_id) {
        let verdict = Some(wait_reasons::about_robot(unread, robot_id));
        return Some(RobotExplanation { verdict, candidates: Vec::new(), energy });
    }
    let at = board.get(robot_id).and_then(|l| routing::find(view, l.report.vitals.waypoint.as_ref()));
    let candidates = view.queue.ready().take(CANDIDATES_MAX).filter_map(|task_id| {
        let task = view.task(task_id)?;
        let intake = view.intake(task_id)?;
        let reason = filters::task(view, board, task, intake, now)
            .and_then(|()| filters::pair(view, board, robot_id, &Demand::new(view, task, intake), now))
            .err()
            .map(|why| closed_places::name_closed(view, why));
        let goal = intake
            .spec
            .next_goal(crate::step::from_step(&intake.spec.steps, task.next_step) as usize)
            .and_then(|g| view.site.find(g));
        let distance_mm = at.zip(goal).and_then(|(at, goal)| view.router.distance_mm(at, goal));
        Some(TaskCandidate { task_id: task_id.clone(), reason, distance_mm })
    });
    let candidates: Vec<TaskCandidate> = candidates.collect();
    let kept = || filters::robot(view, board, robot_id, now).err().or_else(|| carries(view, board, robot_id));
    let barred = || {
        let closed: Option<Vec<&Reason>> = candidates.iter().map(|c| barring(c.reason.as_ref())).collect();
        closed.and_then(|closed| closed.first().copied().cloned())
    };
    let verdict = refused.or_else(|| wait_reasons::of_robot(view, board, now, robot_id)).or_else(kept).or_else(barred);
    let verdict = verdict.map(|why| wait_reasons::about_robot(why, robot_id));
    Some(RobotExplanation { verdict, candidates, energy })
}

/// The reason, if it names a closed or blocked place that bars the way.
fn barring(why: Option<&Reason>) -> Option<&Reason> {
    why.filter(|why| matches!(why.code, Code::PlaceOccupied | Code::PlaceBlocked) && !why.message.is_empty())
}

/// The robot carries what is of no task that waits for it, its own item of one that waits for a person or for its next try, or what a person has
/// put back.
fn carries(view: &FleetProjection, board: &Board, robot_id: &RobotId) -> Option<Reason> {
    let load = load::carried(view, board.get(robot_id)?)?;
    let task = load.task_id.as_ref().and_then(|id| view.task(id));
    let is_its_own = |task: &TaskState| {
        let is_item = view.intake(&task.task_id).is_some_and(|intake| load::is_item_of(load, task, intake));
        is_item && task.opened_robot_id.as_ref().is_none_or(|r| r == robot_id)
    };
    let asks = task.is_some_and(|task| match task.phase {
        Phase::RetryWait => is_its_own(task),
        phase => phase == Phase::NeedsOperator,
    });
    if !asks && task.is_some_and(is_its_own) {
        return None;
    }
    let reason = match task.filter(|_| asks) {
        Some(task) if task.phase == Phase::RetryWait => {
            let at = task.retry_at.map_or_else(|| "later".to_owned(), |at| format!("at {}", at.rfc3339()));
            let told = format!("The robot carries an item of task {}, which goes on with it {at}.", task.task_id);
            Reason::new(Code::RobotLoaded, told).with("item", &load.item).with(WAITS_FOR, format!("the next try {at}"))
        }
        Some(task) => {
            let told = format!("The robot carries an item of task {}, which waits for a person's word.", task.task_id);
            let resolve = format!("a person: midshift task resolve {} --as ANSWER --reason TEXT", task.task_id);
            Reason::new(Code::RobotLoaded, told).with("item", &load.item).with(WAITS_FOR, resolve)
        }
        None => load::explain_load(view, robot_id, load),
    };
    Some(load.task_id.iter().fold(reason, |reason, task_id| reason.with("task_id", task_id)))
}
