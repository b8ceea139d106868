//! Drives along the route of an attempt: as far as it is released, granted, fresh and allowed, and no further.
//!
//! Invariant: the body is sent only to points whose every place is inside or granted with authority that stands at that
//! moment, and only after those grants are on the ledger; each later place is looked at again when it is entered.

use super::governor;
use super::places::{Entry, Places, needs};
use super::state::AgentCore;
use super::work::{Doing, Pause, Work};
use crate::body::{BodyOrder, PathPoint};
use midshift_core::desired_state::{Assignment, RoutePoint};
use midshift_core::ids::WaypointId;
use midshift_core::robot::{Lane, Pose, StopLevel};
use midshift_core::robot_events::RobotEvent;
use midshift_core::step::StepKind;
use midshift_core::time::{LinkDuration, Now};

/// How far from a waypoint or lane a robot may be and still count as on it, millimetres.
const NEAR_MM: f64 = 200.0;

impl AgentCore {
    /// Goes on with a goto. True: something changed and it is worth looking again.
    pub(crate) fn drive(&mut self, now: &Now, pause: Pause) -> bool {
        let Some(order) = self.work.as_ref().and_then(|w| w.order.clone()) else { return false };
        if !self.locate(now, &order) {
            return self.cut_to_heading(now);
        }
        let Some(work) = &self.work else { return false };
        let (step, doing, reached) = (work.holder.step, work.doing, work.reached);
        let from = reached.unwrap_or(0);
        let goal = (from..order.route.len()).find(|i| order.route[*i].ends_step == Some(step));
        if doing == Doing::Nothing && self.heading.is_none() && self.at_goal(now, &order, goal, reached) {
            self.complete_step();
            return true;
        }
        let Some(goal) = goal else { return false };
        let next = reached.map_or(0, |i| i + 1);
        let Some(limit) = self.drive_limit(now, &order, next, goal, pause) else { return false };
        let path = self.path(&order, next, limit);
        if self.work.as_ref().is_some_and(|w| w.doing == Doing::Driving && w.path == path) {
            return false;
        }
        if self.places.commit(order.route[next..=limit].iter(), &self.sent, now.link) {
            self.write_places();
            self.wait_until_durable();
            return true;
        }
        self.set_out(now, &order.route[next], path)
    }

    /// Cuts the path under way to what may still be driven; never lengthens it.
    pub(crate) fn shorten(&mut self, now: &Now, pause: Pause) {
        let Some(work) = self.work.as_ref().filter(|w| w.located) else { return };
        let Some(order) = work.order.clone() else { return };
        let (next, length) = (work.reached.map_or(0, |i| i + 1), work.path.len());
        let Some(limit) = self.drive_limit(now, &order, next, order.route.len() - 1, pause) else { return };
        let keep = limit + 1 - next;
        let Some(work) = self.work.as_mut().filter(|_| keep < length) else { return };
        work.path.truncate(keep);
        let path = BodyOrder::Drive(work.path.clone());
        if let Err(fault) = self.body.start(now.site, path) {
            self.step_failed(now, fault);
        }
    }

    fn at_goal(&self, now: &Now, order: &Assignment, goal: Option<usize>, reached: Option<usize>) -> bool {
        if goal.is_some() {
            return goal == reached;
        }
        let step = self.work.as_ref().and_then(|w| order.steps.get(w.holder.step as usize));
        matches!(step.map(|s| &s.kind), Some(StepKind::Goto { waypoint }) if self.last_waypoint(now).as_ref() == Some(waypoint))
    }

    /// Sends the body along `path`, whose first point is `next`.
    fn set_out(&mut self, now: &Now, next: &RoutePoint, path: Vec<PathPoint>) -> bool {
        if self.body.state(now.site).charging {
            self.body.charge(now.site, false);
        }
        if let Err(fault) = self.body.start(now.site, BodyOrder::Drive(path.clone())) {
            self.step_failed(now, fault);
            return true;
        }
        let events = self.places.enter(next, &self.sent, now.link);
        events.into_iter().for_each(|e| self.emit(Lane::Event, e));
        self.heading = Some(next.waypoint.clone());
        if let Some(work) = &mut self.work {
            (work.doing, work.started, work.paused, work.recheck) = (Doing::Driving, true, false, false);
            work.path = path;
        }
        true
    }

