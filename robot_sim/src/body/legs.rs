//! Legs of a path: setting out, standing still on the way, arriving, and what the contour touches meanwhile.
//!
//! Invariant: a leg begins where the body is, so no new path, speed or pause moves it; one that brakes enters nothing
//! that its leg does not lead to.

use super::{Block, CONTOUR_MM, Order, Phase, SPEED_FLOOR_MM_S, SPEED_MAX_MM_S, SimBody};
use crate::faults::{self, draw_secs};
use crate::motion::Leg;
use crate::world::lock;
use midshift_agent::body::BodyNews;
use midshift_core::ids::{PlaceId, WaypointId};
use midshift_core::site::{PlaceIx, Site, WaypointIx};
use midshift_core::time::{SiteDuration, SiteTime};
use nalgebra::Vector2;
use rand::RngExt;
use std::collections::BTreeSet;

impl SimBody {
    /// It saw the obstacle from afar and stands before it, as at the end of its way.
    pub(super) fn meet_obstacle(&mut self, now: SiteTime, lasts: SiteDuration) {
        self.interrupt(now);
        self.block = None;
        self.counts.obstacles += 1;
        let patience = lasts.min(faults::OBSTACLE_PATIENCE);
        self.phase = Phase::Blocked { until: now + patience, gives_up: lasts > faults::OBSTACLE_PATIENCE };
    }
    /// Comes to a standstill and keeps what is left of its order: at once, or by braking if it drives.
    pub(super) fn halt(&mut self, now: SiteTime) {
        match &mut self.phase {
            Phase::Leg { leg, .. } if leg.speed_mm_s(now) > 0 => leg.brake(now),
            _ => self.interrupt(now),
        }
    }
    /// Ends what it does where it is and keeps what is left of its order.
    pub(super) fn interrupt(&mut self, now: SiteTime) {
        self.settle(now);
        match std::mem::replace(&mut self.phase, Phase::Still) {
            Phase::Still => {}
            Phase::Leg { leg, .. } => {
                if let Some(block) = &mut self.block {
                    block.after_mm -= leg.driven_mm(now);
                }
            }
            Phase::Blocked { until, gives_up } => {
                let longer = if gives_up { SiteDuration(1) } else { SiteDuration(0) };
                self.block =
                    Some(Block { after_mm: 0.0, lasts: SiteDuration(until.since(now).as_ms() + longer.as_ms()) });
            }
            Phase::Acting { until } => {
                if let Some(Order::Act(act)) = &mut self.order {
                    act.left = until.since(now);
                }
            }
        }
    }
    /// Goes on with its order if nothing keeps it.
    pub(super) fn go(&mut self, now: SiteTime) {
        let brakes = matches!(&self.phase, Phase::Leg { leg, .. } if leg.is_braking());
        if self.is_kept() || self.order.is_none() || !(brakes || matches!(self.phase, Phase::Still)) {
            return;
        }
        self.interrupt(now);
        match &self.order {
            None => {}
            Some(Order::Act(act)) => self.phase = Phase::Acting { until: now + act.left },
            Some(Order::Drive(_)) => self.begin_leg(now),
        }
    }
    pub(super) fn begin_leg(&mut self, now: SiteTime) {
        let Some(point) = self.target().cloned() else { return };
        self.charging = false;
        self.parked = false;
        let asked = point.speed_mm_s.min(self.config.speed_mm_s).min(SPEED_MAX_MM_S);
        let asked = if self.slow { asked.min(SPEED_FLOOR_MM_S) } else { asked };
        let driven = self.config.behaviour.speed_mm_s(asked);
        let leg = Leg::new(self.frame, (point.x_mm, point.y_mm), driven * self.config.pace_permille / 1000, now);
        let leg = if self.config.turns { leg } else { leg.without_turn() };
        if self.lane.is_none() && leg.length_mm() >= 1.0 {
            self.lane = self.last.clone().map(|last| (last, point.waypoint.clone()));
            self.block = self.draw_block(leg.length_mm());
        }
        let from_touched_mm = self.touching.as_ref().and_then(|t| self.distance_mm(t)).unwrap_or(0.0);
        let returns = self.touching.as_ref() == Some(&point.waypoint);
        let contour_mm = CONTOUR_MM.min(leg.length_mm() / 2.0);
        let out_mm = (self.touching.is_some() && !returns).then(|| (contour_mm - from_touched_mm).max(0.0));
        let in_mm = (!returns).then(|| leg.length_mm() - contour_mm);
        self.phase = Phase::Leg { leg, to: point.waypoint, out_mm, in_mm };
        self.occupy(now);
    }
    pub(super) fn draw_block(&mut self, length_mm: f64) -> Option<Block> {
        if let Some(lasts) = self.pending_block.take() {
            return Some(Block { after_mm: length_mm / 2.0, lasts });
        }
        let chance = 1.0 - (-self.rates().obstacle_per_km * length_mm / 1e6).exp();
        let meets = chance > 0.0 && self.rng.random_bool(chance);
        meets.then(|| Block { after_mm: length_mm * self.rng.random::<f64>(), lasts: draw_secs(&mut self.rng, 2..=14) })
    }
    pub(super) fn arrive(&mut self, now: SiteTime) {
        self.phase = Phase::Still;
        let Some(Order::Drive(path)) = &mut self.order else { return };
        let Some(point) = path.pop_front() else { return };
        let goes_on = !path.is_empty();
        self.touching = Some(point.waypoint.clone());
        self.last = Some(point.waypoint.clone());
        self.lane = None;
        self.block = None;
        self.news.push_back(BodyNews::Reached(point.waypoint));
        if goes_on {
            self.begin_leg(now);
        } else {
            self.occupy(now);
            self.drop_order(now);
            self.news.push_back(BodyNews::Done);
        }
    }
    pub(super) fn distance_mm(&self, waypoint: &WaypointId) -> Option<f64> {
        let at = self.site.waypoint(self.site.find(waypoint)?);
        let there = Vector2::new(at.x_mm as f64, at.y_mm as f64) / 1000.0;
        Some((self.frame.translation.vector - there).norm() * 1000.0)
    }
    /// Notes in the journal which places the contour entered and left by what it touches now.
    pub(super) fn occupy(&mut self, now: SiteTime) {
        let site = &self.site;
        let find = |name: &WaypointId| site.find(name);
        let mut places = Vec::new();
        match &self.lane {
            Some((from, to)) => {
                if let (Some(from), Some(to)) = (find(from), find(to)) {
                    places.extend_from_slice(site.passages_of_lane(from, to));
                }
            }
            None => places.extend(self.last.as_ref().and_then(find).into_iter().flat_map(|at| passages_at(site, at))),
        }
        places.extend(self.touching.as_ref().and_then(find).and_then(|at| site.standing_at(at)));
        let inside: BTreeSet<PlaceId> = places.into_iter().map(|p| site.place(p).place_id.clone()).collect();
        if inside != self.inside {
            let mut world = lock(&self.world);
            for left in self.inside.difference(&inside) {
                world.leave(now, &self.config.robot_id, left.clone());
            }
            for entered in inside.difference(&self.inside) {
                world.enter(now, &self.config.robot_id, entered.clone());
            }
            drop(world);
            self.inside = inside;
        }
    }
}

/// The passages that a waypoint lies inside of.
fn passages_at(site: &Site, at: WaypointIx) -> Vec<PlaceIx> {
    let passages = site.places().iter().enumerate().take_while(|(_, p)| p.waypoint().is_none());
    let around = passages.filter(|(_, p)| p.inside().is_some_and(|i| i.waypoints.binary_search(&at).is_ok()));
    around.map(|(i, _)| PlaceIx(i as u32)).collect()
}
