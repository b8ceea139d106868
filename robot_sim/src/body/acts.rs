//! What hands do: pick, place, inspect, and the waits between.

use super::act::{Act, Deed};
use super::{Order, Phase, RECENT_MAX, SimBody};
use crate::faults;
use crate::world::{UNNAMED_SKU, lock, sku_of};
use midshift_agent::body::BodyNews;
use midshift_core::energy::{ACTION_VARIES_PERMILLE, HANDLE, INSPECT};
use midshift_core::robot::{Fault, Load};
use midshift_core::step::StepKind;
use midshift_core::time::{SiteDuration, SiteTime};
use rand::RngExt;

impl SimBody {
    /// Reads a step into an action, or says what is wrong with it.
    pub(super) fn read_act(&mut self, step: &StepKind) -> Result<Act, Fault> {
        let (deed, item, usual) = match step {
            StepKind::Goto { .. } => return Err(faults::semantic("a goto is no action")),
            StepKind::Wait { duration_ms } => {
                let left = SiteDuration(*duration_ms);
                return Ok(Act { deed: Deed::Wait, item: String::new(), left, jams: false, misses: false });
            }
            StepKind::Action { name, params } => {
                let item = params.get("item").and_then(serde_json::Value::as_str).unwrap_or_default().to_owned();
                match name.as_str() {
                    "pick" => (Deed::Pick, item, HANDLE),
                    "place" => (Deed::Place, item, HANDLE),
                    "inspect" => (Deed::Inspect, item, INSPECT),
                    _ => return Err(faults::semantic("this body does not know that action")),
                }
            }
        };
        if self.lane.is_some() || self.last.is_none() {
            return Err(faults::semantic("the body stands at no waypoint"));
        }
        match (&deed, &self.load) {
            (Deed::Pick, Some(_)) => return Err(faults::semantic("the gripper is full")),
            (Deed::Place, None) => return Err(faults::load_lost()),
            (Deed::Place, Some(load)) if !item.is_empty() && sku_of(&load.item) != sku_of(&item) => {
                return Err(faults::semantic("another item is in the gripper"));
            }
            _ => {}
        }
        let rates = self.rates();
        let usual_ms = usual.as_ms();
        let varies_ms = usual_ms * ACTION_VARIES_PERMILLE / 1_000;
        let left = SiteDuration(self.rng.random_range(usual_ms - varies_ms..=usual_ms + varies_ms));
        let jams = self.rng.random_bool(rates.jam_per_action.clamp(0.0, 1.0));
        let missed = self.rng.random_bool(rates.gripper_per_pick.clamp(0.0, 1.0));
        let made_to = deed == Deed::Pick && self.misses_next > 0;
        self.misses_next -= u32::from(made_to);
        let misses = deed == Deed::Pick && (made_to || missed);
        Ok(Act { deed, item, left, jams, misses })
    }
    /// The end of an action: the one moment at which the world changes by it.
    pub(super) fn finish_act(&mut self, now: SiteTime) {
        self.phase = Phase::Still;
        let Some(Order::Act(act)) = self.order.clone() else { return };
        if act.jams {
            self.jam(now);
            return;
        }
        let done = match act.deed {
            Deed::Pick => self.pick(now, &act),
            Deed::Place => self.put_down(now),
            Deed::Inspect | Deed::Wait => Ok(()),
        };
        match done {
            Ok(()) => {
                self.drop_order(now);
                self.news.push_back(BodyNews::Done);
            }
            Err(fault) => self.fail(now, fault),
        }
    }
    fn pick(&mut self, now: SiteTime, act: &Act) -> Result<(), Fault> {
        let at = self.last.clone().filter(|_| !act.misses);
        let robot = &self.config.robot_id;
        let found = at.and_then(|at| lock(&self.world).pick(now, robot, &at, &act.item, self.work.clone()));
        let Some(found) = found else {
            self.counts.misses += 1;
            return Err(faults::gripper_missed());
        };
        let named = if act.item.is_empty() { sku_of(&found).to_owned() } else { act.item.clone() };
        self.load = Some(Load { task_id: self.work.as_ref().map(|w| w.task_id.clone()), item: named });
        self.counts.picks += 1;
        self.remember("pick");
        self.news.push_back(BodyNews::Load(self.load.clone()));
        Ok(())
    }
    fn put_down(&mut self, now: SiteTime) -> Result<(), Fault> {
        let robot = &self.config.robot_id;
        let at = self.last.clone();
        let placed = at.and_then(|at| lock(&self.world).place(now, robot, &at, self.work.clone()));
        placed.ok_or_else(faults::load_lost)?;
        self.load = None;
        self.counts.places += 1;
        self.remember("place");
        self.news.push_back(BodyNews::Load(None));
        Ok(())
    }
    fn remember(&mut self, deed: &str) {
        if let Some(work) = &self.work {
            if self.recent.len() == RECENT_MAX {
                self.recent.pop_front();
            }
            self.recent.push_back((work.task_id.clone(), deed.to_owned()));
        }
    }
    /// The load as the world knows it, for a body that comes back.
    pub(super) fn load_from_world(&self) -> Option<Load> {
        let world = lock(&self.world);
        let carried = world.carried_by(&self.config.robot_id)?;
        let sku = sku_of(&carried.item);
        let item = if sku.is_empty() { UNNAMED_SKU } else { sku };
        Some(Load { task_id: carried.work.as_ref().map(|w| w.task_id.clone()), item: item.to_owned() })
    }
}
