//! What goes wrong, how often, and what it is called. Drawn from a body's own seeded generator.
//!
//! Called by [`crate::body`]; a person or a test asks for one with [`Injected`].

use midshift_core::robot::{FAULT_GRIPPER_MISSED, FAULT_JAM, FAULT_OBSTACLE, FAULT_SEMANTIC, Fault, FaultClass};
use midshift_core::time::{SiteDuration, SiteTime};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// The battery is empty; the body stands until a person changes it.
pub const FAULT_BATTERY_EMPTY: u32 = 2002;
/// Something is to be put down and nothing is carried.
pub const FAULT_LOAD_LOST: u32 = 2003;
/// A person drives.
pub const FAULT_MANUAL: u32 = 3001;

/// How often things go wrong. All rates are of site time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FaultRates {
    /// Obstacles in the way per kilometre. One in three stays for longer than the body waits.
    pub obstacle_per_km: f64,
    /// Share of picks that close on nothing, 0..=1.
    pub gripper_per_pick: f64,
    /// Share of actions that end in a jam, 0..=1.
    pub jam_per_action: f64,
    /// Losses of the network per hour.
    pub silence_per_hour: f64,
    /// Times per hour that a person takes over.
    pub manual_per_hour: f64,
}

impl Default for FaultRates {
    /// About 1 obstacle in 2 km, 1 % of picks missed, 1 task in 300 jammed, a short silence every second hour.
    fn default() -> Self {
        Self {
            obstacle_per_km: 0.5,
            gripper_per_pick: 0.01,
            jam_per_action: 0.0015,
            silence_per_hour: 0.5,
            manual_per_hour: 0.0,
        }
    }
}

impl FaultRates {
    /// Nothing ever goes wrong by itself.
    pub const fn none() -> Self {
        Self {
            obstacle_per_km: 0.0,
            gripper_per_pick: 0.0,
            jam_per_action: 0.0,
            silence_per_hour: 0.0,
            manual_per_hour: 0.0,
        }
    }
    /// Of a body that works `pace` times as fast as real by a real clock: what comes with its work goes wrong as often
    /// in a minute as at its own pace. What comes with time does anyway.
    #[must_use]
    pub fn paced(&self, pace: f64) -> Self {
        let Self { silence_per_hour, manual_per_hour, .. } = *self;
        Self { silence_per_hour, manual_per_hour, ..self.times(1.0 / pace.max(1.0)) }
    }
    /// All rates times `factor`, shares at most 1.
    pub fn times(&self, factor: f64) -> Self {
        Self {
            obstacle_per_km: self.obstacle_per_km * factor,
            gripper_per_pick: (self.gripper_per_pick * factor).min(1.0),
            jam_per_action: (self.jam_per_action * factor).min(1.0),
            silence_per_hour: self.silence_per_hour * factor,
            manual_per_hour: self.manual_per_hour * factor,
        }
    }
}

/// Something made to go wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Injected {
    /// Something stands in the way for this long, from now on if it drives, else on its next leg.
    Obstacle(SiteDuration),
    /// The next picks, this many, close on nothing.
    GripperMissed(u32),
    /// A jam, now.
    Jam,
    /// No network for this long: the agent goes on, and nothing it says is heard.
    DropNetwork(SiteDuration),
    /// No way to the stop service for this long: everything else goes on.
    DropStopLine(SiteDuration),
    /// A person drives for this long.
    Manual(SiteDuration),
    /// The maker's own safety system stops it for this long and ends that by itself.
    HardwareStop(SiteDuration),
    /// The state of charge falls to this, permille.
    LowBattery(u16),
}

/// A body waits this long for an obstacle to go away before it gives up.
pub const OBSTACLE_PATIENCE: SiteDuration = SiteDuration::from_secs(10);

fn fault(code: u32, class: FaultClass, message: &str) -> Fault {
    Fault { code, class, message: message.to_owned() }
}

/// 1001: something stood in the way for too long.
pub fn obstacle() -> Fault {
    fault(FAULT_OBSTACLE, FaultClass::Recoverable, "an obstacle stood in the way for too long")
}
/// 1002: a pick closed on nothing.
pub fn gripper_missed() -> Fault {
    fault(FAULT_GRIPPER_MISSED, FaultClass::Recoverable, "the gripper closed on nothing")
}
/// 2001: a person must free a joint.
pub fn jam() -> Fault {
    fault(FAULT_JAM, FaultClass::Mechanical, "a joint is jammed")
}
/// 2002: a person must bring it to a charger.
pub fn battery_empty() -> Fault {
    fault(FAULT_BATTERY_EMPTY, FaultClass::Mechanical, "the battery is empty")
}
/// 2003: a drop found nothing in the gripper.
pub fn load_lost() -> Fault {
    fault(FAULT_LOAD_LOST, FaultClass::Mechanical, "nothing is carried that could be put down")
}
/// 3001: the agent may not drive now.
pub fn manual() -> Fault {
    fault(FAULT_MANUAL, FaultClass::Stop, "a person drives")
}
/// 4001: the step makes no sense for this body.
pub fn semantic(message: &str) -> Fault {
    fault(FAULT_SEMANTIC, FaultClass::Semantic, message)
}

/// Milliseconds drawn evenly from a range of seconds.
pub(crate) fn draw_secs(rng: &mut ChaCha8Rng, secs: std::ops::RangeInclusive<u64>) -> SiteDuration {
    SiteDuration(rng.random_range(secs.start() * 1000..=secs.end() * 1000))
}

/// The next event of a Poisson process after `now`; never if its rate is zero.
pub(crate) fn draw_next(rng: &mut ChaCha8Rng, now: SiteTime, per_hour: f64) -> Option<SiteTime> {
    (per_hour > 0.0).then(|| {
        let hours = -(1.0 - rng.random::<f64>()).ln() / per_hour;
        now + SiteDuration((hours * 3_600_000.0) as u64 + 1)
    })
}
