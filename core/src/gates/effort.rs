//! What work costs robots on trial, beside the others in the same time: time, energy, heat.
//!
//! Invariant: a side with too little work says nothing.

use serde::{Deserialize, Serialize};

/// Tasks that each side must have ended to be compared.
const TASKS_MIN: u64 = 5;
/// Millimetres that each side must have driven for its energy to be compared.
const PATH_MIN_MM: u64 = 100_000;

/// What tasks cost some robots. Errands are not among them, but for heat.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Effort {
    /// Tasks that ended.
    pub tasks: u64,
    /// Milliseconds of site time at work.
    pub duration_ms: u64,
    /// Millimetres driven.
    pub path_mm: u64,
    /// Milliwatt-hours used, as robots report them of their tasks.
    pub energy_mwh: u64,
    /// Tenths of a degree, highest joint temperature ever seen. 0: nothing measured.
    pub hottest_joint_decidegrees: i32,
}

impl Effort {
    /// Both. Robots say these numbers: absurd ones spoil a sum and nothing else.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            tasks: self.tasks.saturating_add(other.tasks),
            duration_ms: self.duration_ms.saturating_add(other.duration_ms),
            path_mm: self.path_mm.saturating_add(other.path_mm),
            energy_mwh: self.energy_mwh.saturating_add(other.energy_mwh),
            hottest_joint_decidegrees: self.hottest_joint_decidegrees.max(other.hottest_joint_decidegrees),
        }
    }
    /// What came after `before`. How hot it was once stays.
    #[must_use]
    pub fn since(self, before: Self) -> Self {
        Self {
            tasks: self.tasks.saturating_sub(before.tasks),
            duration_ms: self.duration_ms.saturating_sub(before.duration_ms),
            path_mm: self.path_mm.saturating_sub(before.path_mm),
            energy_mwh: self.energy_mwh.saturating_sub(before.energy_mwh),
            hottest_joint_decidegrees: self.hottest_joint_decidegrees,
        }
    }
    /// Milliseconds of work for each task that ended; none: too few ended.
    pub const fn ms_a_task(&self) -> Option<u64> {
        if self.tasks < TASKS_MIN { None } else { Some(self.duration_ms / self.tasks) }
    }
    /// Milliwatt-hours for each kilometre; none: too little was driven.
    pub const fn mwh_a_km(&self) -> Option<u64> {
        if self.path_mm < PATH_MIN_MM { None } else { Some(self.energy_mwh.saturating_mul(1_000_000) / self.path_mm) }
    }
    /// The highest joint temperature; none: nothing was measured, or too few tasks ended.
    pub fn hottest(&self) -> Option<i32> {
        (self.hottest_joint_decidegrees != 0 && self.tasks >= TASKS_MIN).then_some(self.hottest_joint_decidegrees)
    }
}

/// Work with the bundle on trial, and beside it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Efforts {
    /// Of robots on trial, since their trials began.
    pub trial: Effort,
    /// Of all robots with any other version, since the roll-out began.
    pub control: Effort,
}

/// How much more than the others robots with the bundle may need before a person is asked at the gate. None: it is only shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EffortLimits {
    /// Longer for a task, permille.
    pub slower_permille: Option<u32>,
    /// More energy for a kilometre, permille.
    pub energy_permille: Option<u32>,
    /// Hotter than any joint of the others ever was, tenths of a degree.
    pub hotter_decidegrees: Option<u32>,
}
