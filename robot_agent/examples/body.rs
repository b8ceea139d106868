//! A body that does nothing but say what it would do: the shape of an adapter to a vendor's SDK.
//!
//! `cargo run -p midshift-agent --example body`
//!
//! Replace each `say` by a call of your machine that returns at once, and turn what the machine answers later into
//! `BodyNews`. The agent calls; the body never calls back and never waits.

use midshift_agent::body::{Body, BodyLimits, BodyNews, BodyOrder, BodyState, Checked};
use midshift_core::ids::{TaskId, WaypointId};
use midshift_core::robot::{Fault, HardwareStop, Inventory, Load, Mode, Pose, StopLevel};
use midshift_core::time::SiteTime;
use midshift_core::work::StepKind;
use std::io::Write;

#[derive(Default)]
struct Talker {
    pose: Pose,
    waypoint: Option<WaypointId>,
    charging: bool,
    news: Vec<BodyNews>,
}

impl Body for Talker {
    fn capabilities(&self) -> Inventory {
        Inventory { capabilities: vec!["pick".into(), "place".into()], model: "talker".into(), ..Inventory::default() }
    }
    fn limits(&self) -> BodyLimits {
        BodyLimits { speed_mm_s: 1_000, floor_speed_mm_s: 50, battery_critical_permille: 100 }
    }
    /// Begins and returns. What comes of it is told by `poll`; here everything is done at once.
    fn start(&mut self, _now: SiteTime, order: BodyOrder) -> Result<(), Fault> {
        match order {
            BodyOrder::Drive(path) => {
                for point in path {
                    say(&format!("drive to {} at {} mm/s", point.waypoint, point.speed_mm_s));
                    self.pose = Pose { x_mm: point.x_mm, y_mm: point.y_mm, theta_mrad: 0 };
                    self.waypoint = Some(point.waypoint.clone());
                    self.news.push(BodyNews::Reached(point.waypoint));
                }
            }
            BodyOrder::Act(what) => say(&format!("do {what:?}")),
        }
        self.news.push(BodyNews::Done);
        Ok(())
    }
    fn pause(&mut self, _now: SiteTime) {
        say("stand still and keep the order");
    }
    fn resume(&mut self, _now: SiteTime) {
        say("go on");
    }
    fn stop(&mut self, _now: SiteTime, level: StopLevel) {
        say(&format!("stop: {level:?}"));
    }
    fn standstill(&self, _now: SiteTime) -> bool {
        true
    }
    fn park(&mut self, _now: SiteTime) {
        say("take the posture for standing long");
    }
    fn charge(&mut self, _now: SiteTime, on: bool) {
        say(if on { "charge" } else { "end charging" });
        self.charging = on;
    }
    fn poll(&mut self, _now: SiteTime) -> Vec<BodyNews> {
        std::mem::take(&mut self.news)
    }
    /// When the next news will come by itself, so that the agent sleeps until then.
    fn next_change(&self, now: SiteTime) -> Option<SiteTime> {
        (!self.news.is_empty()).then_some(now)
    }
    fn state(&self, _now: SiteTime) -> BodyState {
        BodyState {
            pose: self.pose,
            waypoint: self.waypoint.clone(),
            speed_mm_s: 0,
            battery_permille: 800,
            charging: self.charging,
            hottest_joint_decidegrees: 350,
            odometer_mm: 0,
            loaded_odometer_mm: 0,
            energy_mwh: 0,
            field_violation: false,
        }
    }
    fn load(&self) -> Option<Load> {
        None
    }
    /// After a restart: was this step done? Look with a sensor; if there is none, nobody knows.
    fn check(&self, _step: &StepKind, _task_id: Option<&TaskId>) -> Checked {
        Checked::Unknown
    }
    fn self_test(&mut self, _now: SiteTime) -> Result<(), Fault> {
        Ok(())
    }
    fn hardware_stop(&self) -> HardwareStop {
        HardwareStop::None
    }
    fn mode(&self) -> Mode {
        Mode::Automatic
    }
    fn stands_on(&self) -> Vec<WaypointId> {
        self.waypoint.clone().into_iter().collect()
    }
}

fn say(what: &str) {
    // Nobody to tell is no reason for a robot to stop.
    let _ = writeln!(std::io::stdout().lock(), "{what}");
}

fn main() {
    let mut body = Talker::default();
    let now = SiteTime(0);
    let wait = StepKind::Wait { duration_ms: 1_000 };
    let begun = body.start(now, BodyOrder::Act(wait));
    say(&format!("begun: {begun:?}, then {:?}", body.poll(now)));
}
