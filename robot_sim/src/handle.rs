//! A body behind a lock, so that the agent drives it and a simulated person can lay hands on it.
//!
//! Invariant: the lock is never held across anything that waits.

use crate::body::{Counts, SimBody};
use crate::faults::Injected;
use midshift_agent::body::{Body, BodyLimits, BodyNews, BodyOrder, BodyState, Checked};
use midshift_core::ids::{RobotId, TaskId, WaypointId};
use midshift_core::robot::{Fault, HardwareStop, Inventory, Load, Mode, StopLevel};
use midshift_core::step::StepKind;
use midshift_core::time::SiteTime;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::watch;

/// A shared body; clones are the same body.
#[derive(Clone, Debug)]
pub struct SimHandle {
    robot_id: RobotId,
    body: Arc<Mutex<SimBody>>,
}

impl SimHandle {
    /// Takes a body behind a lock.
    pub fn new(body: SimBody) -> Self {
        Self { robot_id: body.robot_id().clone(), body: Arc::new(Mutex::new(body)) }
    }
    /// Whose body.
    pub fn robot_id(&self) -> &RobotId {
        &self.robot_id
    }
    /// The body itself, also after a panic elsewhere.
    pub fn lock(&self) -> MutexGuard<'_, SimBody> {
        self.body.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// See [`SimBody::inject`].
    pub fn inject(&self, now: SiteTime, what: Injected) {
        self.lock().inject(now, what);
    }
    /// See [`SimBody::network`].
    pub fn network(&self) -> watch::Receiver<bool> {
        self.lock().network()
    }
    /// See [`SimBody::stop_network`].
    pub fn stop_network(&self) -> watch::Receiver<bool> {
        self.lock().stop_network()
    }
    /// See [`SimBody::counts`].
    pub fn counts(&self) -> Counts {
        self.lock().counts()
    }
}

impl Body for SimHandle {
    fn capabilities(&self) -> Inventory {
        self.lock().capabilities()
    }
    fn limits(&self) -> BodyLimits {
        self.lock().limits()
    }
    fn work_for(&mut self, task_id: Option<&TaskId>, step_index: u32) {
        self.lock().work_for(task_id, step_index);
    }
    fn start(&mut self, now: SiteTime, order: BodyOrder) -> Result<(), Fault> {
        self.lock().start(now, order)
    }
    fn pause(&mut self, now: SiteTime) {
        self.lock().pause(now);
    }
    fn resume(&mut self, now: SiteTime) {
        self.lock().resume(now);
    }
    fn stop(&mut self, now: SiteTime, level: StopLevel) {
        self.lock().stop(now, level);
    }
    fn obeys(&mut self, now: SiteTime, level: StopLevel) {
        self.lock().obeys(now, level);
    }
    fn standstill(&self, now: SiteTime) -> bool {
        self.lock().standstill(now)
    }
    fn park(&mut self, now: SiteTime) {
        self.lock().park(now);
    }
    fn charge(&mut self, now: SiteTime, on: bool) {
        self.lock().charge(now, on);
    }
    fn poll(&mut self, now: SiteTime) -> Vec<BodyNews> {
        self.lock().poll(now)
    }
    fn next_change(&self, now: SiteTime) -> Option<SiteTime> {
        self.lock().next_change(now)
    }
    fn state(&self, now: SiteTime) -> BodyState {
        self.lock().state(now)
    }
    fn load(&self) -> Option<Load> {
        self.lock().load()
    }
    fn forget_load(&mut self, now: SiteTime) {
        self.lock().forget_load(now);
    }
    fn check(&self, step: &StepKind, task_id: Option<&TaskId>) -> Checked {
        self.lock().check(step, task_id)
    }
    fn self_test(&mut self, now: SiteTime) -> Result<(), Fault> {
        self.lock().self_test(now)
    }
    fn hardware_stop(&self) -> HardwareStop {
        self.lock().hardware_stop()
    }
    fn mode(&self) -> Mode {
        self.lock().mode()
    }
    fn map_version(&self) -> String {
        Body::map_version(&*self.lock())
    }
    fn stands_on(&self) -> Vec<WaypointId> {
        self.lock().stands_on()
    }
}
