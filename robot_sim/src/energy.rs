//! What work costs a body: its battery and the heat of its joints, in closed form over a stretch of constant work.
//!
//! The figures are those of [`midshift_core::energy`], by which work is given. Called by [`crate::body`]. Invariant:
//! without energy flowing in, the charge never rises.

use midshift_core::energy::{ACT_W, CAPACITY_MWH, DRIVE_MWH_PER_M, IDLE_W, LOADED_FACTOR};
use midshift_core::time::SiteDuration;
use serde::{Deserialize, Serialize};

/// Standing in the parking posture, watts.
const PARKED_W: f64 = 40.0;
/// Into the battery at a charger, watts: from empty to full in 40 minutes.
const CHARGE_W: f64 = CAPACITY_MWH / 1000.0 * 60.0 / 40.0;
/// Air of the hall, degrees Celsius.
const AIR_C: f64 = 24.0;
/// How fast joints warm and cool, seconds.
const JOINT_TAU_S: f64 = 300.0;

/// How the rates of a body's battery differ from the model's.
///
/// The planner filters by the model until it has fitted a robot's own rates: it keeps a tenth of what a trip costs, and
/// a tenth of the battery. A test holds that this covers draws of up to 1,700.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EnergyScale {
    /// Energy taken from the battery, thousandths of the model's.
    pub draw_permille: u32,
    /// Energy that a charger gives, thousandths of the usual.
    pub charge_permille: u32,
}

impl Default for EnergyScale {
    /// The model itself.
    fn default() -> Self {
        Self { draw_permille: 1_000, charge_permille: 1_000 }
    }
}

/// What a body does over a stretch of time, as far as energy is concerned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Effort {
    /// Metres per second on average over the stretch.
    pub speed_m_s: f64,
    /// It carries something.
    pub loaded: bool,
    /// It picks, places or inspects.
    pub acting: bool,
    /// It stands in the parking posture.
    pub parked: bool,
    /// It hangs on a charger.
    pub charging: bool,
    /// What its software and its build make of the energy it needs, thousandths.
    pub draw_permille: u32,
    /// What a charger gives of the usual, thousandths.
    pub charge_permille: u32,
    /// What its software adds to the heat of its hottest joint, degrees Celsius per second.
    pub climb_c_s: f64,
}

impl Default for Effort {
    /// The effort of a robot that stands.
    fn default() -> Self {
        Self {
            speed_m_s: 0.0,
            loaded: false,
            acting: false,
            parked: false,
            charging: false,
            draw_permille: 1000,
            charge_permille: 1000,
            climb_c_s: 0.0,
        }
    }
}

impl Effort {
    /// Watts taken from the battery.
    pub fn draw_w(&self) -> f64 {
        let stand_w = if self.parked { PARKED_W } else { IDLE_W };
        let factor = if self.loaded { LOADED_FACTOR } else { 1.0 };
        let drive_w = self.speed_m_s * DRIVE_MWH_PER_M * factor * 3.6;
        let all_w = stand_w + drive_w + if self.acting { ACT_W } else { 0.0 };
        all_w * (f64::from(self.draw_permille) / 1000.0)
    }
    /// Watts that a charger gives the battery, beside what the body draws meanwhile.
    fn charge_w(&self) -> f64 {
        CHARGE_W * f64::from(self.charge_permille) / 1000.0
    }
    /// Degrees Celsius where the hottest joint would come to rest.
    fn warms_to_c(&self) -> f64 {
        let work_c = if self.acting { 34.0 } else { 18.0 * (self.speed_m_s / 1.5).min(1.0) };
        AIR_C + 4.0 + work_c + if self.loaded { 8.0 } else { 0.0 }
    }
}

/// Battery and joints of one body.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Stores {
    /// Left in the battery.
    pub charge_mwh: f64,
    /// Spent since the body was made.
    pub spent_mwh: f64,
    /// Hottest joint by its work alone, degrees Celsius.
    pub joint_c: f64,
    /// What software has added to that, degrees Celsius.
    #[serde(default)]
    pub climbed_c: f64,
    /// The battery empties by work; without it only `spent_mwh` counts.
    pub drains: bool,
}

