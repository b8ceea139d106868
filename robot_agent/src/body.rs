//! What a machine must offer so that the agent can drive it: the whole of `trait Body`, for makers to implement.
//!
//! A vendor SDK, a ROS 2 node or a simulator stands behind it; `examples/own_robot.rs` is one in 60 lines,
//! docs/make-a-robot.md leads there. Every call returns at once. The agent polls; a body never calls back, never blocks
//! and never reads a clock of its own: `now` is the site clock. Invariant: the agent never asks for more than `limits`
//! allow, and a body may always do less.

pub use midshift_core::ids::{TaskId, WaypointId};
pub use midshift_core::robot::{Fault, HardwareStop, Inventory, Load, Mode, Pose, StopLevel};
pub use midshift_core::step::StepKind;
pub use midshift_core::time::{SiteDuration, SiteTime};

/// What the maker allows, whatever anybody asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BodyLimits {
    /// Millimetres per second.
    pub speed_mm_s: u32,
    /// Below this the governor never goes: a body that cannot move at all cannot clear a lane. Millimetres per second.
    pub floor_speed_mm_s: u32,
    /// State of charge at which the body says critical, permille.
    pub battery_critical_permille: u16,
}

/// One point of a path to drive.
#[derive(Clone, Debug, PartialEq)]
pub struct PathPoint {
    /// Its waypoint.
    pub waypoint: WaypointId,
    /// Millimetres in the site's frame.
    pub x_mm: i32,
    /// Millimetres in the site's frame.
    pub y_mm: i32,
    /// Speed on the way to this point, millimetres per second: already the lowest of all layers.
    pub speed_mm_s: u32,
    /// Distance to keep from people and things on the way to this point, millimetres. None: the body's own. A body that
    /// cannot measure distances drives as it does.
    pub keep_off_mm: Option<u32>,
}

impl PathPoint {
    /// Moves `pose` straight to this point for so long, no faster than asked; true: it is there. For bodies that are
    /// only pretended.
    pub fn approach(&self, pose: &mut Pose, duration: SiteDuration) -> bool {
        let (dx, dy) = (f64::from(self.x_mm - pose.x_mm), f64::from(self.y_mm - pose.y_mm));
        let (left_mm, may_mm) = (dx.hypot(dy), f64::from(self.speed_mm_s) * duration.as_ms() as f64 / 1_000.0);
        let is_there = left_mm <= may_mm;
        let share = if is_there { 1.0 } else { may_mm / left_mm };
        pose.x_mm += (share * dx).round() as i32;
        pose.y_mm += (share * dy).round() as i32;
        is_there
    }
}

/// One order to the body.
#[derive(Clone, Debug, PartialEq)]
pub enum BodyOrder {
    /// Drive along these points and stand at the last. A new path that begins with what is left of the old one extends
    /// it without a stop; the body goes on from where it is.
    Drive(Vec<PathPoint>),
    /// Do this action, or stand for this wait, where it is. Never a goto.
    Act(StepKind),
}

/// What came of it since the last poll, in order.
#[derive(Clone, Debug, PartialEq)]
pub enum BodyNews {
    /// The body reached this waypoint of its path (drives through it or stands on it).
    Reached(WaypointId),
    /// The order is done.
    Done,
    /// The order ended by a fault; the body stands.
    Failed(Fault),
    /// Who drives changed.
    Mode(Mode),
    /// The maker's safety system changed.
    HardwareStop(HardwareStop),
    /// What it carries changed.
    Load(Option<Load>),
    /// A standing fault began (`true`) or ended.
    Fault(Fault, bool),
}

/// Whether a step was done, as far as the body can tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Checked {
    /// It was.
    Done,
    /// It was not.
    NotDone,
    /// The body cannot tell.
    Unknown,
}

/// Readings that change all the time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BodyState {
    /// Where it is.
    pub pose: Pose,
    /// Last waypoint reached or stood on; none until it knows.
    pub waypoint: Option<WaypointId>,
    /// Millimetres per second.
    pub speed_mm_s: u32,
    /// State of charge, permille.
    pub battery_permille: u16,
    /// Energy flows in.
    pub charging: bool,
    /// Tenths of a degree Celsius, hottest joint.
    pub hottest_joint_decidegrees: i32,
    /// Millimetres since the body was made; with a load, `loaded_odometer_mm` of them.
    pub odometer_mm: u64,
    /// Millimetres driven with a load.
    pub loaded_odometer_mm: u64,
    /// Milliwatt-hours spent since the body was made.
    pub energy_mwh: u64,
    /// The maker's protective field is violated.
    pub field_violation: bool,
}

