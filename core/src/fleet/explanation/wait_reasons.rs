//! Says of tasks, attempts and robots what they do, or what they wait for.
//!
//! Invariants:
//! 1. A reason that waits has the fact [`WAITS_FOR`]: a place with its holder, a robot, a person, a task, a stop, or a time.
//! 2. A reason without it has the code [`Code::WorksOnStep`].
//!
//! Called by `explain` for people, and by `unexplained`, which counts what has no reason.

use crate::fleet::assignment::filters;
use crate::fleet::decision::report::WAITS_FOR;
use crate::fleet::facts::stops::Hold;
use crate::fleet::projection::broken_steps::StepAt;
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::memory::{MeantFor, Waiting};
use crate::fleet::projection::queue::Wait;
use crate::fleet::projection::rows::{Place, RobotHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::{claims, eligibility, plausible};
use crate::fleet::traffic::{blocked_places, closed_places, engaged_stops, route_requests, starts};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{PlaceId, RobotId};
use crate::presence::Presence;
use crate::reason::{Code, Reason};
use crate::robot::{Mode, WorkState};
use crate::task::{Attempt, AttemptPhase, Phase, TaskIntake, TaskState};
use crate::time::{Now, Utc};
use std::collections::BTreeSet;

/// The fact that names places which are closed.
const SHUT: &str = "quarantined";
/// The fact that names places which people blocked.
const BLOCKED: &str = "blocked";

/// Whether a reason says what is done, or names what it waits for.
pub fn is_told(reason: &Reason) -> bool {
    reason.code == Code::WorksOnStep || reason.metadata.get(WAITS_FOR).is_some_and(|what| !what.is_empty())
}

/// Why a task that has not ended is where it is. None: nothing is in its way but the choice of a robot, or nobody can say.
pub fn of_task(
    view: &FleetProjection,
    board: &Board,
    now: &Now,
    task: &TaskState,
    intake: &TaskIntake,
) -> Option<Reason> {
    match task.phase {
        Phase::Queued => queued(view, board, now, task, intake),
        Phase::RetryWait => {
            let until = task.retry_at.map_or_else(|| "its back-off".to_owned(), |at| at.rfc3339());
            Some(Reason::from(Code::WaitingForRetry).with(WAITS_FOR, until))
        }
        Phase::NeedsOperator => {
            let why = task.reason.clone().unwrap_or_else(|| Code::NotAllowedNow.into());
            Some(
                why.with(
                    WAITS_FOR,
                    format!("a person: midshift task resolve {} --as ANSWER --reason TEXT", task.task_id),
                ),
            )
        }
        Phase::Suspended => task.reason.clone().map(|why| why.with(WAITS_FOR, "its return to the queue")),
        Phase::Held if task.held_by_person().is_some() => held_by_person(task),
        Phase::Held if !task.holds.is_empty() => task.holds.first().map(|token| held(Code::WaitingForHold, token)),
        Phase::Assigned | Phase::Running | Phase::Held | Phase::Stopping => {
            let a = task.attempt_id().and_then(|id| view.attempt(&id))?;
            of_attempt(view, board, now, a)
        }
        Phase::Succeeded | Phase::Failed | Phase::Canceled | Phase::Expired => Some(ended(task)),
    }
}

fn queued(view: &FleetProjection, board: &Board, now: &Now, task: &TaskState, intake: &TaskIntake) -> Option<Reason> {
    let Err(why) = filters::task(view, board, task, intake, now) else {
        let meant = meant_for(view, now, task)?;
        let told = format!("robot {}: it is free soon and nearer than others", meant.robot_id);
        return Some(Reason::from(Code::WaitingForRobot).with(WAITS_FOR, told));
    };
    let what = match view.wait_of(task, intake, now.utc) {
        // What a person can end is told before what passes by itself.
        _ if task.held_by_person().is_some() => return held_by_person(task),
        Wait::Time(at) => at.rfc3339(),
        Wait::Hold(token) => return Some(held(why.code, &token)),
        Wait::Dependency(id) | Wait::Failed(id) => format!("task {id}"),
        Wait::Step(at, _) => broken_step(view, now, &at),
        Wait::Turn(_) | Wait::Mark => task.robot_id.as_ref().map(|r| format!("robot {r}")).unwrap_or_default(),
    };
    Some(why.with(WAITS_FOR, what))
}

/// Who finds out whether a step that is broken can be done again.
fn broken_step(view: &FleetProjection, now: &Now, at: &StepAt) -> String {
    let Some(broken) = view.broken_steps.get(at) else { return String::new() };
    let close = format!("a person: midshift incident close {} --reason TEXT", broken.incident_id);
    match view.steps_failed.probe_of(at) {
        Some(task_id) => format!("task {task_id}, which probes it, or {close}"),
        None if broken.again > now.utc => format!("a probe at {}, or {close}", broken.again.rfc3339()),
        None => format!("a task that probes it, or {close}"),
    }
}

/// Who holds a task, and what lets it go on.
fn held_by_person(task: &TaskState) -> Option<Reason> {
    let release = format!("a person: midshift task release {} --reason TEXT", task.task_id);
    task.held_by_person().map(|why| why.with(WAITS_FOR, release))
}

/// The robot at work that a ready task is meant for, as long as one may be.
pub fn meant_for<'v>(view: &'v FleetProjection, now: &Now, task: &TaskState) -> Option<&'v MeantFor> {
    let meant = view.meant.get(&task.task_id).filter(|_| view.queue.rank(&task.task_id).is_some())?;
    (view.held_by(&meant.robot_id).is_some() && !view.meant.is_over(&task.task_id, now.site)).then_some(meant)
}

