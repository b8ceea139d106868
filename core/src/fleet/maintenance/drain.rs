//! Takes robots out of work for maintenance and gives them back: the task at hand ends or waits at a step boundary, the robot parks, and
//! only then the drain holds it. People ask for it, and the rollout service does by its rows. A robot that carries the item of a task
//! that is tried again is still at work: it ends that task first, and gets no other.
//!
//! Called once a cycle, after [`super::budget`]. Invariant: a drain takes the robot's mutex only from none, and gives it back only from itself;
//! it never cuts a grasp and never leaves a robot in a lane: it is held in a standing place that is its own. A drain whose deadline passes is refused and the robot works on.

use crate::drain_request::{DrainRelease, DrainRequest};
use crate::fleet::assignment::errands;
use crate::fleet::assignment::estimate::Rest;
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::rows::{Drain, DrainState, RobotAuthority, RobotHolder};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::transitions::{self, News};
use crate::fleet::tasks::{eligibility, errand_reports, load};
use crate::fleet::traffic::routing;
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{DrainId, RobotId};
use crate::reason::{Code, Reason};
use crate::site::{Kind, WaypointIx};
use crate::task::Event;
use crate::task::state::Errand;
use crate::time::Now;

/// Speed that an estimate of a task's rest counts with, millimetres per second.
const PLANNED_MM_S: u64 = 600;
/// Time of one action that an estimate counts with, milliseconds of site time.
const PLANNED_ACTION_MS: u64 = 20_000;

/// Asks for a drain on behalf of a person. Its id is never used again.
pub fn request_drain(tx: &mut Tx, robot_id: &RobotId, reason: &str, actor: &str, within_ms: u64) {
    let over = tx.view.all_drains_of(robot_id).filter(|d| d.is_of_person() && d.state == DrainState::Refused);
    let over: Vec<DrainId> = over.map(|d| d.drain_id.clone()).collect();
    over.iter().for_each(|id| tx.delete::<Drain>(id.as_str(), "drain.forgotten"));
    let wall = tx.now.wall.0.max(0);
    let free = (0..).map(|n| format!("op:{wall}.{n}")).find(|id| !tx.view.drains.contains_key(id.as_str()));
    let Some(drain_id) = free.and_then(|id| DrainId::parse(&id).ok()) else { return };
    let drain = Drain {
        drain_id,
        robot_id: robot_id.clone(),
        state: DrainState::Draining,
        reason: reason.to_owned(),
        actor: actor.to_owned(),
        within_ms,
        since: tx.now.utc,
        why: None,
        area_id: None,
        rollout_id: None,
        urgent: true,
        is_way_back: false,
    };
    tx.put_row(drain, "drain.asked");
}

/// Ends every drain of the robot that a person asked for, and gives the robot back to work.
pub fn undrain(tx: &mut Tx, robot_id: &RobotId) {
    let asked: Vec<DrainId> =
        tx.view.all_drains_of(robot_id).filter(|d| d.is_of_person()).map(|d| d.drain_id.clone()).collect();
    asked.iter().for_each(|drain_id| end_drain(tx, robot_id, drain_id));
}

/// Ends a drain, and what it holds is free.
fn end_drain(tx: &mut Tx, robot_id: &RobotId, drain_id: &DrainId) {
    let held = tx.view.authority.get(robot_id.as_str()).map(|a| a.row.holder.clone());
    if held == Some(RobotHolder::Maintenance(drain_id.clone())) {
        tx.put_row(RobotAuthority { robot_id: robot_id.clone(), holder: RobotHolder::None }, "robot.freed");
    }
    tx.delete::<Drain>(drain_id.as_str(), "drain.released");
}

/// Takes what the rollout service asks for and what it lets go. Both rows are relied upon: it takes a request away only while there is
/// no drain, and a drain is made only while the request stands alone.
pub fn obey_requests(view: &mut FleetProjection, now: Now, plan: &mut Plan) {
    let released: Vec<(RobotId, DrainId)> = (view.drain_releases.keys())
        .filter_map(|id| view.drains.get(id))
        .map(|d| (d.row.robot_id.clone(), d.row.drain_id.clone()))
        .collect();
    for (robot_id, drain_id) in released {
        if plan.is_cut() {
            return;
        }
        plan.decide(view, now, "ota", |tx| {
            tx.rely::<DrainRelease>(drain_id.as_str());
            end_drain(tx, &robot_id, &drain_id);
        });
    }
    let is_new = |id: &str| !view.drains.contains_key(id) && !view.drain_releases.contains_key(id);
    let asked: Vec<DrainRequest> =
        view.drain_requests.iter().filter(|(id, _)| is_new(id)).map(|(_, r)| r.row.clone()).collect();
    for request in asked {
        if plan.is_cut() {
            return;
        }
        plan.decide(view, now, "ota", |tx| {
            tx.rely::<DrainRequest>(request.drain_id.as_str());
            tx.rely::<DrainRelease>(request.drain_id.as_str());
            let drain = Drain {
                drain_id: request.drain_id,
                robot_id: request.robot_id,
                state: DrainState::Waiting,
                reason: request.reason,
                actor: "ota".to_owned(),
                within_ms: request.within_ms,
                since: tx.now.utc,
                why: None,
                area_id: None,
                rollout_id: Some(request.rollout_id),
                urgent: request.urgent,
                is_way_back: request.is_way_back,
            };
            tx.put_row(drain, "drain.asked");
        });
    }
}

