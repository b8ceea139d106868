//! Grants places along routes: all passages up to the next standing place together with it, or nothing.
//!
//! Invariant: a place is given on only by the robot's own report or by a person, never by time. Queue order is class, then age;
//! a request that cannot be served keeps the place it goes to from later ones, and once that has a seat the passages on the way too. First of all come who lost a place of its released stretch
//! and who stands in a passage with no standing place ahead: the others may wait for just that passage. Grants are traffic, never a safety function.

use super::anchor::next_generation;
use super::desired::{Release, Releases};
use super::{engaged_stops, routing, starts};
use crate::fleet::decision::plan::{Plan, Tx};
use crate::fleet::projection::liveness::{self, Board};
use crate::fleet::projection::memory::Waiting;
use crate::fleet::projection::rows::{HolderState, Place, PlaceHolder, RobotControl};
use crate::fleet::projection::state::{self, FleetProjection};
use crate::fleet::tasks::plausible;
use crate::ids::{AreaId, PlaceId, RobotId};
use crate::limits;
use crate::robot::Presence;
use crate::site::route::{Segment, segments};
use crate::site::{AreaIx, Kind, PlaceIx};
use crate::task::spec::Class;
use crate::task::{Attempt, AttemptPhase};
use crate::time::{Now, SiteDuration, SiteTime, Utc};
use crate::work::{Assignment, Live};
use std::collections::{BTreeMap, BTreeSet};

/// A robot that blocks a place others need steps aside after this long, at once if somebody waits for it.
const STEP_ASIDE_AFTER: SiteDuration = SiteDuration::from_secs(3);

/// Grant ids of one generation: more than the places of any one stretch.
const GRANTS_PER_GENERATION: u64 = 1024;

/// Whether the robot stands because it waits for a place.
pub fn waits(view: &FleetProjection, robot_id: &RobotId) -> bool {
    view.waits.contains_key(robot_id)
}

/// Robots that hold a standing place in the area.
pub fn robots_in_area(view: &FleetProjection, area: &AreaId) -> BTreeSet<RobotId> {
    let inside = |id: &str| {
        let place = PlaceId::parse(id).ok().and_then(|p| view.site.find_place(&p)).map(|p| view.site.place(p));
        place.and_then(|p| p.waypoint()).is_some_and(|w| view.site.area_of(w).area_id == *area)
    };
    view.held_places.iter().filter(|(_, ids)| ids.iter().any(|id| inside(id))).map(|(r, _)| r.clone()).collect()
}

struct Wish {
    /// Nothing of its released stretch is missing, and it bars no passage.
    patient: bool,
    class: Class,
    since: SiteTime,
    robot_id: RobotId,
}

/// Serves every robot that needs more of its route, in queue order. Each grant is an item of its own.
pub fn advance(view: &mut FleetProjection, board: &Board, now: Now, plan: &mut Plan) -> Releases {
    let mut wishes: Vec<Wish> = Vec::new();
    for (robot_id, live) in board {
        let Some(id) = view.held_by(robot_id) else { continue };
        let Some(a) = view.attempt(id) else { continue };
        if !may_drive(view, a, live, board, &now) || plausible::keeps_back(view, live).is_err() {
            continue;
        }
        let whole = missing(view, live, a).is_empty();
        if !whole || !is_released(view, robot_id, a) {
            let since = view.waits.get(robot_id).map_or(now.site, |w| w.since);
            let patient = whole && !bars_passage(view, robot_id);
            wishes.push(Wish { patient, class: class_of(view, a), since, robot_id: robot_id.clone() });
        }
    }
    let wanting: BTreeSet<RobotId> = wishes.iter().map(|w| w.robot_id.clone()).collect();
    view.waits.retain(|r, _| wanting.contains(r));
    wishes.sort_by(|a, b| (a.patient, a.class, a.since, &a.robot_id).cmp(&(b.patient, b.class, b.since, &b.robot_id)));
    let mut releases = Releases::default();
    let mut traffic = if wishes.is_empty() { Traffic::default() } else { Traffic::from_projection(view) };
    for wish in &wishes {
        if plan.is_cut() {
            break;
        }
        let Some(live) = board.get(&wish.robot_id) else { continue };
        plan.decide(view, now, "fleet", |tx| serve(tx, live, &mut releases, &mut traffic));
    }
    plan.report.tally.waiting_for_place = view.waits.len() as u64;
    releases
}