/// How a task ended, when, on which robot, and by whom if it was a person's word.
pub fn ended(task: &TaskState) -> Reason {
    let why = task.reason.clone();
    let said = why.as_ref().map_or_else(String::new, |why| format!(" {}", why.text()));
    let at = task.ended.map(Utc::rfc3339).unwrap_or_default();
    let by = task.robot_id.as_ref().map(|r| format!(" on {r}")).unwrap_or_default();
    let told = format!("It ended as {} at {at}{by}.{said}", task.phase.as_str());
    let actor = why.as_ref().and_then(|why| why.metadata.get("actor")).cloned();
    let mut reason = Reason::new(Code::TaskEnded, told).with("state", task.phase.as_str()).with("end_time", at);
    for (key, value) in [("robot_id", task.robot_id.as_ref().map(ToString::to_string)), ("actor", actor)] {
        reason = value.into_iter().fold(reason, |reason, value| reason.with(key, value));
    }
    why.iter().fold(reason, |reason, why| reason.with("cause", why.code)).with(WAITS_FOR, "nothing: it is over")
}

/// What a robot does with an attempt, or what both wait for. None: nobody can say.
pub fn of_attempt(view: &FleetProjection, board: &Board, now: &Now, a: &Attempt) -> Option<Reason> {
    let robot_id = &a.robot_id;
    if view.held_by(robot_id) != Some(&a.attempt) {
        return None;
    }
    let live = board.get(robot_id);
    if let Some(why) = unknown(a, live) {
        return Some(why);
    }
    if let Err(why) = check_goes_on(view, board, now, robot_id) {
        return Some(about_robot(why, robot_id));
    }
    if let Some(why) = place_wait(view, robot_id) {
        return Some(why);
    }
    let robot = format!("robot {robot_id}");
    let live = live?;
    let listed = live.report.attempts.iter().find(|r| r.attempt == a.attempt);
    match (a.phase, listed) {
        (AttemptPhase::Offered, _) => Some(Reason::from(Code::WaitingForAnswer).with(WAITS_FOR, robot)),
        (AttemptPhase::Stopping, _) => Some(Reason::from(Code::WaitingForStop).with(WAITS_FOR, robot)),
        (phase, _) if phase.is_terminal() => Some(explain_let_go(view, a).with(WAITS_FOR, robot)),
        // The heartbeat is older than what the robot said since as events, of which the row knows.
        (_, None) if !liveness::is_fresh(view, live) => Some(works(view, now, a, live, a.step_index)),
        (_, None) => Some(Reason::from(Code::RobotReconciling).with(WAITS_FOR, robot)),
        (_, Some(listed))
            if listed.state == WorkState::Navigating && route_requests::is_out_of_route(view, live, a) =>
        {
            None
        }
        (_, Some(_)) if view.bugs.steps_are_not_told() => None,
        (_, Some(listed)) => Some(works(view, now, a, live, listed.step_index)),
    }
}

