//! Rates of one robot's energy, fitted to what its attempts took: least squares over the ways without and with a load, time and actions.
//!
//! `fleet` adds each attempt to the sums in the robot's counter as it ends. Invariants:
//! 1. Sums are whole numbers that stay within 64 bits, however long a robot lives: at [`ATTEMPTS_MAX`] all are halved.
//! 2. The same sums give the same rates. Each lies within [`TIMES_MIN`] and [`TIMES_MAX`] times the model's, whatever a robot says.
//! 3. What the attempts leave open stays as the model has it: a few that are all alike change the sum and not its parts.

use super::{CAPACITY_MWH, EnergyRates, RobotEnergy};
use crate::time::SiteDuration;
use nalgebra::{Matrix4, Vector4};
use serde::{Deserialize, Serialize};

/// Fewer attempts leave a robot the figures of the model.
pub const ATTEMPTS_MIN: u64 = 20;
/// From so many attempts on the newest software is taken for itself.
pub const ATTEMPTS_OF_SOFTWARE: u64 = 30;
/// At so many attempts all sums are halved: batteries age, and what was long ago fades.
pub const ATTEMPTS_MAX: u64 = 4_000;
/// No rate is less than so many times the model's.
pub const TIMES_MIN: f64 = 0.25;
/// No rate is more than so many times the model's.
pub const TIMES_MAX: f64 = 4.0;

/// An attempt that took so many times what the model says, or so much less, is not counted.
const ABSURD_TIMES: u64 = 10;
/// An attempt that took longer is not counted.
const LONGEST: SiteDuration = SiteDuration::from_secs(4 * 3_600);
/// A robot that says that it drove faster is not counted, millimetres per second.
const FASTEST_MM_S: u64 = 10_000;
/// More actions are no attempt's: a task has 64 steps at most.
const ACTIONS_MAX: u64 = 64;
/// Millimetres of the unit in which ways are summed.
const MM_PER_UNIT: u64 = 100;
/// Milliseconds of the unit in which times are summed.
const MS_PER_UNIT: u64 = 100;
/// How much the model counts beside the attempts: the square of the usual error of an attempt (a twentieth) over that of the model's own
/// rates (a half).
const PRIOR: f64 = 0.01;

/// What one attempt did, and what its robot says that it took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct AttemptWork {
    /// Millimetres driven without a load.
    pub empty_mm: u64,
    /// Millimetres driven with a load.
    pub loaded_mm: u64,
    /// Milliseconds from its beginning to its end, site time.
    pub duration_ms: u64,
    /// Actions done: picks, places, inspections.
    pub actions: u64,
    /// Milliwatt-hours that it took.
    pub energy_mwh: u64,
}

impl AttemptWork {
    /// Milliwatt-hours by the model.
    fn by_model_mwh(&self) -> u64 {
        let rates = EnergyRates::MODEL;
        let drive_nwh = rates.drive_nwh(self.empty_mm, false).saturating_add(rates.drive_nwh(self.loaded_mm, true));
        let nwh = drive_nwh.saturating_add(rates.stand_nwh(self.duration_ms));
        nwh / super::NWH_PER_MWH + self.actions.min(ACTIONS_MAX) * u64::from(rates.action_mwh)
    }
    /// Whether a robot can have done that, with about so much energy. One that reports none says nothing.
    fn is_credible(&self) -> bool {
        let way_mm = self.empty_mm.saturating_add(self.loaded_mm);
        let is_possible = self.duration_ms <= LONGEST.as_ms()
            && way_mm <= self.duration_ms * FASTEST_MM_S / 1_000
            && self.actions <= ACTIONS_MAX;
        let usual_mwh = self.by_model_mwh();
        let is_likely = |mwh: u64| (usual_mwh.div_ceil(ABSURD_TIMES)..=usual_mwh * ABSURD_TIMES).contains(&mwh);
        is_possible && (1..=CAPACITY_MWH as u64 * ABSURD_TIMES).contains(&self.energy_mwh) && is_likely(self.energy_mwh)
    }
    /// What its energy is explained by, each in its unit: tenths of a metre, tenths of a second, one.
    fn parts(&self) -> [u64; 4] {
        let way = |mm: u64| (mm + MM_PER_UNIT / 2) / MM_PER_UNIT;
        [way(self.empty_mm), way(self.loaded_mm), (self.duration_ms + MS_PER_UNIT / 2) / MS_PER_UNIT, self.actions]
    }
}

/// Sums over attempts of one robot, from which its rates follow. The parts of an attempt are its way without a load and with one (tenths of a
/// metre), its time (tenths of a second) and its actions; energy is in milliwatt-hours.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EnergySums {
    /// Attempts; the older ones count less once they are many.
    pub attempts: u64,
    /// Energy of all of them.
    pub energy: u64,
    /// Squares of energy.
    pub energy_squares: u64,
    /// Energy times each part.
    pub energy_products: [u64; 4],
    /// Each part times itself and those behind it: 00 01 02 03 11 12 13 22 23 33.
    pub part_products: [u64; 10],
}