impl Stores {
    /// A body at rest with this much charge.
    pub fn new(charge_permille: u16, drains: bool) -> Self {
        let charge_mwh = CAPACITY_MWH * f64::from(charge_permille.min(1000)) / 1000.0;
        Self { charge_mwh, spent_mwh: 0.0, joint_c: AIR_C + 4.0, climbed_c: 0.0, drains }
    }
    /// After `time` of the same effort.
    #[must_use]
    pub fn after(mut self, time: SiteDuration, effort: &Effort) -> Self {
        let hours = time.as_secs_f64() / 3600.0;
        let spent_mwh = effort.draw_w() * 1000.0 * hours;
        self.spent_mwh += spent_mwh;
        if self.drains {
            let in_mwh = if effort.charging { (effort.charge_w() + effort.draw_w()) * 1000.0 * hours } else { 0.0 };
            self.charge_mwh = (self.charge_mwh - spent_mwh + in_mwh).clamp(0.0, CAPACITY_MWH);
        }
        let rest_c = effort.warms_to_c();
        let cools = (-time.as_secs_f64() / JOINT_TAU_S).exp();
        self.joint_c = rest_c + (self.joint_c - rest_c) * cools;
        let climbs = effort.climb_c_s > 0.0;
        self.climbed_c =
            if climbs { self.climbed_c + effort.climb_c_s * time.as_secs_f64() } else { self.climbed_c * cools };
        self
    }
    /// Hottest joint, degrees Celsius.
    pub fn hottest_c(&self) -> f64 {
        self.joint_c + self.climbed_c
    }
    /// How long the charge lasts at this effort; none: for ever.
    pub fn lasts(&self, effort: &Effort) -> Option<SiteDuration> {
        let drains = self.drains && !effort.charging && self.charge_mwh > 0.0;
        drains.then(|| SiteDuration((self.charge_mwh * 3600.0 / effort.draw_w()).ceil() as u64))
    }
    /// State of charge.
    pub fn charge_permille(&self) -> u16 {
        (self.charge_mwh * 1000.0 / CAPACITY_MWH).round() as u16
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_charger_fills_an_empty_battery_in_forty_minutes_and_no_further() {
        let charging = Effort { charging: true, ..Effort::default() };
        let stores = Stores::new(0, true).after(SiteDuration::from_secs(40 * 60), &charging);
        assert_eq!(stores.charge_permille(), 1000);
        assert_eq!(stores.after(SiteDuration::from_secs(600), &charging).charge_permille(), 1000);
        assert!(Stores::new(0, true).after(SiteDuration::from_secs(20 * 60), &charging).charge_permille() == 500);
        let faster = Effort { charge_permille: 2_000, draw_permille: 3_000, ..charging };
        assert_eq!(Stores::new(0, true).after(SiteDuration::from_secs(10 * 60), &faster).charge_permille(), 500);
    }

    #[test]
    fn a_loaded_metre_costs_more_and_joints_warm_with_work_and_cool_at_rest() {
        let drive = Effort { speed_m_s: 1.0, ..Effort::default() };
        assert!(Effort { loaded: true, ..drive }.draw_w() > drive.draw_w());
        let acting = Effort { acting: true, ..Effort::default() };
        let warm = Stores::new(900, true).after(SiteDuration::from_secs(600), &acting);
        let rest = warm.after(SiteDuration::from_secs(600), &Effort::default());
        assert!(warm.joint_c > 50.0 && rest.joint_c < warm.joint_c - 10.0);
    }

    #[test]
    fn the_charge_lasts_exactly_until_it_is_gone() {
        let effort = Effort { speed_m_s: 1.2, ..Effort::default() };
        let stores = Stores::new(10, true);
        let lasts = stores.lasts(&effort).expect("it drains");
        assert_eq!(stores.after(lasts, &effort).charge_mwh, 0.0);
        assert!(stores.after(SiteDuration(lasts.as_ms() - 10), &effort).charge_mwh > 0.0);
    }
}
