//! What work costs a robot's battery: one model, by which the planner filters and the simulated body empties its battery.
//!
//! Invariant: what [`Trip`] adds up is never less than what a simulated body spends on the same legs and steps, unless it waits on the way;
//! for waits the planner keeps a reserve. A test over seeded trips holds it.

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

/// What is planned on top of the model, thousandths: turns on the spot, a way around a closed place, a pick that is tried twice.
const MARGIN_PERMILLE: u64 = 100;

/// What one trip costs, added up leg by leg.
#[derive(Clone, Copy, Debug)]
pub struct Trip {
    spent_mwh: f64,
    is_loaded: bool,
    /// Slower than this nothing but a task's own limit makes a robot drive.
    speed_mm_s: u32,
}

impl Trip {
    /// Of a robot that carries something or not, in a task with this speed limit.
    pub fn new(is_loaded: bool, speed_limit_mm_s: Option<u32>) -> Self {
        let speed_mm_s = speed_limit_mm_s.unwrap_or(STOP_SLOW_MM_S).clamp(1, STOP_SLOW_MM_S);
        Self { spent_mwh: 0.0, is_loaded, speed_mm_s }
    }
    /// Drives so many millimetres, as slowly as a robot may have to.
    pub fn drive(&mut self, mm: u64) {
        let factor = if self.is_loaded { LOADED_FACTOR } else { 1.0 };
        self.spent_mwh += mm as f64 / 1_000.0 * DRIVE_MWH_PER_M * factor;
        self.stand(SiteDuration(mm * 1_000 / u64::from(self.speed_mm_s)));
    }
    /// Does a step where it stands. A goto is driven by [`Trip::drive`].
    pub fn act(&mut self, step: &StepKind) {
        match step {
            StepKind::Goto { .. } => {}
            StepKind::Wait { duration_ms } => self.stand(SiteDuration(*duration_ms)),
            StepKind::Action { name, .. } => {
                let usual_ms = HANDLE.max(INSPECT).as_ms();
                let most = SiteDuration(usual_ms + usual_ms * ACTION_VARIES_PERMILLE / 1_000);
                self.spent_mwh += ACT_W * 1_000.0 * hours(most);
                self.stand(most);
                self.is_loaded = name == "pick" || (self.is_loaded && name != "place");
            }
        }
    }
    fn stand(&mut self, time: SiteDuration) {
        self.spent_mwh += IDLE_W * 1_000.0 * hours(time);
    }
    /// Milliwatt-hours of all of it with the margin, rounded up.
    pub fn needed_mwh(&self) -> u64 {
        (self.spent_mwh * (1_000 + MARGIN_PERMILLE) as f64 / 1_000.0).ceil() as u64
    }
    /// As [`Trip::needed_mwh`], as charge of a full battery, permille, rounded up.
    pub fn needed_permille(&self) -> u64 {
        (self.needed_mwh() * 1_000).div_ceil(CAPACITY_MWH as u64)
    }
}

fn hours(time: SiteDuration) -> f64 {
    time.as_secs_f64() / 3_600.0
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
            let mut trip = Trip::new(false, limit);
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
}