impl EnergySums {
    /// Adds an attempt. False: what is said of it cannot be, and nothing is added.
    pub fn add(&mut self, work: &AttemptWork) -> bool {
        if !work.is_credible() {
            return false;
        }
        let (parts, energy) = (work.parts(), work.energy_mwh);
        let pairs = (0..4).flat_map(|a| (a..4).map(move |b| (a, b)));
        let mut products = [0; 10];
        products.iter_mut().zip(pairs).for_each(|(sum, (a, b))| *sum = parts[a] * parts[b]);
        self.merge(&Self {
            attempts: 1,
            energy,
            energy_squares: energy * energy,
            energy_products: parts.map(|part| part * energy),
            part_products: products,
        });
        if self.attempts >= ATTEMPTS_MAX {
            self.all_mut().for_each(|sum| *sum /= 2);
        }
        true
    }

    /// Adds the attempts of `other`.
    pub fn merge(&mut self, other: &Self) {
        let mut other = other.clone();
        self.all_mut().zip(other.all_mut()).for_each(|(sum, more)| *sum = sum.saturating_add(*more));
    }

    /// Whether no attempt was counted.
    pub fn is_empty(&self) -> bool {
        self.attempts == 0
    }

    fn all_mut(&mut self) -> impl Iterator<Item = &mut u64> {
        [&mut self.attempts, &mut self.energy, &mut self.energy_squares]
            .into_iter()
            .chain(&mut self.energy_products)
            .chain(&mut self.part_products)
    }

    /// The sum of part `a` times part `b`.
    fn product(&self, a: usize, b: usize) -> f64 {
        const AT: [[usize; 4]; 4] = [[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]];
        self.part_products[AT[a][b]] as f64
    }
}

/// Rates of a robot by the sums of all its software: of the newest alone, if it has done enough.
pub fn fit_robot<'a>(newest: &EnergySums, all: impl Iterator<Item = &'a EnergySums>) -> RobotEnergy {
    if newest.attempts >= ATTEMPTS_OF_SOFTWARE {
        return fit(newest);
    }
    let mut sums = EnergySums::default();
    all.for_each(|of_software| sums.merge(of_software));
    fit(&sums)
}

/// Rates that explain the attempts best.
fn fit(sums: &EnergySums) -> RobotEnergy {
    let unfitted = RobotEnergy { attempts: sums.attempts, ..RobotEnergy::MODEL };
    if sums.attempts < ATTEMPTS_MIN {
        return unfitted;
    }
    // In what each part takes by the model, so that all are of one kind, and the model itself is 1 in each.
    let unit_mwh = units_mwh();
    let attempts = sums.attempts as f64;
    let products = Matrix4::from_fn(|a, b| sums.product(a, b) * unit_mwh[a] * unit_mwh[b]);
    let moments = Vector4::from_fn(|part, _| sums.energy_products[part] as f64 * unit_mwh[part]);
    let prior = PRIOR * products.sum() / attempts;
    let times = solve_within(&(products + Matrix4::identity() * prior), &(moments + Vector4::repeat(prior)));
    let left = sums.energy_squares as f64 - 2.0 * times.dot(&moments) + times.dot(&(products * times));
    let (root, mean) = ((left.max(0.0) / (attempts - 4.0)).sqrt(), sums.energy as f64 / attempts);
    if !(root.is_finite() && mean > 0.0) {
        return unfitted;
    }
    let rate = |part: usize, by_model: u32| (f64::from(by_model) * times[part]).round() as u32;
    let rates = EnergyRates {
        empty_mwh_per_km: rate(0, EnergyRates::MODEL.empty_mwh_per_km),
        loaded_mwh_per_km: rate(1, EnergyRates::MODEL.loaded_mwh_per_km),
        idle_mw: rate(2, EnergyRates::MODEL.idle_mw),
        action_mwh: rate(3, EnergyRates::MODEL.action_mwh),
    };
    RobotEnergy { rates, error_permille: Some((root / mean * 1_000.0).ceil() as u32), attempts: sums.attempts }
}

/// Milliwatt-hours of the unit of each part by the model.
fn units_mwh() -> Vector4<f64> {
    let EnergyRates { empty_mwh_per_km, loaded_mwh_per_km, idle_mw, action_mwh } = EnergyRates::MODEL;
    let (km, hours) = (MM_PER_UNIT as f64 / 1e6, MS_PER_UNIT as f64 / 3.6e6);
    let way = |mwh_per_km: u32| f64::from(mwh_per_km) * km;
    Vector4::new(way(empty_mwh_per_km), way(loaded_mwh_per_km), f64::from(idle_mw) * hours, f64::from(action_mwh))
}

/// How many times the model's each rate is. What would lie beyond its bound is put there, and the others are found anew.
fn solve_within(products: &Matrix4<f64>, moments: &Vector4<f64>) -> Vector4<f64> {
    let mut bound: [Option<f64>; 4] = [None; 4];
    loop {
        let (mut matrix, mut right) = (*products, *moments);
        for (part, times) in bound.iter().enumerate().filter_map(|(part, times)| Some((part, (*times)?))) {
            right -= products.column(part) * times;
            matrix.row_mut(part).fill(0.0);
            matrix.column_mut(part).fill(0.0);
            matrix[(part, part)] = 1.0;
        }
        bound.iter().enumerate().for_each(|(part, times)| right[part] = times.unwrap_or(right[part]));
        let Some(solver) = matrix.cholesky() else { return Vector4::repeat(1.0) };
        let times = solver.solve(&right);
        let beyond = |part: &usize| bound[*part].is_none() && !(TIMES_MIN..=TIMES_MAX).contains(&times[*part]);
        match (0..4).find(beyond) {
            Some(part) => bound[part] = Some(times[part].clamp(TIMES_MIN, TIMES_MAX)),
            None => return times,
        }
    }
}

#[cfg(test)]
mod tests;
