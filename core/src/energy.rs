//! What work costs a robot's battery: one model, by which the planner filters and the simulated body empties its battery.
//!
//! Of a robot whose attempts say more, its own rates take the place of the model's: [`fit`] finds them.
//! Invariant: what [`Trip`] adds up by the model is never less than what a simulated body spends on the same legs and steps, unless it waits
//! on the way; for waits the planner keeps a reserve. A test over seeded trips holds it.

pub mod fit;

use crate::limits::STOP_SLOW_MM_S;
use crate::step::StepKind;
use crate::time::SiteDuration;

/// What the battery holds when full, milliwatt-hours.
pub const CAPACITY_MWH: f64 = 1_200_000.0;
/// Standing, watts.
pub const IDLE_W: f64 = 80.0;
/// Driving, on top of standing, milliwatt-hours per metre.
pub const DRIVE_MWH_PER_M: f64 = 120.0;
/// How much more a metre costs with a load.
pub const LOADED_FACTOR: f64 = 1.3;
/// Acting, on top of standing, watts: about half a watt-hour for a pick.
pub const ACT_W: f64 = 450.0;
/// A pick or a place takes about so long.
pub const HANDLE: SiteDuration = SiteDuration::from_secs(4);
/// An inspection takes about so long.
pub const INSPECT: SiteDuration = SiteDuration::from_secs(3);
/// An action takes so much longer or shorter than usual at most, thousandths.
pub const ACTION_VARIES_PERMILLE: u64 = 200;

/// What is planned on top of the rates, thousandths: turns on the spot, a way around a closed place, a pick that is tried twice.
const MARGIN_PERMILLE: u64 = 100;
/// The error of a robot's own rates adds no more than this to the margin, thousandths.
const ERROR_MARGIN_MAX_PERMILLE: u64 = 300;
/// Rates by which a robot is sent somewhere, thousandths of the model's: one that counts its motors alone would not come home, and one
/// that counts too much would never be sent.
const PLANNED_PERMILLE: std::ops::RangeInclusive<u32> = 700..=2_000;
/// Nanowatt-hours of a milliwatt-hour.
const NWH_PER_MWH: u64 = 1_000_000;

/// What the parts of a robot's work cost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EnergyRates {
    /// Driving without a load, on top of standing, milliwatt-hours per kilometre.
    pub empty_mwh_per_km: u32,
    /// Driving with a load, on top of standing, milliwatt-hours per kilometre.
    pub loaded_mwh_per_km: u32,
    /// Standing, milliwatts.
    pub idle_mw: u32,
    /// An action, on top of standing, milliwatt-hours.
    pub action_mwh: u32,
}

impl EnergyRates {
    /// Those of the model.
    pub const MODEL: Self = Self {
        empty_mwh_per_km: (DRIVE_MWH_PER_M * 1_000.0 + 0.5) as u32,
        loaded_mwh_per_km: (DRIVE_MWH_PER_M * LOADED_FACTOR * 1_000.0 + 0.5) as u32,
        idle_mw: (IDLE_W * 1_000.0 + 0.5) as u32,
        action_mwh: (ACT_W * HANDLE.as_ms() as f64 / 3_600.0 + 0.5) as u32,
    };

    /// As far as they are believed where a robot is sent somewhere: it must come home, and must not starve.
    fn planned(&self) -> Self {
        let within = |own: u32, by_model: u32| {
            let times = |permille: u32| (u64::from(by_model) * u64::from(permille) / 1_000) as u32;
            own.clamp(times(*PLANNED_PERMILLE.start()), times(*PLANNED_PERMILLE.end()))
        };
        Self {
            empty_mwh_per_km: within(self.empty_mwh_per_km, Self::MODEL.empty_mwh_per_km),
            loaded_mwh_per_km: within(self.loaded_mwh_per_km, Self::MODEL.loaded_mwh_per_km),
            idle_mw: within(self.idle_mw, Self::MODEL.idle_mw),
            action_mwh: within(self.action_mwh, Self::MODEL.action_mwh),
        }
    }
    /// Nanowatt-hours of so many millimetres without a load, or with one, without the time that they take.
    fn drive_nwh(&self, mm: u64, is_loaded: bool) -> u64 {
        mm.saturating_mul(u64::from(if is_loaded { self.loaded_mwh_per_km } else { self.empty_mwh_per_km }))
    }
    /// Nanowatt-hours of so many milliseconds, rounded up.
    fn stand_nwh(&self, ms: u64) -> u64 {
        ms.saturating_mul(u64::from(self.idle_mw) * 5).div_ceil(18)
    }
}

