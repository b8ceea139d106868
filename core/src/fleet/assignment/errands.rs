//! Fleet's own wishes of idle robots: charge, and park, since an idle robot left in a station would block it for ever.
//!
//! An errand is an attempt with no task row and a single epoch; its number is never used again. Its end has no consequence but a free robot.

use super::candidates::Candidate;
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::Board;
use crate::fleet::projection::rows::{RobotControl, TimerKind};
use crate::fleet::projection::state::FleetProjection;
use crate::fleet::tasks::attempts;
use crate::fleet::tasks::transitions::arm;
use crate::fleet::traffic::anchor::anchor;
use crate::fleet::traffic::{route_requests, routing, starts};
use crate::heartbeat::NewestHeartbeat;
use crate::ids::{AttemptId, RobotId, Subject, WaypointId};
use crate::limits;
use crate::session::Session;
use crate::site::{Kind, WaypointIx};
use crate::task::state::Errand;
use crate::time::Now;
use std::collections::BTreeMap;

/// Sends robots that are still idle to charge or park.
pub fn plan(view: &mut FleetProjection, board: &Board, now: Now, idle: Vec<Candidate>, plan: &mut Plan) {
    let waiting = !view.queue.is_empty();
    let mut coming = Coming::from_projection(view);
    for Candidate { robot_id, at: here, .. } in idle {
        if plan.is_cut() {
            return;
        }
        let Some(live) = board.get(&robot_id) else { continue };
        // Whoever drains is parked by its drain.
        if view.drain_of(&robot_id).is_some() {
            continue;
        }
        if view.unwilling.get(&robot_id).is_some_and(|until| now.link < *until) {
            continue;
        }
        let battery_permille = live.report.vitals.battery_permille;
        let Some((errand, goal)) = wish(view, &coming, &robot_id, here, battery_permille, waiting) else { continue };
        plan.decide(view, now, "fleet", |tx| begin(tx, &robot_id, errand, goal, board));
        coming.add(view, &robot_id, view.site.name_of(goal));
        plan.report.errands += 1;
    }
}

/// How many robots are on an errand to a waypoint without holding its place yet.
struct Coming(BTreeMap<WaypointId, usize>);

impl Coming {
    fn from_projection(view: &FleetProjection) -> Self {
        let mut coming = Self(BTreeMap::new());
        for a in view.attempts.values().map(|a| &a.row).filter(|a| !a.phase.is_terminal()) {
            if let Some(goal) = &a.goal {
                coming.add(view, &a.robot_id, goal);
            }
        }
        coming
    }
    fn add(&mut self, view: &FleetProjection, robot_id: &RobotId, goal: &WaypointId) {
        let place = view.places.get(goal.as_str()).map(|p| &p.row);
        if place.is_none_or(|p| p.holder(robot_id).is_none()) {
            *self.0.entry(goal.clone()).or_default() += 1;
        }
    }
}

/// What a robot that stands there with this charge would do unless it is given a task.
struct Wants {
    charge: bool,
    /// It stands where it is in others' way.
    park: bool,
}

impl Wants {
    fn new(view: &FleetProjection, robot_id: &RobotId, here: WaypointIx, battery_permille: u16, waiting: bool) -> Self {
        let policy = view.policy(&view.site.area_of(here).area_id);
        let must = battery_permille < policy.charge_mandatory_permille;
        let may = battery_permille < policy.charge_opportunistic_permille && !waiting;
        let kind = view.site.waypoint(here).kind;
        let is_settled = match kind {
            Kind::Park => true,
            Kind::Charger => !waiting,
            Kind::Hold => !waiting && !is_wanted(view, robot_id, here),
            _ => false,
        };
        Self { charge: must || may, park: !is_settled && view.site.collisions_modelled() }
    }
}

/// Whether another robot waits for the last seat of the place that this one stands in, or for this one to go first.
fn is_wanted(view: &FleetProjection, robot_id: &RobotId, here: WaypointIx) -> bool {
    let place = view.site.standing_at(here).map(|place| &view.site.place(place).place_id);
    place.is_some_and(|place_id| route_requests::is_waited_for(view, robot_id, place_id))
        || route_requests::is_in_an_orders_way(view, robot_id)
}