    fn path(&self, order: &Assignment, next: usize, limit: usize) -> Vec<PathPoint> {
        let (policy, stop) = (&self.memory.ledger.policy, self.stop_level());
        let point = |p: &RoutePoint| PathPoint {
            waypoint: p.waypoint.clone(),
            x_mm: p.x_mm,
            y_mm: p.y_mm,
            speed_mm_s: match order.speed_limit_mm_s.filter(|_| self.config.bugs.last_word_is_the_limit()) {
                Some(speed_mm_s) => speed_mm_s,
                None => governor::speed_mm_s(&self.limits, policy, order.speed_limit_mm_s, stop, p),
            },
            keep_off_mm: governor::keep_off_mm(policy, p),
        };
        order.route[next..=limit].iter().map(point).collect()
    }

    /// Index of the last point it may drive to now. None: stay.
    fn drive_limit(&mut self, now: &Now, order: &Assignment, next: usize, goal: usize, pause: Pause) -> Option<usize> {
        let moving = self.is_driving();
        let cap = order.released_index.map(|i| (i as usize).min(goal).min(order.route.len() - 1));
        let mut limit = moving.then_some(next);
        for (k, point) in order.route.iter().enumerate().take(cap.map_or(0, |c| c + 1)).skip(next) {
            let blocked = self.blocked_at(now, point);
            let entered = moving && k == next;
            if let Some(stale) = blocked.filter(|_| !entered) {
                if k == next {
                    self.tell_stale_grant(stale);
                }
                break;
            }
            limit = Some(k);
        }
        let limit = limit?;
        if pause == Pause::No {
            return Some(limit);
        }
        if !moving {
            return None;
        }
        let ending = self.work.as_ref().is_some_and(|w| w.ending.is_some());
        let clear = |k: &usize| !Places::in_passage(&order.route[*k], order.route.get(*k + 1));
        let standing = |k: &usize| order.route[*k].standing.is_some();
        let first_clear = (next..=limit).find(clear);
        let first_standing = (next..=limit).find(standing).filter(|_| !ending);
        first_standing.or(first_clear).or(Some(limit))
    }

    /// The place that keeps the robot from setting out to `point`; wakes the core when a permission on the way ends.
    fn blocked_at(&mut self, now: &Now, point: &RoutePoint) -> Option<Entry> {
        for place_id in needs(point) {
            match self.places.entry(place_id, &self.sent, now.link) {
                Entry::Inside => {}
                Entry::Granted { until, .. } => self.wake_at(until + LinkDuration(1)),
                blocked @ (Entry::Stale { .. } | Entry::Missing) => return Some(blocked),
            }
        }
        None
    }

    /// Says once per authority that a grant was refused as stale.
    fn tell_stale_grant(&mut self, entry: Entry) {
        let Entry::Stale { grant_id, authority, why } = entry else { return };
        if self.stale_told.len() >= midshift_core::limits::HEARTBEATS_REMEMBERED {
            self.stale_told.clear();
        }
        if self.stale_told.insert((grant_id, authority.session_epoch, authority.hb)) {
            let event = RobotEvent::StaleAuthority { what: "grant".to_owned(), detail: why.to_string() };
            self.emit(Lane::Event, event);
        }
    }

    /// The body reached a waypoint: out of what lies behind, into what lies ahead if that still may be.
    pub(crate) fn on_reached(&mut self, now: &Now, waypoint: &WaypointId) {
        self.progressed();
        if self.heading.as_ref() == Some(waypoint) {
            self.heading = None;
        }
        let Some(work) = self.work.as_ref().filter(|w| w.doing == Doing::Driving) else { return };
        let Some(points) = work.path.iter().position(|p| p.waypoint == *waypoint) else { return };
        for _ in 0..=points {
            self.pass_point(now);
        }
        self.write_places();
    }