/// What one robot's work costs, as far as that is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RobotEnergy {
    /// By which its work is planned.
    pub rates: EnergyRates,
    /// How far its attempts lie from these rates: the root of the mean square, thousandths of what an attempt takes on average. None: its
    /// attempts are too few, and the rates are the model's.
    pub error_permille: Option<u32>,
    /// Attempts that were counted for it.
    pub attempts: u64,
}

impl RobotEnergy {
    /// Of a robot of which nothing is known.
    pub const MODEL: Self = Self { rates: EnergyRates::MODEL, error_permille: None, attempts: 0 };

    /// Milliwatt-hours that this robot takes more for a way without a load than a robot by the model: less than 0 if it takes less. A
    /// difference within the error of its rates is none.
    pub fn beyond_model_mwh(&self, way_mm: u64, way_ms: u64) -> i64 {
        let Some(error_permille) = self.error_permille else { return 0 };
        let way_mwh = |rates: &EnergyRates| {
            let nwh = rates.drive_nwh(way_mm, false).saturating_add(rates.stand_nwh(way_ms));
            i64::try_from(nwh / NWH_PER_MWH).unwrap_or(i64::MAX)
        };
        let (own, usual) = (way_mwh(&self.rates), way_mwh(&EnergyRates::MODEL));
        let within = usual.saturating_mul(error_permille.into()) / 1_000;
        let beyond = own.saturating_sub(usual);
        beyond.signum() * (beyond.abs() - within).max(0)
    }
    fn margin_permille(&self) -> u64 {
        MARGIN_PERMILLE + u64::from(self.error_permille.unwrap_or(0)).min(ERROR_MARGIN_MAX_PERMILLE)
    }
}

/// What one trip costs, added up leg by leg.
#[derive(Clone, Copy, Debug)]
pub struct Trip {
    rates: EnergyRates,
    margin_permille: u64,
    spent_nwh: u64,
    is_loaded: bool,
    /// Slower than this nothing but a task's own limit makes a robot drive.
    speed_mm_s: u32,
}

