//! What one body is like, and what it did and suffered.

use crate::behaviour::Behaviour;
use crate::energy::EnergyScale;
use crate::faults::FaultRates;
use midshift_core::ids::{RobotId, WaypointId};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// The hardware model of a simulated robot, as bundles name it.
pub const MODEL: &str = "midshift-sim";
/// The fastest a simulated body goes, millimetres per second.
pub const SPEED_MAX_MM_S: u32 = 1_500;
/// Key and value of the label by which a simulated robot says what it is.
pub const BODY_LABEL: (&str, &str) = ("body", "simulated");
/// The slowest it is asked to go, millimetres per second; also its speed at the stop level SLOW.
pub const SPEED_FLOOR_MM_S: u32 = 300;

/// What one body is like.
#[derive(Clone, Debug)]
pub struct BodyConfig {
    /// Its name.
    pub robot_id: RobotId,
    /// Decides all that is drawn, together with its name.
    pub seed: u64,
    /// Where it stands when it is made.
    pub start: WaypointId,
    /// What the maker allows, millimetres per second; at most [`SPEED_MAX_MM_S`].
    pub speed_mm_s: u32,
    /// How fast it really goes of what it is asked for, thousandths, 100..=1000.
    pub pace_permille: u32,
    /// Turning on the spot takes time; else it faces its way at once.
    pub turns: bool,
    /// How often things go wrong.
    pub faults: FaultRates,
    /// State of charge when it is made; none: 600..=1000, drawn.
    pub battery_permille: Option<u16>,
    /// The battery empties by work.
    pub drains: bool,
    /// How fast it does, and how fast a charger fills it.
    pub energy: EnergyScale,
    /// What its software makes of it.
    pub behaviour: Behaviour,
    /// Version of its software as it says it.
    pub software: String,
}

impl BodyConfig {
    /// A body at its best, with the default faults.
    pub fn new(robot_id: RobotId, seed: u64, start: WaypointId) -> Self {
        Self {
            robot_id,
            seed,
            start,
            speed_mm_s: SPEED_MAX_MM_S,
            pace_permille: 1000,
            turns: true,
            faults: FaultRates::default(),
            battery_permille: None,
            drains: true,
            energy: EnergyScale::default(),
            behaviour: Behaviour::default(),
            software: "1.0.0".to_owned(),
        }
    }
    pub(super) fn rng(&self, life: u32) -> ChaCha8Rng {
        let name = self
            .robot_id
            .as_str()
            .bytes()
            .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
        ChaCha8Rng::seed_from_u64(self.seed ^ name.rotate_left(life % 64))
    }
}

/// What a body did and suffered since this process made it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Milliseconds driving, turning or braking.
    pub driving_ms: u64,
    /// Milliseconds acting or waiting as a step asks.
    pub acting_ms: u64,
    /// Milliseconds standing before an obstacle.
    pub blocked_ms: u64,
    /// Milliseconds standing with an order: paused, broken or driven by a person.
    pub halted_ms: u64,
    /// Milliseconds without an order.
    pub idle_ms: u64,
    /// Obstacles met.
    pub obstacles: u64,
    /// Picks done.
    pub picks: u64,
    /// Places done.
    pub places: u64,
    /// Picks that closed on nothing.
    pub misses: u64,
    /// How often it jammed.
    pub jams: u64,
    /// Losses of the network.
    pub silences: u64,
    /// Times a person took over.
    pub manuals: u64,
}

impl std::ops::AddAssign for Counts {
    fn add_assign(&mut self, other: Self) {
        self.driving_ms += other.driving_ms;
        self.acting_ms += other.acting_ms;
        self.blocked_ms += other.blocked_ms;
        self.halted_ms += other.halted_ms;
        self.idle_ms += other.idle_ms;
        self.obstacles += other.obstacles;
        self.picks += other.picks;
        self.places += other.places;
        self.misses += other.misses;
        self.jams += other.jams;
        self.silences += other.silences;
        self.manuals += other.manuals;
    }
}