/// Why the record has let an attempt go that its robot may still have.
fn explain_let_go(view: &FleetProjection, a: &Attempt) -> Reason {
    let task = a.attempt.subject.task_id().and_then(|id| view.task(id));
    let newest = task.filter(|task| task.attempt_id().as_ref() == Some(&a.attempt));
    newest.and_then(|task| task.reason.clone()).unwrap_or_else(|| Code::Forced.into())
}

/// The robot works on this step of the attempt.
fn works(view: &FleetProjection, now: &Now, a: &Attempt, live: &NewestHeartbeat, step: u32) -> Reason {
    let robot_id = &a.robot_id;
    let since = Utc(now.utc.0 - i64::try_from(now.site.since(live.progress_at).as_ms()).unwrap_or(0));
    let since = a.accepted.map_or(since, |accepted| since.max(accepted));
    let steps = a.attempt.subject.task_id().and_then(|id| view.intake(id)).map(|i| i.spec.steps.len());
    let told = format!("{robot_id} works on step {step} of the attempt since {}.", since.rfc3339());
    let reason = Reason::new(Code::WorksOnStep, told).with("robot_id", robot_id).with("step", step);
    let reason = reason.with("since", since.rfc3339()).with("attempt", &a.attempt);
    steps.into_iter().fold(reason, |reason, steps| reason.with("steps", steps))
}

/// The attempt is UNCERTAIN.
fn unknown(a: &Attempt, live: Option<&std::sync::Arc<NewestHeartbeat>>) -> Option<Reason> {
    let (robot_id, uncertain) = (&a.robot_id, a.uncertain.as_ref()?);
    let is_manual = live.is_some_and(|live| live.report.mode != Mode::Automatic);
    let (what, way_out) = match uncertain.cause.code {
        Code::ReportImplausible => (
            format!("a person at robot {robot_id}"),
            match a.attempt.subject.task_id() {
                Some(_) => {
                    "It is known again once the robot reports what can be; else answer with `midshift task resolve TASK --as ANSWER --reason TEXT`."
                }
                None => {
                    "It is known again once the robot reports what can be; else look at its software and start it anew."
                }
            },
        ),
        Code::RobotManual if is_manual => (
            format!("a person at robot {robot_id}"),
            "It is known again once the robot is back in automatic mode and reports it.",
        ),
        _ => (
            format!("robot {robot_id}"),
            "It is known again once the robot is heard; after five minutes a person is asked.",
        ),
    };
    let since = uncertain.since.rfc3339();
    let told = format!("Nobody knows since {since} what {robot_id} does with it: {} {way_out}", uncertain.cause.text());
    let mut reason = uncertain.cause.clone();
    reason.message = told;
    Some(reason.with("uncertain_since", since).with(WAITS_FOR, what))
}

/// What keeps a robot that has work from going on, apart from places.
fn check_goes_on(view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId) -> Result<(), Reason> {
    match liveness::presence(board, robot_id, now) {
        Presence::Online => {}
        Presence::Suspect => return Err(Code::RobotSuspect.into()),
        Presence::Offline => return Err(Code::RobotOffline.into()),
    }
    let Some(live) = board.get(robot_id) else { return Err(Code::RobotOffline.into()) };
    engaged_stops::check_stops(view, robot_id, Some(live))?;
    if let Some(hold) = view.robot_holds(robot_id).next() {
        return Err(robot_held(&hold.token, robot_id));
    }
    eligibility::reported(live)?;
    plausible::keeps_back(view, live)?;
    claims::broken(view, robot_id).map_or(Ok(()), Err)
}