/// A machine that can be driven.
pub trait Body: Send {
    /// Actions it can do (`pick`, `place`, …), labels, payload, versions.
    fn capabilities(&self) -> Inventory;
    /// What the maker allows.
    fn limits(&self) -> BodyLimits;
    /// Whose work the orders after this call are: the task and the index of its step; none for an errand or none. Said
    /// before [`Body::start`], so that the body's own records and its [`Load`] can name the task. A body that keeps no
    /// records ignores it.
    fn work_for(&mut self, _task_id: Option<&TaskId>, _step_index: u32) {}
    /// Begins an order. An error is a fault that was clear at once (unknown action); the body stands.
    fn start(&mut self, now: SiteTime, order: BodyOrder) -> Result<(), Fault>;
    /// Stands still and keeps its order.
    fn pause(&mut self, now: SiteTime);
    /// Goes on after a pause.
    fn resume(&mut self, now: SiteTime);
    /// Brings it to this level of operational stop and drops its order, except for [`StopLevel::Slow`].
    fn stop(&mut self, now: SiteTime, level: StopLevel);
    /// The level of operational stop that the robot obeys from now on; told whenever it changes. What follows of it for
    /// its orders the agent says by [`Body::pause`], [`Body::stop`] and the speeds of its path; a body that has more to
    /// slow down or to show does that here.
    fn obeys(&mut self, _now: SiteTime, _level: StopLevel) {}
    /// It stands and will not move by itself. By default: nothing will change.
    fn standstill(&self, now: SiteTime) -> bool {
        self.next_change(now).is_none()
    }
    /// Takes the posture in which it may stand for long. A body that may always stand as it stands does nothing.
    fn park(&mut self, _now: SiteTime) {}
    /// Starts or stops charging; only called while it stands at a charger. A body that charges by itself there does
    /// nothing.
    fn charge(&mut self, _now: SiteTime, _on: bool) {}
    /// What happened since the last call, in order. Called after every other call and at `next_change`.
    fn poll(&mut self, now: SiteTime) -> Vec<BodyNews>;
    /// When the next news will come if nobody asks for anything else; none: not before it is asked for something.
    fn next_change(&self, now: SiteTime) -> Option<SiteTime>;
    /// Readings at this moment.
    fn state(&self, now: SiteTime) -> BodyState;
    /// What it carries.
    fn load(&self) -> Option<Load>;
    /// A person has looked: it carries nothing. Asked only of a body whose [`Inventory`] says that it knows its load by
    /// memory alone. From then on [`Body::load`] is none, and its next news says so. A body that feels what it carries
    /// ignores it.
    fn forget_load(&mut self, _now: SiteTime) {}
    /// Whether a step that may have been under way at a restart was done. `task_id` names whose step it was. A body
    /// that cannot tell leaves it to people.
    fn check(&self, _step: &StepKind, _task_id: Option<&TaskId>) -> Checked {
        Checked::Unknown
    }
    /// The maker's own test, asked for once when the agent starts and the body stands; an error says what is broken.
    /// Until the body says that this fault is over ([`BodyNews::Fault`]) the robot accepts no work. A body without a
    /// test has nothing to say.
    fn self_test(&mut self, _now: SiteTime) -> Result<(), Fault> {
        Ok(())
    }
    /// State of the maker's own safety system. A body that cannot see it says that nothing is engaged.
    fn hardware_stop(&self) -> HardwareStop {
        HardwareStop::None
    }
    /// Who drives. A body without a manual mode is always automatic.
    fn mode(&self) -> Mode {
        Mode::Automatic
    }
    /// Version of the site's map that it drives by; empty: it goes by the points of its orders alone.
    fn map_version(&self) -> String {
        String::new()
    }
    /// Waypoints it stands on or reaches into now, as far as it knows, e.g. after a restart. None between two.
    fn stands_on(&self) -> Vec<WaypointId>;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pretended_body_comes_to_its_point_in_the_time_that_the_way_takes() {
        let waypoint = WaypointId::parse("a").expect("a name");
        let point = PathPoint { waypoint, x_mm: 300, y_mm: -400, speed_mm_s: 1_000, keep_off_mm: None };
        let mut pose = Pose::default();
        assert!(!point.approach(&mut pose, SiteDuration(250)));
        assert_eq!((pose.x_mm, pose.y_mm), (150, -200));
        assert!(!point.approach(&mut pose, SiteDuration(0)), "no time, no way");
        assert!(point.approach(&mut pose, SiteDuration(1_000)));
        assert_eq!((pose.x_mm, pose.y_mm), (300, -400));
        assert!(point.approach(&mut pose, SiteDuration(0)), "it is there already");
    }
}