/// The robot is inside a passage and has no standing place to go on to: its task ended there.
fn bars_passage(view: &FleetProjection, robot_id: &RobotId) -> bool {
    let mut inside = false;
    for (place, holder) in state::held(view, robot_id) {
        if place.standing {
            return false;
        }
        inside |= holder.state == HolderState::Inside;
    }
    inside
}

fn class_of(view: &FleetProjection, a: &Attempt) -> Class {
    let priority = a.attempt.subject.task_id().and_then(|t| view.intake(t)).map_or(9, |i| i.spec.priority);
    Class::from_priority(priority, 0)
}

/// An accepted attempt of a robot that is heard, not held and not told to stop.
fn may_drive(view: &FleetProjection, a: &Attempt, live: &Live, board: &Board, now: &Now) -> bool {
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

fn assignment<'a>(view: &'a FleetProjection, robot_id: &RobotId, a: &Attempt) -> Option<&'a Assignment> {
    let desired = &view.desired_work.get(robot_id.as_str())?.row;
    desired.assignment.as_ref().filter(|x| x.attempt == a.attempt)
}

fn is_released(view: &FleetProjection, robot_id: &RobotId, a: &Attempt) -> bool {
    let Some(work) = assignment(view, robot_id, a) else { return true };
    let end = work.route.len().saturating_sub(1) as u32;
    work.released_index.is_some_and(|r| r >= end) || next_segment(view, robot_id, a, work).is_none()
}

/// The robot stands at the end of what was released to it, and there is more that could be.
pub fn is_out_of_route(view: &FleetProjection, live: &Live, a: &Attempt) -> bool {
    let Some(work) = assignment(view, &live.robot_id, a) else { return false };
    let Some(listed) = live.report.attempts.iter().find(|r| r.attempt == a.attempt) else { return false };
    let released = work.released_index.unwrap_or(0);
    let stands = live.report.vitals.speed_mm_s == 0 && listed.route_index >= released;
    stands && !is_released(view, &live.robot_id, a)
}

/// The next stretch to release, if it is time for it: not before the step behind the last one is done, and at most one ahead.
fn next_segment(view: &FleetProjection, robot_id: &RobotId, a: &Attempt, work: &Assignment) -> Option<Segment> {
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
    let unentered = state::held(view, robot_id).filter(|(p, h)| p.standing && h.state == HolderState::Granted).count();
    (unentered <= 1).then_some(segment)
}

/// What one round of grants knows beside the rows.
#[derive(Default)]
struct Traffic {
    /// Places that an earlier wish waits for.
    blocked: BTreeSet<PlaceIx>,
    /// Robots that hold a standing place of an area, or start in one.
    inside: BTreeMap<AreaIx, BTreeSet<RobotId>>,
}

impl Traffic {
    fn from_projection(view: &FleetProjection) -> Self {
        let mut traffic = Self { blocked: engaged_stops::closed(view), ..Self::default() };
        let standing = view.site.places().iter().filter(|p| p.waypoint().is_some());
        for place in standing {
            let Some(row) = view.places.get(place.place_id.as_str()).map(|p| &p.row) else { continue };
            for holder in &row.holders {
                traffic.enter(view, &holder.robot_id, place);
            }
        }
        for (robot_id, place) in starts::all_awaited(view) {
            traffic.enter(view, robot_id, view.site.place(place));
        }
        traffic
    }
    fn enter(&mut self, view: &FleetProjection, robot_id: &RobotId, place: &crate::site::Place) {
        let Some(area) = place.waypoint().map(|w| view.site.waypoint(w).area) else { return };
        self.inside.entry(area).or_default().insert(robot_id.clone());
    }
    /// An area admits one robot less than it has seats, so that those inside can move.
    fn admits(&self, view: &FleetProjection, robot_id: &RobotId, place: &crate::site::Place) -> bool {
        let Some(area) = place.waypoint().map(|w| view.site.waypoint(w).area) else { return true };
        let Some(inside) = self.inside.get(&area).filter(|inside| !inside.contains(robot_id)) else { return true };
        (inside.len() as u64) < view.site.area_capacity(area).saturating_sub(1).max(1)
    }
}