/// A hold token in words: whose it is, and who takes it away.
pub fn held(code: Code, token: &str) -> Reason {
    let (told, what) = match (Hold::read(token), token.split_once(":body:")) {
        (Some((stop_id, Hold::Stop)), _) => (
            format!("Stop {stop_id} stands it. Reset it with `midshift stop reset {stop_id}`, then resume it."),
            format!("the reset of stop {stop_id}"),
        ),
        (Some((stop_id, Hold::Resume)), _) => (
            format!("Stop {stop_id} is over and nobody has resumed it: `midshift resume --stop {stop_id}`."),
            "a person's resume".to_owned(),
        ),
        (None, Some(("stop", robot_id))) => (
            format!("The own safety system of {robot_id} stopped it. Reset that at the robot, then resume it."),
            format!("a person at robot {robot_id}"),
        ),
        (None, Some((_, robot_id))) => (
            format!("The own safety system of {robot_id} let go: `midshift resume --robot {robot_id}`."),
            "a person's resume".to_owned(),
        ),
        (None, None) => (String::new(), "a person's resume".to_owned()),
    };
    Reason::new(code, told).with("token", token).with(WAITS_FOR, what)
}

/// The same of a robot, which many stops may hold: they are ended one by one or all at once.
fn robot_held(token: &str, robot_id: &RobotId) -> Reason {
    let mut reason = held(Code::RobotHeld, token);
    if let Some((_, Hold::Resume)) = Hold::read(token) {
        reason.message += &format!(" `midshift resume --robot {robot_id}` ends all that holds it at once.");
    }
    reason
}

/// A reason that stands against a robot, with whom it waits for.
pub fn about_robot(reason: Reason, robot_id: &RobotId) -> Reason {
    if is_told(&reason) {
        return reason;
    }
    let fact = |key: &str| reason.metadata.get(key).cloned().unwrap_or_default();
    let what = match reason.code {
        Code::StopEngaged => format!("the reset of stop {}", fact("stop_id")),
        Code::RobotDraining => format!("drain {}", fact("drain_id")),
        Code::RobotHeld => return robot_held(&fact("token"), robot_id),
        Code::ExclusionBroken => {
            format!("a person at place {} with {} and {robot_id}", fact("place_id"), fact("other"))
        }
        Code::RowUnknown => "the newer version of the server".to_owned(),
        Code::DecisionPutAside | Code::SkippedRetired | Code::RobotCordoned | Code::RobotBrokenOff => {
            format!("a person who looks at robot {robot_id}")
        }
        Code::RobotManual
        | Code::RobotStopped
        | Code::RobotFault
        | Code::RobotLoaded
        | Code::RobotUnlocated
        | Code::ReportImplausible
        | Code::PlacesImplausible
        | Code::GoalNotEntered
        | Code::MapDiffers
        | Code::RobotNotUnderstood
        | Code::AttemptUnknown => format!("a person at robot {robot_id}"),
        _ => format!("robot {robot_id}"),
    };
    reason.with(WAITS_FOR, what)
}

/// Why a robot that was given away, to an attempt or a drain, does not go on, or what it does. None: it has no work, or nobody can say.
pub fn of_robot(view: &FleetProjection, board: &Board, now: &Now, robot_id: &RobotId) -> Option<Reason> {
    match &view.authority.get(robot_id.as_str())?.row.holder {
        RobotHolder::None => None,
        RobotHolder::Attempt(id) => of_attempt(view, board, now, view.attempt(id)?),
        RobotHolder::Maintenance(drain_id) => {
            let reason = Reason::from(Code::RobotDraining).with("drain_id", drain_id);
            Some(reason.with(WAITS_FOR, format!("drain {drain_id}")))
        }
    }
}

/// Which places the robot waits for, and what is in the way: robots that must go first, a place that is closed or blocked, holders of one without
/// a free seat, robots that start there, a stop, whoever came first, or a free seat that others go to first. None: it waits for none.
pub fn place_wait(view: &FleetProjection, robot_id: &RobotId) -> Option<Reason> {
    let wait = view.waits.get(robot_id)?;
    if let Some(robots) = &wait.for_order {
        return Some(order_wait(wait, robots));
    }
    let mut reason = Reason::from(Code::PlaceOccupied);
    for (key, told, who) in in_the_way(view, robot_id, &wait.places) {
        if who.is_empty() {
            continue;
        }
        let names = who.iter().map(String::as_str).collect::<Vec<_>>();
        if reason.message.is_empty() {
            reason.message = told.to_owned();
            let places = wait.places.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            reason = reason.with(WAITS_FOR, format!("{places}: {} {}", key.replace('_', " "), names.join(", ")));
            if key == SHUT {
                let closure = names.iter().find_map(|id| closed_places::find_closed(view, &view.places.get(*id)?.row));
                reason = closure.into_iter().fold(reason, |reason, closure| closure.word_reason(reason));
            } else if key == BLOCKED {
                let block = names.iter().find_map(|id| view.place_blocks.get(*id));
                reason = block.into_iter().fold(reason, |reason, block| blocked_places::word_block(reason, &block.row));
            }
        }
        reason = reason.with(key, names.join(" "));
    }
    let places = wait.places.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ");
    Some(reason.with("places", places))
}