/// Whether an idle robot would do anything while no task waits. Where it would go is not looked for.
pub(super) fn wants_any(view: &FleetProjection, live: &NewestHeartbeat) -> bool {
    let vitals = &live.report.vitals;
    let wants = |here| Wants::new(view, &live.robot_id, here, vitals.battery_permille, false);
    routing::find(view, vitals.waypoint.as_ref()).map(wants).is_some_and(|wants| wants.charge || wants.park)
}

fn wish(
    view: &FleetProjection,
    coming: &Coming,
    robot_id: &RobotId,
    here: WaypointIx,
    battery_permille: u16,
    waiting: bool,
) -> Option<(Errand, WaypointIx)> {
    let free = |goals: &mut dyn Iterator<Item = WaypointIx>| free(view, coming, robot_id, here, goals);
    let wants = Wants::new(view, robot_id, here, battery_permille, waiting);
    if wants.charge
        && let Some(charger) = free(&mut view.site.chargers())
    {
        return Some((Errand::Charge, charger));
    }
    let park = || park_goal(view, coming, robot_id, here).map(|goal| (Errand::Park, goal));
    wants.park.then(park).flatten()
}

/// Where a robot that stands at `here` would park; none if it parks already or everything is taken.
pub(in crate::fleet) fn park_for(view: &FleetProjection, robot_id: &RobotId, here: WaypointIx) -> Option<WaypointIx> {
    let parks = view.site.waypoint(here).kind == Kind::Park || !view.site.collisions_modelled();
    if parks { None } else { park_goal(view, &Coming::from_projection(view), robot_id, here) }
}

fn park_goal(view: &FleetProjection, coming: &Coming, robot_id: &RobotId, here: WaypointIx) -> Option<WaypointIx> {
    let free = |goals: &mut dyn Iterator<Item = WaypointIx>| free(view, coming, robot_id, here, goals);
    let goal = match free(&mut view.site.parks()) {
        None if view.site.waypoint(here).kind == Kind::Hold && !is_wanted(view, robot_id, here) => None,
        None => free(&mut view.site.hold_points().filter(|at| *at != here)),
        park => park,
    }?;
    (goal != here).then_some(goal)
}

/// The nearest of `goals` with room that no other errand is on its way to, and to which a way leads around closed places.
fn free(
    view: &FleetProjection,
    coming: &Coming,
    robot_id: &RobotId,
    here: WaypointIx,
    goals: &mut dyn Iterator<Item = WaypointIx>,
) -> Option<WaypointIx> {
    let open = goals.filter(|at| {
        let Some(ix) = view.site.standing_at(*at) else { return false };
        let place = view.site.place(ix);
        let Some(row) = view.places.get(place.place_id.as_str()).map(|p| &p.row) else { return false };
        let coming = coming.0.get(view.site.name_of(*at)).copied().unwrap_or_default();
        row.holder(robot_id).is_some()
            || (!routing::closed(view).contains(ix)
                && starts::taken(view, ix, row, robot_id) + coming < row.capacity as usize)
    });
    let reached = open.filter_map(|at| {
        let around = view.router.field_around(at, routing::closed(view));
        around.distance_mm(here).map(|way_mm| (way_mm, at))
    });
    reached.min().map(|(_, at)| at)
}

/// Begins an errand of a robot that nothing holds.
pub(in crate::fleet) fn begin(tx: &mut Tx, robot_id: &RobotId, errand: Errand, goal: WaypointIx, board: &Board) {
    let Some(anchor) = anchor(tx.view, robot_id, board, limits::OFFER_VALID) else { return };
    tx.rely::<Session>(robot_id.as_str());
    let known = tx.view.control.get(robot_id.as_str()).map(|c| c.row.clone());
    let mut control = known.unwrap_or_else(|| RobotControl::new(robot_id.clone()));
    control.errands += 1;
    let subject = Subject::Errand { robot_id: robot_id.clone(), number: control.errands };
    tx.put_row(control, "robot.given");
    let mut a = attempts::fresh_attempt(tx, AttemptId { subject, epoch: 1 }, robot_id, anchor);
    a.errand = Some(errand);
    a.goal = Some(tx.view.site.name_of(goal).clone());
    attempts::take_robot(tx, &a);
    arm(tx, TimerKind::OfferAck, &a.attempt, limits::OFFER_VALID.as_ms());
    tx.put_row(a, "errand.offered");
}
