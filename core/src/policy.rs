//! Live rules of one area: speed, distance to people and things, charging. Put by a person, pushed to the robots in it.

use crate::ids::AreaId;
use crate::limits;
use crate::reason::Violations;
use crate::rows::{Record, Table, body_is_json};
use crate::time::{Now, Utc};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// Windows of one area.
const WINDOWS_MAX: usize = 32;
/// Capabilities of which an area keeps robots in work.
const KEPT_MAX: usize = 32;
/// Minutes of a day.
const DAY_MINUTES: u16 = 24 * 60;

/// A stretch of certain days of the week, by the wall clocks of one time zone.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Window {
    /// Days on which it begins, 1 (Monday) to 7. Empty: every day.
    pub days: BTreeSet<u8>,
    /// Minute of the day at which it begins, 0..1439.
    pub from_minute: u16,
    /// Minute of the day at which it ends, 0..1439. Not later than its begin: it ends the day after.
    pub to_minute: u16,
    /// IANA time zone, `Europe/Berlin`.
    pub zone: String,
}

impl Window {
    /// When the stretch of it began in which `at` lies; none: it is not open then. A zone that nobody knows is never open.
    pub fn began(&self, at: Utc) -> Option<Utc> {
        let zone = jiff::tz::TimeZone::get(&self.zone).ok()?;
        let local = jiff::Timestamp::from_millisecond(at.0).ok()?.to_zoned(zone.clone());
        let today = local.weekday().to_monday_one_offset() as u8;
        let yesterday = if today == 1 { 7 } else { today - 1 };
        let minute = u16::from(local.hour() as u8) * 60 + u16::from(local.minute() as u8);
        let begins_on = |day: u8| self.days.is_empty() || self.days.contains(&day);
        let is_in_a_day = self.from_minute < self.to_minute;
        let date = if begins_on(today) && minute >= self.from_minute && !(is_in_a_day && minute >= self.to_minute) {
            local.date()
        } else if !is_in_a_day && begins_on(yesterday) && minute < self.to_minute {
            local.date().yesterday().ok()?
        } else {
            return None;
        };
        let (hour, minute) = (i8::try_from(self.from_minute / 60).ok()?, i8::try_from(self.from_minute % 60).ok()?);
        let began = date.at(hour, minute, 0, 0).to_zoned(zone).ok()?;
        Some(Utc(began.timestamp().as_millisecond()))
    }

    /// Whether it is open now, and not because the wall jumped into it: such a stretch stays closed to its end.
    pub fn is_open(&self, now: &Now) -> bool {
        let jumped_into = |began| now.jump.is_some_and(|jump| jump.opened(began, self.began(jump.from)));
        self.began(now.utc).is_some_and(|began| !jumped_into(began))
    }
}

/// What roll-outs of software must keep to in an area.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SoftwareRules {
    /// Of a thousand robots of the area, so many may be out of work at once for drains, cordons and breakers together; one always may.
    pub off_work_permille: u16,
    /// So many robots of the area with this capability stay in work.
    pub keep_in_work: BTreeMap<String, u32>,
    /// New drains of roll-outs begin only within one of these; what has begun may end. Empty: at any time.
    pub windows: Vec<Window>,
    /// No new drain of a roll-out begins, and no robot is given permission to change to something new.
    pub frozen: bool,
    /// The gate on rates of task failures ends a roll-out whose bundle a robot of the area has run, also if its spec does not ask for that. See [`crate::rollout::judgement::verdict::acts_on_rates`].
    #[serde(default)]
    pub acts_on_rates: bool,
}

impl Default for SoftwareRules {
    fn default() -> Self {
        Self {
            off_work_permille: 100,
            keep_in_work: BTreeMap::new(),
            windows: Vec::new(),
            frozen: false,
            acts_on_rates: false,
        }
    }
}

impl SoftwareRules {
    /// Whether drains may begin.
    pub fn is_open(&self, now: &Now) -> bool {
        !self.frozen && (self.windows.is_empty() || self.windows.iter().any(|w| w.is_open(now)))
    }
    /// Robots that may be out of work at once, of so many in the area.
    pub fn off_work_max(&self, robots: usize) -> usize {
        (robots * usize::from(self.off_work_permille) / 1_000).max(1)
    }