fn serve(tx: &mut Tx, live: &Live, releases: &mut Releases, traffic: &mut Traffic) {
    let robot_id = &live.robot_id;
    let Some(a) = tx.view.held_by(robot_id).and_then(|id| tx.view.attempt(id)).cloned() else { return };
    let Some(work) = assignment(tx.view, robot_id, &a).cloned() else { return };
    let lost = missing(tx.view, live, &a);
    let is_whole = lost.is_empty();
    let (needed, released) = match next_segment(tx.view, robot_id, &a, &work) {
        _ if !is_whole => (lost, None),
        Some(segment) => (segment.places(), Some(segment.end as u32)),
        None => return,
    };
    if tx.view.bugs.grants_one_by_one() {
        let free = needed.iter().copied().filter(|ix| grantable(tx.view, robot_id, &[*ix], traffic));
        let free: Vec<PlaceIx> = free.collect();
        grant(tx, robot_id, &free, traffic);
    }
    if grantable(tx.view, robot_id, &needed, traffic) {
        grant(tx, robot_id, &needed, traffic);
        tx.view.waits.remove(robot_id);
        tx.view.dirty.insert(robot_id.clone());
        if let Some(released_index) = released {
            releases.0.insert(robot_id.clone(), Release { route: None, released_index });
        }
        return;
    }
    let names = needed.iter().map(|p| tx.view.site.place(*p).place_id.clone()).collect();
    let now = tx.now.site;
    tx.view.place_waits += u64::from(!tx.view.waits.contains_key(robot_id));
    let since = tx.view.waits.entry(robot_id.clone()).or_insert(Waiting { places: Vec::new(), since: now }).since;
    tx.view.waits.insert(robot_id.clone(), Waiting { places: names, since });
    // It asks for one stretch ahead: with way left before it, it does not stand for that.
    if !is_whole || is_out_of_route(tx.view, live, &a) {
        note_wait(tx, robot_id, since);
    }
    if step_aside(tx, &a, &work, since, releases, traffic) {
        return;
    }
    // Who lost places may stand in them.
    let kept = if is_whole { kept_free(tx.view, robot_id, &needed, traffic) } else { needed };
    traffic.blocked.extend(kept);
}

/// Writes down once a minute that the robot stands for a place: who judges its software must not blame it for that.
fn note_wait(tx: &mut Tx, robot_id: &RobotId, since: SiteTime) {
    let is_long = tx.now.site.since(since) >= limits::PLACE_WAIT_NOTED;
    let Some(control) = tx.view.control.get(robot_id.as_str()).map(|c| &c.row).filter(|_| is_long) else { return };
    let is_noted = |at: Utc| tx.now.ms_since(at) < limits::PLACE_WAIT_NOTED.as_ms();
    if !control.waited_for_place.is_some_and(is_noted) {
        let control = RobotControl { waited_for_place: Some(tx.now.utc), ..control.clone() };
        tx.put_row(control, "robot.waits");
    }
}

/// Places that a wish keeps free for itself. While there is no seat where it goes to, only that seat: who leaves the seat may need the same
/// passage. While the area there admits nobody, nothing: who is inside may need the seat.
fn kept_free(view: &FleetProjection, robot_id: &RobotId, needed: &[PlaceIx], traffic: &Traffic) -> Vec<PlaceIx> {
    let place = |ix: &PlaceIx| view.site.place(*ix);
    if !needed.iter().all(|ix| traffic.admits(view, robot_id, place(ix))) {
        return Vec::new();
    }
    let (seats, passages): (Vec<_>, Vec<_>) = needed.iter().partition(|ix| place(ix).waypoint().is_some());
    let is_free = |ix: &PlaceIx| has_seat(view, robot_id, *ix) && !traffic.blocked.contains(ix);
    if seats.iter().all(is_free) { [seats, passages].concat() } else { seats }
}

fn has_seat(view: &FleetProjection, robot_id: &RobotId, ix: PlaceIx) -> bool {
    let place = view.places.get(view.site.place(ix).place_id.as_str()).map(|p| &p.row);
    place.is_some_and(|p| p.holder(robot_id).is_some() || starts::has_room(view, ix, p, robot_id))
}

