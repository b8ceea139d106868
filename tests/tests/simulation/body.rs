//! A simulated body whose orders are seen by the observer before they are obeyed.

use crate::observer::Shared;
use midshift_agent::body::{Body, BodyLimits, BodyNews, BodyOrder, BodyState, Checked};
use midshift_core::ids::{TaskId, WaypointId};
use midshift_core::robot::{Fault, HardwareStop, Inventory, Load, Mode, StopLevel};
use midshift_core::step::StepKind;
use midshift_core::time::SiteTime;
use midshift_sim::handle::SimHandle;

/// The body behind its witness.
pub struct WatchedBody {
    inner: SimHandle,
    observer: Shared,
    task_id: Option<TaskId>,
}

impl WatchedBody {
    /// Watches `inner`.
    pub fn new(inner: SimHandle, observer: Shared) -> Self {
        Self { inner, observer, task_id: None }
    }
}

impl Body for WatchedBody {
    fn capabilities(&self) -> Inventory {
        self.inner.capabilities()
    }
    fn limits(&self) -> BodyLimits {
        self.inner.limits()
    }
    fn work_for(&mut self, task_id: Option<&TaskId>, step_index: u32) {
        self.task_id = task_id.cloned();
        self.inner.work_for(task_id, step_index);
    }
    fn start(&mut self, now: SiteTime, order: BodyOrder) -> Result<(), Fault> {
        if let (BodyOrder::Act(step), Some(task_id)) = (&order, &self.task_id) {
            self.observer.acts(self.inner.robot_id(), task_id, step);
        }
        self.inner.start(now, order)
    }
    fn pause(&mut self, now: SiteTime) {
        self.inner.pause(now);
    }
    fn resume(&mut self, now: SiteTime) {
        self.inner.resume(now);
    }
    fn stop(&mut self, now: SiteTime, level: StopLevel) {
        self.inner.stop(now, level);
    }
    fn obeys(&mut self, now: SiteTime, level: StopLevel) {
        self.inner.obeys(now, level);
    }
    fn standstill(&self, now: SiteTime) -> bool {
        self.inner.standstill(now)
    }
    fn park(&mut self, now: SiteTime) {
        self.inner.park(now);
    }
    fn charge(&mut self, now: SiteTime, on: bool) {
        self.inner.charge(now, on);
    }
    fn poll(&mut self, now: SiteTime) -> Vec<BodyNews> {
        self.inner.poll(now)
    }
    fn next_change(&self, now: SiteTime) -> Option<SiteTime> {
        self.inner.next_change(now)
    }
    fn state(&self, now: SiteTime) -> BodyState {
        self.inner.state(now)
    }
    fn load(&self) -> Option<Load> {
        self.inner.load()
    }
    fn forget_load(&mut self, now: SiteTime) {
        self.inner.forget_load(now);
    }
    fn check(&self, step: &StepKind, task_id: Option<&TaskId>) -> Checked {
        self.inner.check(step, task_id)
    }
    fn self_test(&mut self, now: SiteTime) -> Result<(), Fault> {
        self.inner.self_test(now)
    }
    fn hardware_stop(&self) -> HardwareStop {
        self.inner.hardware_stop()
    }
    fn mode(&self) -> Mode {
        self.inner.mode()
    }
    fn map_version(&self) -> String {
        self.inner.map_version()
    }
    fn stands_on(&self) -> Vec<WaypointId> {
        self.inner.stands_on()
    }
}
