//! A body that does what a test says: it notes what it is asked, and reaches, ends and fails at a word.

use crate::rig::{waypoint, x_of};
use midshift_agent::body::{Body, BodyLimits, BodyNews, BodyOrder, BodyState, Checked, PathPoint};
use midshift_core::ids::{TaskId, WaypointId};
use midshift_core::robot::{Fault, HardwareStop, Inventory, Load, Mode, Pose, StopLevel};
use midshift_core::step::StepKind;
use midshift_core::time::SiteTime;
use std::sync::{Arc, Mutex, MutexGuard};

/// What the body was told and how it is.
#[derive(Clone)]
pub struct BodyLog {
    pub path: Vec<PathPoint>,
    pub acting: Option<StepKind>,
    pub acts: u32,
    pub paused: bool,
    pub stops: u32,
    pub parks: u32,
    pub charging: bool,
    pub battery_permille: u16,
    pub waypoint: Option<WaypointId>,
    pub pose: Pose,
    pub load: Option<Load>,
    /// It knows its load by memory alone.
    pub load_by_memory: bool,
    /// Levels that it was told, in order.
    pub levels: Vec<StopLevel>,
    pub mode: Mode,
    pub hardware_stop: HardwareStop,
    pub checked: Checked,
    /// What the maker's test finds broken.
    pub broken: Option<Fault>,
    news: Vec<BodyNews>,
}

#[derive(Clone)]
pub struct TestBody(pub Arc<Mutex<BodyLog>>);

impl TestBody {
    pub fn at(name: &str) -> Self {
        Self(Arc::new(Mutex::new(BodyLog {
            path: Vec::new(),
            acting: None,
            acts: 0,
            paused: false,
            stops: 0,
            parks: 0,
            charging: false,
            battery_permille: 700,
            waypoint: Some(waypoint(name)),
            pose: Pose { x_mm: x_of(name), ..Pose::default() },
            load: None,
            load_by_memory: false,
            levels: Vec::new(),
            mode: Mode::Automatic,
            hardware_stop: HardwareStop::None,
            checked: Checked::Unknown,
            broken: None,
            news: Vec::new(),
        })))
    }
    fn lock(&self) -> MutexGuard<'_, BodyLog> {
        self.0.lock().expect("not poisoned")
    }
    /// What it was told so far and how it is.
    pub fn log(&self) -> BodyLog {
        self.lock().clone()
    }
    /// Makes it otherwise, without a word.
    pub fn set(&self, change: impl FnOnce(&mut BodyLog)) {
        change(&mut self.lock());
    }
    /// Reaches the next point of its path, and is done if it was the last.
    pub fn reach(&self) -> String {
        let mut log = self.lock();
        let point = log.path.remove(0);
        log.waypoint = Some(point.waypoint.clone());
        log.pose = Pose { x_mm: point.x_mm, ..Pose::default() };
        log.news.push(BodyNews::Reached(point.waypoint.clone()));
        if log.path.is_empty() {
            log.news.push(BodyNews::Done);
        }
        point.waypoint.to_string()
    }
    pub fn done(&self) {
        let mut log = self.lock();
        log.acting = None;
        log.news.push(BodyNews::Done);
    }
    pub fn says(&self, news: BodyNews) {
        let mut log = self.lock();
        match &news {
            BodyNews::Mode(mode) => log.mode = *mode,
            BodyNews::HardwareStop(stop) => log.hardware_stop = *stop,
            BodyNews::Load(load) => log.load = load.clone(),
            BodyNews::Failed(_) => log.acting = None,
            _ => {}
        }
        log.news.push(news);
    }
    pub fn goes_to(&self) -> Vec<String> {
        self.lock().path.iter().map(|p| p.waypoint.to_string()).collect()
    }
}

impl Body for TestBody {
    fn capabilities(&self) -> Inventory {
        let capabilities = vec!["pick".into(), "place".into()];
        let (model, load_by_memory) = (crate::release::MODEL.to_owned(), self.lock().load_by_memory);
        Inventory { capabilities, model, load_by_memory, ..Inventory::default() }
    }
    fn limits(&self) -> BodyLimits {
        BodyLimits { speed_mm_s: 1_500, floor_speed_mm_s: 50, battery_critical_permille: 100 }
    }
    fn start(&mut self, _: SiteTime, order: BodyOrder) -> Result<(), Fault> {
        let mut log = self.lock();
        log.paused = false;
        match order {
            BodyOrder::Drive(path) => log.path = path,
            BodyOrder::Act(kind) => {
                log.acts += 1;
                log.acting = Some(kind);
            }
        }
        Ok(())
    }
    fn pause(&mut self, _: SiteTime) {
        self.lock().paused = true;
    }
    fn resume(&mut self, _: SiteTime) {
        self.lock().paused = false;
    }
    fn obeys(&mut self, _: SiteTime, level: StopLevel) {
        self.lock().levels.push(level);
    }
    fn stop(&mut self, _: SiteTime, level: StopLevel) {
        let mut log = self.lock();
        if level <= StopLevel::Slow {
            return;
        }
        log.stops += 1;
        log.paused = false;
        log.path.clear();
        log.acting = None;
    }
    fn standstill(&self, _: SiteTime) -> bool {
        let log = self.lock();
        log.paused || log.path.is_empty() && log.acting.is_none()
    }
    fn park(&mut self, _: SiteTime) {
        self.lock().parks += 1;
    }
    fn charge(&mut self, _: SiteTime, on: bool) {
        self.lock().charging = on;
    }
    fn poll(&mut self, _: SiteTime) -> Vec<BodyNews> {
        std::mem::take(&mut self.lock().news)
    }
    fn next_change(&self, _: SiteTime) -> Option<SiteTime> {
        None
    }
    fn state(&self, _: SiteTime) -> BodyState {
        let log = self.lock();
        BodyState {
            pose: log.pose,
            waypoint: log.waypoint.clone(),
            speed_mm_s: 0,
            battery_permille: log.battery_permille,
            charging: log.charging,
            hottest_joint_decidegrees: 300,
            odometer_mm: 0,
            loaded_odometer_mm: 0,
            energy_mwh: 0,
            field_violation: false,
        }
    }
    fn load(&self) -> Option<Load> {
        self.lock().load.clone()
    }
    fn forget_load(&mut self, _: SiteTime) {
        self.says(BodyNews::Load(None));
    }
    fn check(&self, _: &StepKind, _: Option<&TaskId>) -> Checked {
        self.lock().checked
    }
    fn self_test(&mut self, _: SiteTime) -> Result<(), Fault> {
        self.lock().broken.clone().map_or(Ok(()), Err)
    }
    fn hardware_stop(&self) -> HardwareStop {
        self.lock().hardware_stop
    }
    fn mode(&self) -> Mode {
        self.lock().mode
    }
    fn stands_on(&self) -> Vec<WaypointId> {
        Vec::new()
    }
}