    fn check(&self, field: &str, violations: &mut Violations) {
        if self.off_work_permille > 1_000 {
            violations.add(format!("{field}.off_work_permille"), "must be 0..1000 permille");
        }
        if self.keep_in_work.len() > KEPT_MAX || self.keep_in_work.keys().any(|c| c.is_empty() || c.len() > 64) {
            violations
                .add(format!("{field}.keep_in_work"), format!("must be at most {KEPT_MAX}, each of 1-64 characters"));
        }
        if self.windows.len() > WINDOWS_MAX {
            violations.add(format!("{field}.windows"), format!("must be at most {WINDOWS_MAX}"));
        }
        for (ix, window) in self.windows.iter().enumerate() {
            let field = |name: &str| format!("{field}.windows[{ix}].{name}");
            if window.days.iter().any(|d| !(1..=7).contains(d)) {
                violations.add(field("days"), "must be 1 (Monday) to 7");
            }
            for (name, minute) in [("from_minute", window.from_minute), ("to_minute", window.to_minute)] {
                if minute >= DAY_MINUTES {
                    violations.add(field(name), format!("must be 0..{}", DAY_MINUTES - 1));
                }
            }
            if jiff::tz::TimeZone::get(&window.zone).is_err() {
                violations.add(field("zone"), "must be an IANA time zone, such as Europe/Berlin");
            }
        }
    }
}

/// Rules of one area, as an operator has them; robots get [`crate::desired_state::AreaRules`] of them. A missing value means that this layer sets none, except for charging, which has defaults.
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
    /// Above this a charging robot may be called to work, permille; at 1000 none is.
    pub charge_preemptible_permille: u16,
    /// Milliseconds of link time after which what a robot says of itself, and an open breaker, is an incident: see [`crate::fleet::explanation::lasting`].
    #[serde(default = "incident_after_ms")]
    pub incident_after_ms: u64,
    /// What roll-outs of software must keep to.
    #[serde(default)]
    pub software: SoftwareRules,
}

const fn incident_after_ms() -> u64 {
    limits::LASTS_BEFORE_INCIDENT.as_ms()
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
            incident_after_ms: incident_after_ms(),
            software: SoftwareRules::default(),
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
            ("charge_opportunistic_permille", self.charge_mandatory_permille, self.charge_opportunistic_permille),
            ("charge_stop_permille", self.charge_opportunistic_permille, self.charge_stop_permille),
        ];
        for (name, least, value) in order {
            if value < least || value > 1_000 {
                violations.add(
                    format!("{field}.{name}"),
                    format!(
                        "must be {least}..1000 permille (mandatory <= preemptible, mandatory <= opportunistic <= stop)"
                    ),
                );
            }
        }
        if !limits::INCIDENT_AFTER_MS.contains(&self.incident_after_ms) {
            violations.add(format!("{field}.incident_after"), "must be 1 s to 24 h");
        }
        self.software.check(&format!("{field}.software"), violations);
    }
}

