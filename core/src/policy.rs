//! Live rules of one area: speed, distance to people and things, charging. Put by a person, pushed to the robots in it.

use crate::ids::AreaId;
use crate::reason::Violations;
use crate::rows::{Record, Table};
use serde::{Deserialize, Serialize};

/// Rules of one area. A missing value means that this layer sets none, except for charging, which has defaults.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AreaPolicy {
    /// Which area.
    pub area_id: AreaId,
    /// Millimetres per second; the lowest of all layers wins.
    pub speed_limit_mm_s: Option<u32>,
    /// Millimetres kept to people and things; the largest of all layers wins.
    pub avoidance_distance_mm: Option<u32>,
    /// Below this state of charge a robot must charge, permille.
    pub charge_mandatory_permille: u16,
    /// Below this an idle robot charges when nothing waits, permille.
    pub charge_opportunistic_permille: u16,
    /// Charging ends here, permille.
    pub charge_stop_permille: u16,
    /// Above this a charging robot may be called to work, permille.
    pub charge_preemptible_permille: u16,
}

impl AreaPolicy {
    /// The rules of an area that says nothing.
    pub fn default_of(area_id: AreaId) -> Self {
        Self {
            area_id,
            speed_limit_mm_s: None,
            avoidance_distance_mm: None,
            charge_mandatory_permille: 200,
            charge_opportunistic_permille: 800,
            charge_stop_permille: 900,
            charge_preemptible_permille: 350,
        }
    }

    /// Notes every rule that these values break, under `field`.
    pub fn check(&self, field: &str, violations: &mut Violations) {
        if self.speed_limit_mm_s.is_some_and(|v| !(50..=5_000).contains(&v)) {
            violations.add(format!("{field}.speed_limit_mm_s"), "must be 50..5000 mm/s");
        }
        if self.avoidance_distance_mm.is_some_and(|v| v > 10_000) {
            violations.add(format!("{field}.avoidance_distance_mm"), "must be at most 10000 mm");
        }
        let order = [
            ("charge_mandatory_permille", 50, self.charge_mandatory_permille),
            ("charge_preemptible_permille", self.charge_mandatory_permille, self.charge_preemptible_permille),
            ("charge_opportunistic_permille", self.charge_preemptible_permille, self.charge_opportunistic_permille),
            ("charge_stop_permille", self.charge_opportunistic_permille, self.charge_stop_permille),
        ];
        for (name, least, value) in order {
            if value < least || value > 1_000 {
                violations.add(
                    format!("{field}.{name}"),
                    format!("must be {least}..1000 permille (mandatory <= preemptible <= opportunistic <= stop)"),
                );
            }
        }
    }
}

impl Record for AreaPolicy {
    const TABLE: Table = Table::AreaPolicy;
    fn id(&self) -> String {
        self.area_id.to_string()
    }
}