/// Brings every drain a step further.
pub fn plan(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) {
    let open: Vec<Drain> =
        view.drains.values().map(|d| &d.row).filter(|d| d.state == DrainState::Draining).cloned().collect();
    for drain in open {
        if plan.is_cut() {
            return;
        }
        if view.drain_of(&drain.robot_id).is_some_and(|first| first.drain_id != drain.drain_id) {
            continue;
        }
        plan.decide(view, now, "fleet", |tx| further(tx, &drain, board));
    }
}

fn further(tx: &mut Tx, drain: &Drain, board: &Board) {
    let left_ms = drain.within_ms.saturating_sub(tx.now.ms_since(drain.since));
    let holder = tx.view.authority.get(drain.robot_id.as_str()).map(|a| a.row.holder.clone()).unwrap_or_default();
    let live = board.get(&drain.robot_id).cloned();
    match holder {
        RobotHolder::Maintenance(_) => {}
        // The rest of its task is given to it, or a person comes for what it carries.
        RobotHolder::None if load::must_deliver(tx.view, drain, live.as_deref()) => {
            if left_ms == 0 {
                refuse(tx, drain);
            } else if let Some(live) = live.filter(|live| !load::goes_on(tx.view, Some(live))) {
                park(tx, drain, &live, board);
            }
        }
        RobotHolder::None if is_at_rest(tx.view, drain, live.as_deref()) => take_out(tx, drain),
        _ if left_ms == 0 => refuse(tx, drain),
        RobotHolder::None => {
            if let Some(live) = live {
                park(tx, drain, &live, board);
            }
        }
        RobotHolder::Attempt(id) => match id.subject.task_id() {
            Some(task_id) => {
                let suspends = live.is_some_and(|live| {
                    transitions::may_suspend(tx.view, task_id, &live) && rest_ms(tx.view, task_id, &live) > left_ms
                });
                if suspends {
                    let why = Reason::from(Code::DrainSuspend).with("drain_id", &drain.drain_id);
                    transitions::apply_event(tx, task_id, News::from_event(Event::Suspend, Some(&why)));
                }
            }
            // A charge ends as it is: the robot keeps its place and goes on charging. A way to a charger or to a park goes on.
            None if tx.view.attempt(&id).is_some_and(errand_reports::is_docked) => {
                errand_reports::stop_errand(tx, &drain.robot_id)
            }
            None => {}
        },
    }
}

/// Milliseconds of site time that the rest of a task will take, as far as one can tell.
fn rest_ms(view: &FleetProjection, task_id: &crate::ids::TaskId, live: &NewestHeartbeat) -> u64 {
    let Some((task, intake)) = view.task(task_id).zip(view.intake(task_id)) else { return 0 };
    let done = live.report.attempts.iter().map(|a| a.step_index).max().unwrap_or(task.next_step) as usize;
    let rest = Rest::of_task(view, intake, done, live);
    rest.way_mm * 1_000 / PLANNED_MM_S + rest.actions * PLANNED_ACTION_MS + rest.waits_ms
}

/// The robot stands where it may stand for long, and what it says is newer than what it last did. One that was never heard rests too.
fn is_at_rest(view: &FleetProjection, drain: &Drain, live: Option<&NewestHeartbeat>) -> bool {
    let Some(live) = live else { return true };
    let Some(here) = routing::find(view, live.report.vitals.waypoint.as_ref()) else { return false };
    let idle = live.report.attempts.iter().all(|a| a.state.is_over()) && live.report.vitals.speed_mm_s == 0;
    idle && liveness::is_settled(view, live) && liveness::is_fresh(view, live) && may_rest(view, &drain.robot_id, here)
}

/// The robot holds the standing place it is in, and nobody works there. Where bodies may drive through each other it may rest anywhere.
fn may_rest(view: &FleetProjection, robot_id: &RobotId, here: WaypointIx) -> bool {
    if !view.site.collisions_modelled() {
        return true;
    }
    let place = view.site.standing_at(here).map(|ix| view.site.place(ix).place_id.as_str());
    let holds = place.and_then(|id| view.places.get(id)).is_some_and(|place| place.row.holder(robot_id).is_some());
    holds && matches!(view.site.waypoint(here).kind, Kind::Park | Kind::Hold | Kind::Charger)
}

fn park(tx: &mut Tx, drain: &Drain, live: &NewestHeartbeat, board: &Board) {
    let quiet = live.report.attempts.iter().all(|a| a.state.is_over()) && liveness::is_settled(tx.view, live);
    // With a standing fault, stopped or driven by hand it would only fail: the deadline goes on.
    let unwilling = tx.view.unwilling.get(&drain.robot_id).is_some_and(|until| tx.now.link < *until)
        || eligibility::reported(live).is_err();
    let here = routing::find(tx.view, live.report.vitals.waypoint.as_ref());
    if let Some(goal) =
        here.filter(|_| quiet && !unwilling).and_then(|h| errands::park_for(tx.view, &drain.robot_id, h))
    {
        errands::begin(tx, &drain.robot_id, Errand::Park, goal, board);
    }
}

fn take_out(tx: &mut Tx, drain: &Drain) {
    let holder = RobotHolder::Maintenance(drain.drain_id.clone());
    tx.put_row(RobotAuthority { robot_id: drain.robot_id.clone(), holder }, "robot.drained");
    tx.put_row(Drain { state: DrainState::Held, ..drain.clone() }, "drain.held");
}

fn refuse(tx: &mut Tx, drain: &Drain) {
    let why = Some(Reason::from(Code::SkippedBusy).with("within_ms", drain.within_ms));
    tx.put_row(Drain { state: DrainState::Refused, why, ..drain.clone() }, "drain.refused");
}
