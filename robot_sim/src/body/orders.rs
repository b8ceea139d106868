//! `trait Body` for the simulated body.

use super::{BODY_LABEL, MODEL, Order, Phase, SPEED_FLOOR_MM_S, SPEED_MAX_MM_S, SimBody};
use crate::faults;
use crate::journal::{Effect, Work};
use crate::world::lock;
use midshift_agent::body::{Body, BodyLimits, BodyNews, BodyOrder, BodyState, Checked, PathPoint};
use midshift_core::ids::{TaskId, WaypointId};
use midshift_core::robot::{Fault, HardwareStop, Inventory, Load, Mode, Pose, StopLevel};
use midshift_core::step::StepKind;
use midshift_core::time::{SiteDuration, SiteTime};
use std::collections::{BTreeMap, VecDeque};

/// A body with a file writes where it is this often while it moves, so that a killed process does not move it back far.
const KEEP_EVERY: SiteDuration = SiteDuration(500);
/// State of charge at which it says critical, permille.
const CRITICAL_PERMILLE: u16 = 80;

impl Body for SimBody {
    fn capabilities(&self) -> Inventory {
        Inventory {
            capabilities: ["inspect", "pick", "place"].map(str::to_owned).to_vec(),
            labels: BTreeMap::from([(BODY_LABEL.0.to_owned(), BODY_LABEL.1.to_owned())]),
            payload_g: 15_000,
            software: self.config.software.clone(),
            agent_version: String::new(),
            model: MODEL.to_owned(),
            load_by_memory: false,
        }
    }
    fn limits(&self) -> BodyLimits {
        BodyLimits {
            speed_mm_s: self.config.speed_mm_s.min(SPEED_MAX_MM_S),
            floor_speed_mm_s: SPEED_FLOOR_MM_S,
            battery_critical_permille: CRITICAL_PERMILLE,
        }
    }
    fn work_for(&mut self, task_id: Option<&TaskId>, step_index: u32) {
        self.work = task_id.map(|task_id| Work { task_id: task_id.clone(), step_index });
    }
    fn start(&mut self, now: SiteTime, order: BodyOrder) -> Result<(), Fault> {
        self.advance(now);
        if let Some(fault) = &self.broken {
            return Err(fault.clone());
        }
        if self.mode != Mode::Automatic {
            return Err(faults::manual());
        }
        match order {
            BodyOrder::Drive(path) => {
                if path.is_empty() {
                    return Err(faults::semantic("the path has no points"));
                }
                self.interrupt(now);
                let path = self.without_passed(path.into());
                self.order = Some(Order::Drive(path));
            }
            BodyOrder::Act(step) => {
                let act = self.read_act(&step)?;
                self.interrupt(now);
                self.parked = false;
                self.order = Some(Order::Act(act));
            }
        }
        self.go(now);
        self.note_motion(now);
        Ok(())
    }
    fn pause(&mut self, now: SiteTime) {
        self.advance(now);
        if self.order.is_some() {
            self.halt(now);
            self.paused = true;
        }
        self.note_motion(now);
    }
    fn resume(&mut self, now: SiteTime) {
        self.advance(now);
        self.paused = false;
        self.go(now);
        self.note_motion(now);
    }
    fn stop(&mut self, now: SiteTime, level: StopLevel) {
        self.advance(now);
        match level {
            StopLevel::None | StopLevel::Slow => self.slow_down(now, level == StopLevel::Slow),
            StopLevel::Halt | StopLevel::ControlledStopPosture => {
                self.halt(now);
                if self.order.is_some() {
                    self.drop_order(now);
                }
                self.parked |= level == StopLevel::ControlledStopPosture;
            }
        }
        self.note_motion(now);
    }
    fn obeys(&mut self, now: SiteTime, level: StopLevel) {
        self.advance(now);
        self.slow_down(now, level == StopLevel::Slow);
        self.obeyed = (level, false);
        let odometer_mm = self.odometer_mm as u64;
        lock(&self.world).stop(now, &self.config.robot_id, Effect::Obeys { level, odometer_mm });
        self.note_motion(now);
    }
    fn standstill(&self, now: SiteTime) -> bool {
        let stands = match &self.phase {
            Phase::Still => true,
            Phase::Leg { leg, .. } => leg.is_braking() && leg.end() <= now,
            Phase::Blocked { .. } | Phase::Acting { .. } => false,
        };
        stands && (self.order.is_none() || self.is_kept())
    }
    fn park(&mut self, now: SiteTime) {
        self.advance(now);
        self.parked = self.order.is_none();
    }
    fn charge(&mut self, now: SiteTime, on: bool) {
        self.advance(now);
        self.charging = on && !matches!(self.phase, Phase::Leg { .. });
    }
    fn poll(&mut self, now: SiteTime) -> Vec<BodyNews> {
        self.advance(now);
        self.write_file();
        self.news.drain(..).collect()
    }
    fn next_change(&self, now: SiteTime) -> Option<SiteTime> {
        if !self.news.is_empty() {
            return Some(now);
        }
        let keeps = self.keeper.is_some() && matches!(self.phase, Phase::Leg { .. });
        let keep_at = keeps.then(|| self.at + KEEP_EVERY);
        [self.next_event(), keep_at].into_iter().flatten().min()
    }
    fn state(&self, now: SiteTime) -> BodyState {
        let now = now.max(self.at);
        let (frame, driven_mm, stores) = self.glance(now);
        let loaded_mm = if self.load.is_some() { driven_mm } else { 0.0 };
        BodyState {
            pose: Pose::from_isometry(&frame),
            waypoint: self.last.clone(),
            speed_mm_s: self.speed_mm_s(now),
            battery_permille: stores.charge_permille(),
            charging: self.charging,
            hottest_joint_decidegrees: (stores.hottest_c() * 10.0).round() as i32,
            odometer_mm: (self.odometer_mm + driven_mm) as u64,
            loaded_odometer_mm: (self.loaded_mm + loaded_mm) as u64,
            energy_mwh: stores.spent_mwh as u64,
            field_violation: matches!(self.phase, Phase::Blocked { .. }),
        }
    }
    fn load(&self) -> Option<Load> {
        self.load.clone()
    }
    fn check(&self, step: &StepKind, task_id: Option<&TaskId>) -> Checked {
        match (step, task_id) {
            (StepKind::Goto { waypoint }, _) if self.lane.is_none() && self.last.as_ref() == Some(waypoint) => {
                Checked::Done
            }
            (StepKind::Goto { .. }, _) => Checked::NotDone,
            (StepKind::Action { name, .. }, Some(task)) if name == "pick" || name == "place" => {
                let done = self.recent.iter().any(|(of, deed)| of == task && deed == name);
                if done { Checked::Done } else { Checked::NotDone }
            }
            _ => Checked::Unknown,
        }
    }
    fn self_test(&mut self, now: SiteTime) -> Result<(), Fault> {
        self.advance(now);
        self.broken.clone().map_or(Ok(()), Err)
    }
    fn hardware_stop(&self) -> HardwareStop {
        self.hardware_stop
    }
    fn mode(&self) -> Mode {
        self.mode
    }
    fn map_version(&self) -> String {
        self.site.map_version().to_owned()
    }
    fn stands_on(&self) -> Vec<WaypointId> {
        self.touching.clone().into_iter().collect()
    }
}

impl SimBody {
    /// Its joints and wheels go slowly, or as fast as they are asked to again.
    fn slow_down(&mut self, now: SiteTime, is_slow: bool) {
        let changes = std::mem::replace(&mut self.slow, is_slow) != is_slow;
        if changes && matches!(&self.phase, Phase::Leg { leg, .. } if !leg.is_braking()) {
            self.interrupt(now);
            self.go(now);
        }
    }
    /// A path that begins with the beginning of the lane it is on goes on to the end of that lane, not back.
    fn without_passed(&self, mut path: VecDeque<PathPoint>) -> VecDeque<PathPoint> {
        let passed = |path: &VecDeque<PathPoint>| match (&self.lane, path.front(), path.get(1)) {
            (Some((from, to)), Some(first), Some(second)) => first.waypoint == *from && second.waypoint == *to,
            _ => false,
        };
        if passed(&path) {
            path.pop_front();
        }
        path
    }
}