impl Record for AreaPolicy {
    const TABLE: Table = Table::AreaPolicy;
    body_is_json!();
    fn id(&self) -> String {
        self.area_id.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Jump;
    use crate::time::LinkTime;

    fn at(text: &str) -> Utc {
        Utc(text.parse::<jiff::Timestamp>().expect("a time").as_millisecond())
    }

    fn now(text: &str) -> Now {
        Now { utc: at(text), wall: at(text), ..Now::default() }
    }

    fn window(from_minute: u16, to_minute: u16) -> Window {
        Window { days: BTreeSet::new(), from_minute, to_minute, zone: "UTC".to_owned() }
    }

    fn jump(from: &str, to: &str) -> Jump {
        Jump { from: at(from), to: at(to), at: LinkTime(0), skipped_ms: at(to).ms_since(at(from)) }
    }

    #[test]
    fn a_window_over_midnight_belongs_to_the_day_it_begins_on_by_the_wall_clocks_of_its_zone() {
        let zone = "Europe/Berlin".to_owned();
        let friday_night = Window { days: BTreeSet::from([5]), from_minute: 22 * 60, to_minute: 5 * 60, zone };
        // 2026-11-20 is a Friday; Berlin is an hour ahead then.
        for (text, open) in [
            ("2026-11-20T20:59:00Z", false),
            ("2026-11-20T21:00:00Z", true),
            ("2026-11-21T03:59:00Z", true),
            ("2026-11-21T04:00:00Z", false),
            ("2026-11-20T03:00:00Z", false),
            ("2026-11-21T22:00:00Z", false),
        ] {
            assert_eq!(friday_night.is_open(&now(text)), open, "{text}");
        }
        // In summer two hours.
        assert!(friday_night.is_open(&now("2026-07-03T20:00:00Z")));
    }

    #[test]
    fn a_window_that_the_wall_jumped_into_stays_closed_to_its_end_and_opens_the_next_time() {
        let night = window(22 * 60, 5 * 60);
        let jumped = |from, to, text| Now { jump: Some(jump(from, to)), ..now(text) };
        let (noon, midnight) = ("2026-11-20T12:00:00Z", "2026-11-21T00:00:00Z");
        assert!(night.is_open(&now(midnight)), "the naive rule lets software in at noon");
        for (text, open) in [
            ("2026-11-21T00:00:00Z", false),
            ("2026-11-21T04:59:00Z", false),
            ("2026-11-21T21:59:00Z", false),
            ("2026-11-21T22:00:00Z", true),
            ("2026-11-22T04:59:00Z", true),
        ] {
            assert_eq!(night.is_open(&jumped(noon, midnight, text)), open, "{text}");
        }
        assert!(night.is_open(&jumped("2026-11-20T22:30:00Z", midnight, midnight)), "it was open before");
        assert!(!night.is_open(&jumped("2026-11-20T04:00:00Z", midnight, midnight)), "not in this night");
        let (morning, night_before) = ("2026-11-20T06:00:00Z", "2026-11-20T04:00:00Z");
        assert!(!night.is_open(&jumped(morning, night_before, night_before)), "nor by a jump back");
    }

    #[test]
    fn a_frozen_area_is_closed_and_one_without_windows_is_open() {
        let rules = SoftwareRules::default();
        assert!(rules.is_open(&Now::default()));
        assert!(!SoftwareRules { frozen: true, ..rules.clone() }.is_open(&Now::default()));
        assert_eq!([6, 20, 60].map(|n| rules.off_work_max(n)), [1, 2, 6]);
    }

    #[test]
    fn rules_that_were_stored_before_gates_could_be_switched_leave_rates_only_shown() {
        let stored = r#"{"off_work_permille":100,"keep_in_work":{},"windows":[],"frozen":true}"#;
        let rules: SoftwareRules = serde_json::from_str(stored).expect("an older row");
        assert_eq!(rules, SoftwareRules { frozen: true, ..SoftwareRules::default() });
        assert!(!rules.acts_on_rates);
    }

    #[test]
    fn every_broken_rule_for_software_is_told() {
        let window =
            Window { days: BTreeSet::from([0, 8]), from_minute: 1440, to_minute: 2000, zone: "Berlin".to_owned() };
        let software = SoftwareRules {
            off_work_permille: 1001,
            keep_in_work: BTreeMap::from([(String::new(), 1)]),
            windows: vec![window],
            ..SoftwareRules::default()
        };
        let area = AreaId::parse("hall").expect("an id");
        let mut bad = Violations::default();
        AreaPolicy { software, ..AreaPolicy::default_of(area) }.check("policy", &mut bad);
        let fields: Vec<&str> = bad.0.iter().map(|v| v.field.as_str()).collect();
        let expected = [
            "off_work_permille",
            "keep_in_work",
            "windows[0].days",
            "windows[0].from_minute",
            "windows[0].to_minute",
            "windows[0].zone",
        ];
        assert_eq!(fields, expected.map(|f| format!("policy.software.{f}")));
    }
}