/// The places are free, and these robots must go first.
fn order_wait(wait: &Waiting, robots: &[RobotId]) -> Reason {
    let places = wait.places.iter().map(ToString::to_string).collect::<Vec<_>>();
    let names = robots.iter().map(ToString::to_string).collect::<Vec<_>>();
    let with = if names.is_empty() { "others".to_owned() } else { names.join(", ") };
    let told = format!("{}: an order with {with}", places.join(", "));
    let reason = Reason::from(Code::UnsafeOrder).with("robots", names.join(" ")).with("places", places.join(" "));
    reason.with(WAITS_FOR, told)
}

/// What may be in the way of a robot to places, by the fact that names it: the first that is there is told.
fn in_the_way(
    view: &FleetProjection,
    robot_id: &RobotId,
    places: &[PlaceId],
) -> [(&'static str, &'static str, BTreeSet<String>); 7] {
    let rows = || places.iter().filter_map(|id| view.places.get(id.as_str())).map(|p| &p.row);
    let known = || places.iter().filter_map(|id| view.site.find_place(id));
    let others = |id: &&RobotId| *id != robot_id;
    let names = |ids: &mut dyn Iterator<Item = &RobotId>| ids.filter(others).map(ToString::to_string).collect();
    let mine = view.waits.get(robot_id).map(|w| w.since).unwrap_or_default();
    let wants = |other: &PlaceId| places.contains(other);
    // Who waits for an order keeps nothing from anybody.
    let keeps = |w: &Waiting| w.for_order.is_none() && w.since <= mine && w.places.iter().any(wants);
    let earlier = view.waits.iter().filter(|(_, w)| keeps(w)).map(|(id, _)| id);
    let closed = engaged_stops::closed(view);
    let has_seat = |p: &Place| {
        let known = view.site.find_place(&p.place_id);
        known.is_some_and(|ix| starts::taken(view, ix, p, robot_id) < p.capacity as usize)
    };
    let misses_a_seat = |p: &Place| !has_seat(p) && closed_places::find_closed(view, p).is_some();
    let is_shut = |p: &&Place| p.quarantine.is_some() || view.refused.is_place_aside(&p.place_id) || misses_a_seat(p);
    let not_let_in = || rows().filter(|p| p.holder(robot_id).is_none());
    let blocked = || not_let_in().filter_map(|p| view.place_blocks.get(p.place_id.as_str())).map(|block| &block.row);
    let holders = |seat: bool| -> BTreeSet<String> {
        names(&mut rows().filter(|p| has_seat(p) == seat).flat_map(|p| &p.holders).map(|h| &h.robot_id))
    };
    [
        (
            SHUT,
            "waits for a place that is closed until a person clears it",
            rows().filter(is_shut).map(|p| p.place_id.to_string()).collect(),
        ),
        (
            BLOCKED,
            "waits for a place that a person blocked",
            blocked().map(|block| block.place_id.to_string()).collect(),
        ),
        ("held_by", "waits for a place that another robot holds", holders(false)),
        (
            "kept_for",
            "waits for a place that is kept for a robot that starts there and was not heard yet",
            names(&mut known().flat_map(|ix| starts::awaited(view, ix))),
        ),
        (
            "stopped",
            "waits for a place that lies inside of a fleet stop",
            known().filter(|ix| closed.contains(ix)).map(|ix| view.site.place(ix).place_id.to_string()).collect(),
        ),
        ("first", "waits for a place that another robot waits for since earlier", names(&mut { earlier })),
        ("beside", "waits for a place that has a free seat and is kept for others", holders(true)),
    ]
}
