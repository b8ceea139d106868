//! What it costs to give a task to a robot, in thousandths of a millisecond on the way.
//!
//! Invariants: integers alone; what a class is worth is more than any way there is, so that a task of a higher class goes
//! first, and as many tasks are given as can be.

use crate::fleet::assignment::estimate::USUAL_MM_S;
use crate::fleet::projection::chosen::PairCost;
use crate::fleet::projection::plans::{WeighedPair, WeighedRobot, WeighedTask};
use crate::planner_policy::PlannerPolicy;
use crate::task::spec::Class;
use crate::time::Utc;

const UNITS_PER_MS: i64 = PairCost::UNITS_PER_MS;
/// No term counts more than so many milliseconds: 18 hours.
const TERM_MS_MAX: u64 = 1 << 26;
/// A robot that failed the task stands behind one that is so much farther away, milliseconds.
const FAILED_MS: u64 = 60_000;

/// What a pair costs before the worth of its class, term by term.
pub fn of_pair(
    policy: &PlannerPolicy,
    now: Utc,
    robot: &WeighedRobot,
    task: &WeighedTask,
    pair: &WeighedPair,
) -> PairCost {
    let weight = i64::from(policy.travel_weight(task.class));
    let way_ms = way_ms(pair.way_mm);
    let failed_ms = if pair.has_failed { FAILED_MS } else { 0 };
    let age_ms = now.ms_since(task.since);
    let eta_ms = robot.ready_ms.saturating_add(way_ms);
    let late_ms = task.deadline.map_or(0, |at| now.plus_ms(eta_ms).ms_since(at));
    // Together they count no more than one term may.
    let mut left_ms = TERM_MS_MAX;
    let mut of_way = |ms: u64| {
        let counted = ms.min(left_ms);
        left_ms -= counted;
        weight * units(counted)
    };
    let meant_ms = if pair.is_meant { policy.hysteresis_ms } else { 0 };
    PairCost {
        ready: of_way(robot.ready_ms),
        way: of_way(way_ms),
        failed: of_way(failed_ms),
        charge: of_way(robot.loss_ms),
        energy: energy(pair.energy_mwh, policy),
        lateness: -units(late_ms) * i64::from(policy.lateness_permille) / 1_000,
        age: -units(age_ms) * i64::from(policy.ageing_permille) / 1_000,
        kept: -weight * units(meant_ms),
        tie: robot.tasks.min(UNITS_PER_MS as u64 - 1) as i64,
    }
}

/// What so many milliwatt-hours weigh, no more than one term may. What takes less weighs less than nothing.
fn energy(mwh: i64, policy: &PlannerPolicy) -> i64 {
    // A thousandth of a watt-hour for a thousandth of a millisecond.
    const { assert!(UNITS_PER_MS == 1_000) };
    let most = units(TERM_MS_MAX);
    mwh.saturating_mul(policy.energy_ms_per_wh.into()).clamp(-most, most)
}

/// Milliseconds that a way usually takes.
pub fn way_ms(way_mm: u64) -> u64 {
    way_mm * 1_000 / USUAL_MM_S
}

fn units(ms: u64) -> i64 {
    ms.min(TERM_MS_MAX) as i64 * UNITS_PER_MS
}

/// What a task of each class is worth where no pair costs more than `largest`, and at most so many pairs are made.
pub fn worth(class: Class, largest: i64, pairs: usize) -> i64 {
    let level = match class {
        Class::Urgent => 3,
        Class::Normal => 2,
        Class::Background => 1,
    };
    level * (largest.saturating_add(1)).saturating_mul(2 * pairs as i64)
}
