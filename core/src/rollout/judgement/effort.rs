//! What work costs robots with a bundle, beside the others in the same time: time, energy, heat.
//!
//! Called by `verdict`, which holds it against the limits of a spec, and at the moments from which it counts.
//! Invariant: it is made of counters that are rows.

use crate::fleet::rows::RobotCounter;
use crate::gates::{Effort, EffortLimits, Efforts};
use crate::ids::RobotId;
use crate::reason::{Code, Reason};
use crate::rollout::projection::rows::Rollout;
use crate::rollout::projection::state::RolloutProjection;

/// Of one robot with one version, since ever. How hot it was on an errand counts, and nothing else of one.
fn count_effort(counter: &RobotCounter) -> Effort {
    let (stats, errands) = (counter.stats, counter.errands);
    Effort {
        tasks: counter.succeeded.saturating_add(counter.failures.values().sum()),
        duration_ms: stats.duration_ms.saturating_sub(errands.duration_ms),
        path_mm: stats.path_mm.saturating_sub(errands.path_mm),
        energy_mwh: stats.energy_mwh.saturating_sub(errands.energy_mwh),
        hottest_joint_decidegrees: stats.hottest_joint_decidegrees,
    }
}

/// Of one robot with the version of the roll-out, since ever.
pub fn effort_of_robot(view: &RolloutProjection, rollout: &Rollout, robot_id: &RobotId) -> Effort {
    let Some(bundle) = view.bundles.get(rollout.spec.bundle.as_str()) else { return Effort::default() };
    let id = format!("{robot_id}@{}", bundle.row.version);
    view.counters.get(id.as_str()).map_or_else(Effort::default, |counter| count_effort(&counter.row))
}

/// Of all robots with any other version, since ever.
pub fn effort_of_controls(view: &RolloutProjection, rollout: &Rollout) -> Effort {
    let version = view.bundles.get(rollout.spec.bundle.as_str()).map(|b| b.row.version.as_str());
    let others = view.counters.values().map(|c| &c.row).filter(|c| Some(c.software.as_str()) != version);
    others.map(count_effort).fold(Effort::default(), Effort::plus)
}

/// What was seen of both sides by now.
pub fn see_efforts(view: &RolloutProjection, rollout: &Rollout) -> Efforts {
    let on_trial = view.robots_of(&rollout.rollout_id).filter(|r| r.moments.on_trial.is_some());
    let trial = on_trial.map(|r| effort_of_robot(view, rollout, &r.robot_id).since(r.effort_before));
    let control = effort_of_controls(view, rollout).since(rollout.counted.effort);
    Efforts { trial: trial.fold(Effort::default(), Effort::plus), control }
}

/// What robots with the bundle need so much more of than the others that a person is asked; none: nothing, or nothing
/// is known.
pub fn find_excess(efforts: &Efforts, limits: &EffortLimits) -> Option<Reason> {
    let (trial, control) = (&efforts.trial, &efforts.control);
    let told = |what: &str, trial: String, control: String| {
        Reason::from(Code::EffortTooHigh).with("what", what).with("trial", trial).with("control", control)
    };
    let share = |what: &str, trial: Option<u64>, control: Option<u64>, more_permille: Option<u32>| {
        let ((trial, control), more) = (trial.zip(control)?, more_permille?);
        let most = u128::from(control) * (1_000 + u128::from(more));
        (u128::from(trial) * 1_000 > most).then(|| told(what, trial.to_string(), control.to_string()))
    };
    let hotter = || {
        let ((trial, control), more) = (trial.hottest().zip(control.hottest())?, limits.hotter_decidegrees?);
        let is_hotter = i64::from(trial) > i64::from(control) + i64::from(more);
        is_hotter.then(|| told("hottest_joint_decidegrees", trial.to_string(), control.to_string()))
    };
    share("ms_a_task", trial.ms_a_task(), control.ms_a_task(), limits.slower_permille)
        .or_else(|| share("mwh_a_km", trial.mwh_a_km(), control.mwh_a_km(), limits.energy_permille))
        .or_else(hotter)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot_events::WorkStats;
    use crate::time::Utc;
    use std::collections::BTreeMap;

    const CONTROL: Effort = Effort {
        tasks: 100,
        duration_ms: 4_000_000,
        path_mm: 2_000_000,
        energy_mwh: 600,
        hottest_joint_decidegrees: 600,
    };

    fn limits() -> EffortLimits {
        EffortLimits { slower_permille: Some(200), energy_permille: Some(200), hotter_decidegrees: Some(50) }
    }

    /// What is too much for a side like `CONTROL` that was changed so, with 10 tasks.
    fn too_much(change: impl FnOnce(&mut Effort)) -> Option<String> {
        let mut trial = Effort {
            tasks: 10,
            duration_ms: 400_000,
            path_mm: 200_000,
            energy_mwh: 60,
            hottest_joint_decidegrees: 600,
        };
        change(&mut trial);
        let reason = find_excess(&Efforts { trial, control: CONTROL }, &limits())?;
        reason.metadata.get("what").cloned()
    }

    #[test]
    fn an_errand_costs_no_task_time_or_energy_and_its_heat_counts() {
        let stats = |duration_ms, path_mm, energy_mwh| WorkStats {
            path_mm,
            loaded_path_mm: 0,
            duration_ms,
            energy_mwh,
            hottest_joint_decidegrees: 700,
        };
        let counter = RobotCounter {
            robot_id: RobotId::parse("r1").expect("an id"),
            software: "1.0.0".to_owned(),
            succeeded: 8,
            failures: BTreeMap::from([(7, 2)]),
            stats: stats(500_000, 300_000, 90),
            errands: stats(100_000, 100_000, 30),
            attached_ms: 0,
            counted: Utc(0),
            energy_sums: Default::default(),
        };
        let expected = Effort {
            tasks: 10,
            duration_ms: 400_000,
            path_mm: 200_000,
            energy_mwh: 60,
            hottest_joint_decidegrees: 700,
        };
        assert_eq!(count_effort(&counter), expected);
    }

    #[test]
    fn each_limit_lets_its_own_share_pass_and_no_more() {
        assert_eq!(too_much(|_| {}), None);
        assert_eq!(too_much(|t| t.duration_ms = 480_000), None);
        assert_eq!(too_much(|t| t.duration_ms = 480_010), Some("ms_a_task".to_owned()));
        assert_eq!(too_much(|t| t.energy_mwh = 72), None);
        assert_eq!(too_much(|t| t.energy_mwh = 73), Some("mwh_a_km".to_owned()));
        assert_eq!(too_much(|t| t.hottest_joint_decidegrees = 650), None);
        assert_eq!(too_much(|t| t.hottest_joint_decidegrees = 651), Some("hottest_joint_decidegrees".to_owned()));
    }

    #[test]
    fn too_little_work_says_nothing_and_neither_does_a_limit_that_is_not_set() {
        assert_eq!(too_much(|t| (t.tasks, t.duration_ms, t.hottest_joint_decidegrees) = (4, 4_000_000, 900)), None);
        assert_eq!(too_much(|t| (t.path_mm, t.energy_mwh) = (99_999, 60_000)), None);
        let trial = Effort { duration_ms: u64::MAX, energy_mwh: u64::MAX, ..CONTROL };
        assert_eq!(find_excess(&Efforts { trial, control: CONTROL }, &EffortLimits::default()), None);
    }
}