/// Places on the released stretch ahead that a standing robot does not hold: a passage that its route crosses a second time, or grants that
/// it lost with its memory. Only a settled, newest report tells.
fn missing(view: &FleetProjection, live: &Live, a: &Attempt) -> Vec<PlaceIx> {
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

fn grantable(view: &FleetProjection, robot_id: &RobotId, needed: &[PlaceIx], traffic: &Traffic) -> bool {
    let held = view.held_places.get(robot_id).map_or(0, BTreeSet::len);
    if held + needed.len() > limits::PLACES_OF_ROBOT_MAX {
        return false;
    }
    needed.iter().all(|ix| {
        if view.refused.is_place_aside(&view.site.place(*ix).place_id) {
            return false;
        }
        if !traffic.admits(view, robot_id, view.site.place(*ix)) {
            return false;
        }
        let place = view.places.get(view.site.place(*ix).place_id.as_str()).map(|p| &p.row);
        place.is_some_and(|p| match p.holder(robot_id) {
            Some(holder) => holder.state != HolderState::Revoking,
            None => starts::has_room(view, *ix, p, robot_id) && !traffic.blocked.contains(ix),
        })
    })
}

fn grant(tx: &mut Tx, robot_id: &RobotId, needed: &[PlaceIx], traffic: &mut Traffic) {
    let first = next_generation(tx.view, robot_id, &tx.now) * GRANTS_PER_GENERATION;
    for (grant_id, ix) in (first..).zip(needed) {
        traffic.enter(tx.view, robot_id, tx.view.site.place(*ix));
        let id = tx.view.site.place(*ix).place_id.clone();
        let Some(mut place) = tx.view.places.get(id.as_str()).map(|p| p.row.clone()) else { continue };
        if place.holder(robot_id).is_none() {
            place.holders.push(PlaceHolder {
                robot_id: robot_id.clone(),
                grant_id,
                state: HolderState::Granted,
                since: tx.now.utc,
                claimed: false,
            });
            tx.put_row(place, "place.granted");
        }
    }
}

/// The robot stands in a place or passage that others need while its own goal is taken: it goes to a free bay on the way.
fn step_aside(
    tx: &mut Tx,
    a: &Attempt,
    work: &Assignment,
    since: SiteTime,
    releases: &mut Releases,
    traffic: &mut Traffic,
) -> bool {
    let robot_id = &a.robot_id;
    let released = work.released_index.unwrap_or(0) as usize;
    let Some(here) = work.route.get(released).and_then(|p| tx.view.site.find(&p.waypoint)) else { return false };
    let place = tx.view.site.standing_at(here);
    let kind = tx.view.site.waypoint(here).kind;
    let bars = match place {
        Some(place) => !matches!(kind, Kind::Hold | Kind::Park) && stands_in(tx.view, robot_id, place),
        None => bars_passage(tx.view, robot_id),
    };
    if !bars {
        return false;
    }
    let contested = place.is_some_and(|place| {
        let here_id = tx.view.site.place(place).place_id.clone();
        tx.view.waits.iter().any(|(r, w)| r != robot_id && w.places.contains(&here_id))
    });
    if !contested && tx.now.site.since(since) < STEP_ASIDE_AFTER {
        return false;
    }
    let left: Vec<_> =
        work.route.iter().skip(released + 1).filter_map(|p| p.ends_step.zip(tx.view.site.find(&p.waypoint))).collect();
    let Some((_, goal)) = left.first().copied() else { return false };
    let site = tx.view.site.clone();
    let mut bays: Vec<_> = site
        .hold_points()
        .chain(site.parks())
        .filter_map(|bay| {
            let there = tx.view.router.distance_mm(here, bay)?;
            Some((there + tx.view.router.distance_mm(bay, goal)?, bay))
        })
        .collect();
    bays.sort_unstable();
    for (_, bay) in bays {
        let Some(mut route) = routing::route(tx.view, here, Some(bay), &left) else { continue };
        route[0].ends_step = None;
        let Some(ixs) = routing::indices(&site, &route) else { continue };
        let Some(first) = segments(&site, &ixs).into_iter().next() else { continue };
        if first.standing == place || !grantable(tx.view, robot_id, &first.places(), traffic) {
            continue;
        }
        grant(tx, robot_id, &first.places(), traffic);
        tx.view.dirty.insert(a.robot_id.clone());
        releases.0.insert(robot_id.clone(), Release { route: Some(route), released_index: first.end as u32 });
        return true;
    }
    false
}

fn stands_in(view: &FleetProjection, robot_id: &RobotId, place: PlaceIx) -> bool {
    let id = &view.site.place(place).place_id;
    view.places.get(id.as_str()).and_then(|p| p.row.holder(robot_id)).is_some_and(|h| h.state == HolderState::Inside)
}

/// Row of a place that nobody has ever held.
pub fn fresh(place: &crate::site::Place) -> Place {
    Place {
        place_id: place.place_id.clone(),
        capacity: place.capacity,
        standing: place.waypoint().is_some(),
        holders: Vec::new(),
        quarantine: None,
        cleared: Vec::new(),
    }
}