    fn pass_point(&mut self, now: &Now) {
        let Some(work) = self.work.as_mut().filter(|w| !w.path.is_empty()) else { return };
        work.path.remove(0);
        self.heading = None;
        let Some(order) = work.order.clone().filter(|_| work.located) else { return };
        let at = work.reached.map_or(0, |i| i + 1);
        work.reached = Some(at);
        let drives_on = !work.path.is_empty();
        let Some(point) = order.route.get(at) else { return };
        let next = order.route.get(at + 1);
        let events = self.places.reached(point, next);
        events.into_iter().for_each(|e| self.emit(Lane::Event, e));
        let Some(next) = next.filter(|_| drives_on) else { return };
        let late = self.blocked_at(now, next);
        if late == Some(Entry::Missing) {
            self.body.stop(now.site, StopLevel::Halt);
            if let Some(work) = &mut self.work {
                work.doing = Doing::Nothing;
                work.path.clear();
            }
            return;
        }
        if let Some(stale) = late {
            // It passed the point in the very moment in which its permission ended: it is in, and says so.
            self.tell_stale_grant(stale);
            let events = self.places.entered_late(next);
            events.into_iter().for_each(|e| self.emit(Lane::Event, e));
        }
        let events = self.places.enter(next, &self.sent, now.link);
        events.into_iter().for_each(|e| self.emit(Lane::Event, e));
        self.heading = Some(next.waypoint.clone());
    }

    /// Lost on the new route: no further than the point it is heading for.
    fn cut_to_heading(&mut self, now: &Now) -> bool {
        let Some(work) = self.work.as_mut().filter(|w| w.doing == Doing::Driving && w.path.len() > 1) else {
            return false;
        };
        work.path.truncate(1);
        let order = BodyOrder::Drive(work.path.clone());
        if let Err(fault) = self.body.start(now.site, order) {
            self.step_failed(now, fault);
        }
        true
    }

    /// Finds where on the route the robot is, if that is not known. False: not on it.
    fn locate(&mut self, now: &Now, order: &Assignment) -> bool {
        let Some(work) = &self.work else { return false };
        if work.located {
            return true;
        }
        let Some(reached) = self.place_on_route(now, order, work.holder.step) else { return false };
        let Some(work) = &mut self.work else { return false };
        (work.located, work.reached) = (true, reached);
        true
    }

    /// Index of the last route point reached, or none of it yet. Outer none: the robot is not on this route.
    pub(crate) fn place_on_route(&self, now: &Now, order: &Assignment, step: u32) -> Option<Option<usize>> {
        let state = self.body.state(now.site);
        let route = &order.route;
        let Some(at) = state.waypoint else { return Some(None) };
        if route.is_empty() {
            return Some(None);
        }
        // It may skip points of the route, but not the end of a drive that is still to be done, nor go back behind one
        // that is: the way to the drop may pass where the way to the pick-up passed.
        let done = route.iter().rposition(|p| p.ends_step.is_some_and(|s| s < step)).unwrap_or(0);
        let open = route.iter().position(|p| p.ends_step.is_some_and(|s| s >= step)).unwrap_or(route.len() - 1);
        let leg = done.min(open)..=open;
        let find = |name: &WaypointId| Some(leg.start() + route[leg.clone()].iter().position(|p| p.waypoint == *name)?);
        if let Some(i) = self.heading.as_ref().and_then(find) {
            return Some(i.checked_sub(1));
        }
        let i = find(&at)?;
        if self.heading.is_some() || distance_mm(&state.pose, &route[i], &route[i]) > NEAR_MM {
            let on_lane = route.get(i + 1).is_some_and(|n| distance_mm(&state.pose, &route[i], n) <= NEAR_MM);
            return Some(if on_lane && self.heading.is_none() { Some(i) } else { i.checked_sub(1) });
        }
        Some(Some(i))
    }

    /// A place where it may be left: at the end of a drive or on a standing place, not between two waypoints.
    pub(crate) fn at_boundary(&self, work: &Work) -> bool {
        let point = work.order.as_ref().and_then(|o| o.route.get(work.reached?).cloned());
        self.heading.is_none() && point.is_none_or(|p| p.standing.is_some() || p.ends_step.is_some())
    }
}

/// Distance of a pose from the line between two points, millimetres.
fn distance_mm(pose: &Pose, from: &RoutePoint, to: &RoutePoint) -> f64 {
    let point = |x: i32, y: i32| (f64::from(x), f64::from(y));
    let ((px, py), (ax, ay), (bx, by)) =
        (point(pose.x_mm, pose.y_mm), point(from.x_mm, from.y_mm), point(to.x_mm, to.y_mm));
    let (dx, dy) = (bx - ax, by - ay);
    let length = dx * dx + dy * dy;
    let along = if length == 0.0 { 0.0 } else { (((px - ax) * dx + (py - ay) * dy) / length).clamp(0.0, 1.0) };
    (px - ax - along * dx).hypot(py - ay - along * dy)
}