impl Trip {
    /// Of a robot that carries something or not, in a task with this speed limit.
    pub fn new(robot: &RobotEnergy, is_loaded: bool, speed_limit_mm_s: Option<u32>) -> Self {
        let speed_mm_s = speed_limit_mm_s.unwrap_or(STOP_SLOW_MM_S).clamp(1, STOP_SLOW_MM_S);
        Self {
            rates: robot.rates.planned(),
            margin_permille: robot.margin_permille(),
            spent_nwh: 0,
            is_loaded,
            speed_mm_s,
        }
    }
    /// Drives so many millimetres, as slowly as a robot may have to.
    pub fn drive(&mut self, mm: u64) {
        self.spend(self.rates.drive_nwh(mm, self.is_loaded));
        self.stand(mm.saturating_mul(1_000) / u64::from(self.speed_mm_s));
    }
    /// Does a step where it stands. A goto is driven by [`Trip::drive`].
    pub fn act(&mut self, step: &StepKind) {
        match step {
            StepKind::Goto { .. } => {}
            StepKind::Wait { duration_ms } => self.stand(*duration_ms),
            StepKind::Action { name, .. } => {
                let most = |usual: u64| usual + usual * ACTION_VARIES_PERMILLE / 1_000;
                self.spend(most(u64::from(self.rates.action_mwh) * NWH_PER_MWH));
                self.stand(most(HANDLE.max(INSPECT).as_ms()));
                self.is_loaded = name == "pick" || (self.is_loaded && name != "place");
            }
        }
    }
    fn stand(&mut self, ms: u64) {
        self.spend(self.rates.stand_nwh(ms));
    }
    fn spend(&mut self, nwh: u64) {
        self.spent_nwh = self.spent_nwh.saturating_add(nwh);
    }
    /// Milliwatt-hours of all of it with the margin, rounded up.
    pub fn needed_mwh(&self) -> u64 {
        self.spent_nwh.saturating_mul(1_000 + self.margin_permille).div_ceil(1_000 * NWH_PER_MWH)
    }
    /// As [`Trip::needed_mwh`], as charge of a full battery, permille, rounded up.
    pub fn needed_permille(&self) -> u64 {
        (self.needed_mwh() * 1_000).div_ceil(CAPACITY_MWH as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn action(name: &str) -> StepKind {
        StepKind::Action { name: name.to_owned(), params: serde_json::Map::new() }
    }

    #[test]
    fn a_load_an_action_a_wait_and_a_speed_limit_each_cost_more() {
        let cost = |steps: &[StepKind], limit: Option<u32>| {
            let mut trip = Trip::new(&RobotEnergy::MODEL, false, limit);
            steps.iter().for_each(|step| trip.act(step));
            trip.drive(100_000);
            trip.needed_mwh()
        };
        let empty = cost(&[], None);
        assert_eq!(empty, 21_349, "100 m at 120 mWh, 333 s at 80 W, and a tenth");
        let stands = StepKind::Wait { duration_ms: 20_000 };
        assert!(cost(&[action("inspect")], None) > cost(&[stands], None), "some four seconds of work");
        assert!(cost(&[action("pick")], None) > cost(&[action("inspect")], None) + 3_000);
        assert_eq!(cost(&[action("pick"), action("place")], None), cost(&[action("inspect"), action("inspect")], None));
        assert!(cost(&[StepKind::Wait { duration_ms: 60_000 }], None) > empty + 1_000);
        assert!(cost(&[], Some(100)) > empty + 4_000);
        assert_eq!(cost(&[], Some(1_500)), empty);
    }

    #[test]
    fn a_robot_with_rates_of_its_own_is_planned_by_them_with_their_error_on_top() {
        let trip = |robot: &RobotEnergy| {
            let mut trip = Trip::new(robot, false, None);
            trip.drive(100_000);
            trip.act(&action("pick"));
            trip.drive(100_000);
            trip.needed_mwh()
        };
        let EnergyRates { empty_mwh_per_km, loaded_mwh_per_km, idle_mw, action_mwh } = EnergyRates::MODEL;
        assert_eq!((empty_mwh_per_km, loaded_mwh_per_km, idle_mw, action_mwh), (120_000, 156_000, 80_000, 500));
        let rates = EnergyRates {
            empty_mwh_per_km: 2 * empty_mwh_per_km,
            loaded_mwh_per_km: 2 * loaded_mwh_per_km,
            idle_mw: 2 * idle_mw,
            action_mwh: 2 * action_mwh,
        };
        let double = RobotEnergy { rates, error_permille: Some(0), attempts: 30 };
        let usual = trip(&RobotEnergy::MODEL);
        assert!((2 * usual - 2..=2 * usual).contains(&trip(&double)), "twice {usual}, rounded once: {}", trip(&double));
        let quarter =
            EnergyRates { empty_mwh_per_km: empty_mwh_per_km / 4, idle_mw: idle_mw / 4, ..EnergyRates::MODEL };
        let low = trip(&RobotEnergy { rates: quarter, error_permille: Some(0), attempts: 30 });
        assert!(low > usual * 7 / 10, "who says too little is believed so far only: {low} beside {usual}");
        let four = EnergyRates { empty_mwh_per_km: 4 * empty_mwh_per_km, ..rates };
        assert_eq!(trip(&RobotEnergy { rates: four, ..double }), trip(&double), "and who says too much");
        let erring = |permille| trip(&RobotEnergy { error_permille: Some(permille), ..double });
        assert_eq!(erring(200) / 100, trip(&double) * 13 / 11 / 100, "the margin is three tenths, not one");
        assert_eq!(erring(u32::MAX), erring(300), "whatever its error, the margin has an end");
    }

    #[test]
    fn a_way_costs_more_or_less_than_usual_only_beyond_the_error_of_a_robots_rates() {
        let of = |permille: u32, error_permille| {
            let rates = EnergyRates {
                empty_mwh_per_km: EnergyRates::MODEL.empty_mwh_per_km * permille / 1_000,
                idle_mw: EnergyRates::MODEL.idle_mw * permille / 1_000,
                ..EnergyRates::MODEL
            };
            RobotEnergy { rates, error_permille, attempts: 30 }.beyond_model_mwh(100_000, 90_000)
        };
        assert_eq!(of(2_000, Some(0)), 14_000, "100 m at 120 mWh and 90 s at 80 W");
        assert_eq!(of(500, Some(0)), -7_000);
        assert_eq!((of(1_040, Some(50)), of(960, Some(50))), (0, 0));
        assert_eq!((of(1_100, Some(50)), of(900, Some(50))), (700, -700));
        assert_eq!(of(2_000, None), 0, "the model's figures are nobody's");
        assert_eq!(
            RobotEnergy { error_permille: Some(0), ..RobotEnergy::MODEL }.beyond_model_mwh(u64::MAX, u64::MAX),
            0
        );
    }
}
