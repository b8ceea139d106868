//! Live rules of the planner of one site: how robots are chosen for tasks, and what each thing weighs in that choice.
//! Put by a person.
//!
//! Source of the values: a reference simulation of 50 robots, held against `midshift-bench shift`.

use crate::ids::SiteId;
use crate::reason::Violations;
use crate::rows::{Record, Table, body_is_json};
use crate::task::spec::Class;
use serde::{Deserialize, Serialize};

/// How robots are chosen for tasks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AssignmentPolicy {
    /// Tasks in the order of the queue, each to the nearest robot that is free.
    FifoNearest,
    /// All that may be given at once, by least cost, with an eye to robots that are free soon.
    Rolling,
}

impl AssignmentPolicy {
    /// As people write it.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::FifoNearest => "fifo-nearest",
            Self::Rolling => "rolling",
        }
    }
}

/// Rules of a site's planner. All but `policy` are of [`AssignmentPolicy::Rolling`] alone.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PlannerPolicy {
    /// Which site.
    pub site_id: SiteId,
    /// How robots are chosen.
    pub policy: AssignmentPolicy,
    /// A robot that is free within so many milliseconds of site time is taken into account already. 0: none is.
    pub horizon_ms: u64,
    /// What a millisecond on the way to an urgent task weighs.
    pub urgent_travel_weight: u32,
    /// The same of a normal task.
    pub normal_travel_weight: u32,
    /// The same of a background task.
    pub background_travel_weight: u32,
    /// What a task gains by each second that it has waited, thousandths of a second on the way.
    pub ageing_permille: u32,
    /// What each second past the deadline weighs, thousandths of a second on the way.
    pub lateness_permille: u32,
    /// What must be gained before a task is meant for another robot than it was, milliseconds on the way.
    pub hysteresis_ms: u64,
    /// What a watt-hour weighs that a robot takes more on the way to a task than a usual one, milliseconds on the way. 0: nothing.
    #[serde(default = "default_energy_ms_per_wh")]
    pub energy_ms_per_wh: u32,
}

/// A robot that takes double has 700 ms more for 50 m: it decides between robots that are about as near.
const fn default_energy_ms_per_wh() -> u32 {
    100
}

impl PlannerPolicy {
    /// The rules of a site that says nothing.
    pub const fn default_of(site_id: SiteId) -> Self {
        Self {
            site_id,
            policy: AssignmentPolicy::Rolling,
            horizon_ms: 30_000,
            urgent_travel_weight: 4,
            normal_travel_weight: 2,
            background_travel_weight: 1,
            ageing_permille: 200,
            lateness_permille: 500,
            hysteresis_ms: 5_000,
            energy_ms_per_wh: default_energy_ms_per_wh(),
        }
    }

    /// What a millisecond on the way to a task of this class weighs.
    pub const fn travel_weight(&self, class: Class) -> u32 {
        match class {
            Class::Urgent => self.urgent_travel_weight,
            Class::Normal => self.normal_travel_weight,
            Class::Background => self.background_travel_weight,
        }
    }

    /// Notes every rule that these values break as those of this site, under `field`.
    pub fn check_for(&self, site_id: &SiteId, field: &str, violations: &mut Violations) {
        if self.site_id != *site_id {
            violations.add(format!("{field}.site_id"), format!("must be {site_id}, the site that is served"));
        }
        self.check(field, violations);
    }

    /// Notes every rule that these values break, under `field`.
    pub fn check(&self, field: &str, violations: &mut Violations) {
        let mut within = |name: &str, value: u64, least: u64, most: u64, unit: &str| {
            if !(least..=most).contains(&value) {
                violations.add(format!("{field}.{name}"), format!("must be {least}..{most}{unit}"));
            }
        };
        within("horizon", self.horizon_ms, 0, 60_000, " ms");
        within("urgent_travel_weight", self.urgent_travel_weight.into(), 1, 100, "");
        within("normal_travel_weight", self.normal_travel_weight.into(), 1, 100, "");
        within("background_travel_weight", self.background_travel_weight.into(), 1, 100, "");
        within("ageing_permille", self.ageing_permille.into(), 0, 10_000, " permille");
        within("lateness_permille", self.lateness_permille.into(), 0, 10_000, " permille");
        within("hysteresis", self.hysteresis_ms, 0, 60_000, " ms");
        within("energy_ms_per_wh", self.energy_ms_per_wh.into(), 0, 5_000, " ms");
    }
}

impl Record for PlannerPolicy {
    const TABLE: Table = Table::PlannerPolicy;
    body_is_json!();
    fn id(&self) -> String {
        self.site_id.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_broken_rule_of_a_planner_is_told() {
        let site_id = SiteId::parse("hall").expect("an id");
        let good = PlannerPolicy::default_of(site_id);
        let told = |policy: &PlannerPolicy| {
            let mut bad = Violations::default();
            policy.check("policy", &mut bad);
            bad.0.into_iter().map(|v| v.field).collect::<Vec<_>>()
        };
        assert!(told(&good).is_empty());
        let bad = PlannerPolicy {
            horizon_ms: 60_001,
            urgent_travel_weight: 0,
            normal_travel_weight: 101,
            background_travel_weight: 0,
            ageing_permille: 10_001,
            lateness_permille: 10_001,
            hysteresis_ms: 60_001,
            energy_ms_per_wh: 5_001,
            ..good
        };
        let fields = [
            "horizon",
            "urgent_travel_weight",
            "normal_travel_weight",
            "background_travel_weight",
            "ageing_permille",
            "lateness_permille",
            "hysteresis",
            "energy_ms_per_wh",
        ];
        assert_eq!(told(&bad), fields.map(|f| format!("policy.{f}")));
        let mut elsewhere = Violations::default();
        bad.check_for(&SiteId::parse("yard").expect("an id"), "policy", &mut elsewhere);
        let told: Vec<_> = elsewhere.0.into_iter().map(|v| v.field).collect();
        assert_eq!(told[0], "policy.site_id");
        assert_eq!(told[1..], fields.map(|f| format!("policy.{f}")));
    }
}
