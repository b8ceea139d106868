//! What a roll-out is asked to be: whom it is for, in which waves, and what it takes to go on.
//!
//! Invariant: a checked spec never changes; what a roll-out does afterwards is in its row.

use crate::gates::EffortLimits;
use crate::ids::{AreaId, BundleId, RobotId};
use crate::reason::Violations;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

/// Waves of one roll-out.
pub const WAVES_MAX: usize = 32;
/// Robots, areas, labels or models that a selector names.
const NAMED_MAX: usize = 1_000;
/// Time limits, milliseconds of site time.
const LIMIT_MS: RangeInclusive<u64> = 1_000..=30 * 24 * 3_600_000;
/// Probation of a roll-out that names none, milliseconds of site time.
pub const PROBATION_DEFAULT_MS: u64 = 180_000;
/// Robots of a hundred that a roll-out which names no share must end with on its bundle.
const COMPLETE_PERCENT_DEFAULT: u32 = 90;
/// Probation, milliseconds of site time.
const PROBATION_MS: RangeInclusive<u64> = 1_000..=24 * 3_600_000;

/// Silence after which a robot out of work is lost, milliseconds of link time.
const LOST_AFTER_MS: RangeInclusive<u64> = 60_000..=30 * 24 * 3_600_000;
/// As much where a spec says nothing, milliseconds of link time: long after the gates have judged what is theirs.
const fn lost_after_ms() -> u64 {
    900_000
}

/// A limit of effort above this is none.
const EFFORT_MAX: u32 = 10_000;

/// Whom a roll-out is for. Everything that is named must hold; what is empty holds for all.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Selector {
    /// Only these.
    pub robots: BTreeSet<RobotId>,
    /// Only robots that are in one of these areas.
    pub areas: BTreeSet<AreaId>,
    /// Only robots with these labels.
    pub labels: BTreeMap<String, String>,
    /// Only robots of one of these models.
    pub models: BTreeSet<String>,
    /// Only robots that run one of these versions.
    pub versions: BTreeSet<String>,
}

/// Who belongs to a wave, of those that no wave before it took.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Wave {
    /// So many.
    Count(u32),
    /// So many of a hundred of all that are matched, rounded up.
    Percent(u32),
    /// All with this label.
    Label {
        /// Its key.
        key: String,
        /// Its value.
        value: String,
    },
    /// All that run this version.
    Version(String),
    /// All that are left.
    Rest,
}

/// What happens where a gate cannot decide by itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SmallWave {
    /// The roll-out goes on, and says that nothing was proven.
    #[default]
    Auto,
    /// A person decides.
    Review,
}

/// What a failure means while fewer than ten robots were attempted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SmallWaveFailure {
    /// The roll-out is aborted.
    #[default]
    Abort,
    /// A person decides.
    Review,
}

/// Who goes back when a roll-out is aborted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AbortScope {
    /// Every robot that it touched.
    #[default]
    All,
    /// Only robots on trial; what was committed stays.
    Trial,
}

/// What a person asks for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RolloutSpec {
    /// Which bundle.
    pub bundle: BundleId,
    /// For whom.
    pub selector: Selector,
    /// In which order. At least two unless `allow_full_push`.
    pub waves: Vec<Wave>,
    /// Robots that are out of work for it at once; none: as many as the wave has. The area's budget holds beside it.
    pub max_in_flight: Option<u32>,
    /// Milliseconds of site time that a robot may take to end its work, from the moment its drain begins.
    pub drain_within_ms: u64,
    /// Milliseconds of site time on probation.
    pub probation_ms: u64,
    /// Milliseconds of site time for which a wave is only watched.
    pub soak_ms: u64,
    /// Tasks that each robot of a wave must have ended on trial.
    pub exposure_tasks: u64,
    /// Milliseconds of site time, from the end of the soak, until a person is asked about a wave that had too few
    /// tasks.
    pub exposure_within_ms: u64,
    /// What happens with a wave that proves nothing.
    pub small_wave: SmallWave,
    /// What a failure among few means.
    pub small_wave_failure: SmallWaveFailure,
    /// Who goes back at an abort.
    pub abort_scope: AbortScope,
    /// A first wave of more than max(1, 10 %), or a single wave, is meant so.
    pub allow_full_push: bool,
    /// Bytes a second that each robot may download. 0: as fast as it goes.
    pub rate_bytes_s: u32,
    /// The gate on rates of task failures ends the roll-out too; else it is only shown, unless rules of an area say
    /// otherwise: [`crate::rollout::judgement::verdict::acts_on_rates`].
    pub acts_on_rates: bool,
    /// So many of a hundred robots that were offered the bundle must have it at the end, or the outcome is INCOMPLETE.
    /// 1..100.
    #[serde(default = "complete_percent_default")]
    pub complete_percent: u32,
    /// Milliseconds of link time after which a robot that is out of work for it and is not heard is lost: an incident.
    #[serde(default = "lost_after_ms")]
    pub lost_after_ms: u64,
    /// A robot that is lost counts in no budget until it is heard. Else a person has to say so.
    #[serde(default)]
    pub writes_off_lost: bool,
    /// No component of the bundle may have a lower `rollback_index`: each robot holds it against what it is given.
    /// Whoever goes back does not.
    #[serde(default)]
    pub rollback_floor: u64,
    /// What its robots' work may cost more than that of the others.
    #[serde(default)]
    pub effort: EffortLimits,
}

/// The share of roll-outs that were written down before there was one.
const fn complete_percent_default() -> u32 {
    COMPLETE_PERCENT_DEFAULT
}

impl RolloutSpec {
    /// The spec of a person who names no more than a bundle.
    pub fn new(bundle: BundleId) -> Self {
        Self {
            bundle,
            selector: Selector::default(),
            waves: vec![Wave::Count(1), Wave::Percent(25), Wave::Rest],
            max_in_flight: None,
            drain_within_ms: 600_000,
            probation_ms: PROBATION_DEFAULT_MS,
            soak_ms: 600_000,
            exposure_tasks: 2,
            exposure_within_ms: 3_600_000,
            small_wave: SmallWave::default(),
            small_wave_failure: SmallWaveFailure::default(),
            abort_scope: AbortScope::default(),
            allow_full_push: false,
            rate_bytes_s: 0,
            acts_on_rates: false,
            complete_percent: COMPLETE_PERCENT_DEFAULT,
            lost_after_ms: lost_after_ms(),
            writes_off_lost: false,
            rollback_floor: 0,
            effort: EffortLimits::default(),
        }
    }

    /// Notes every rule that it breaks by itself.
    pub fn check(&self, bad: &mut Violations) {
        if self.waves.is_empty() || self.waves.len() > WAVES_MAX {
            bad.add("waves", format!("must be 1..{WAVES_MAX}"));
        }
        if self.waves.len() < 2 && !self.allow_full_push {
            bad.add("waves", "must be at least two, or say allow_full_push");
        }
        for (ix, wave) in self.waves.iter().enumerate() {
            let field = || format!("waves[{ix}]");
            match wave {
                Wave::Count(0) => bad.add(field(), "must be at least 1 robot"),
                Wave::Percent(p) if !(1..=100).contains(p) => bad.add(field(), "must be 1..100 percent"),
                Wave::Rest if ix + 1 < self.waves.len() => bad.add(field(), "rest must be the last wave"),
                Wave::Label { key, .. } if key.is_empty() => bad.add(field(), "must name a label"),
                Wave::Version(v) if v.is_empty() => bad.add(field(), "must name a version"),
                _ => {}
            }
        }
        let mut within = |field: &str, value: u64, range: &RangeInclusive<u64>| {
            if !range.contains(&value) {
                bad.add(field, format!("must be {}..{} ms", range.start(), range.end()));
            }
        };
        within("drain_within_ms", self.drain_within_ms, &LIMIT_MS);
        within("probation_ms", self.probation_ms, &PROBATION_MS);
        within("soak_ms", self.soak_ms, &(0..=*LIMIT_MS.end()));
        within("exposure_within_ms", self.exposure_within_ms, &LIMIT_MS);
        within("lost_after_ms", self.lost_after_ms, &LOST_AFTER_MS);
        if self.exposure_tasks > 10_000 {
            bad.add("exposure_tasks", "must be at most 10000");
        }
        let effort = [
            ("slower_permille", self.effort.slower_permille),
            ("energy_permille", self.effort.energy_permille),
            ("hotter_decidegrees", self.effort.hotter_decidegrees),
        ];
        for (field, limit) in effort {
            if limit.is_some_and(|limit| limit > EFFORT_MAX) {
                bad.add(format!("effort.{field}"), format!("must be at most {EFFORT_MAX}"));
            }
        }
        if self.max_in_flight == Some(0) {
            bad.add("max_in_flight", "must be at least 1");
        }
        if !(1..=100).contains(&self.complete_percent) {
            bad.add("complete_percent", "must be 1..100 percent");
        }
        let s = &self.selector;
        let named = [
            ("robots", s.robots.len()),
            ("areas", s.areas.len()),
            ("labels", s.labels.len()),
            ("models", s.models.len()),
            ("versions", s.versions.len()),
        ];
        for (field, count) in named {
            if count > NAMED_MAX {
                bad.add(format!("selector.{field}"), format!("must be at most {NAMED_MAX}"));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reason::Refusal;

    fn spec() -> RolloutSpec {
        RolloutSpec::new(BundleId::parse(&"0".repeat(64)).expect("an id"))
    }

    fn fields(spec: &RolloutSpec) -> Vec<String> {
        let mut bad = Violations::default();
        spec.check(&mut bad);
        bad.finish()
            .map_or_else(|Refusal { violations, .. }| violations.into_iter().map(|v| v.field).collect(), |()| vec![])
    }

    #[test]
    fn the_spec_of_a_person_who_names_a_bundle_breaks_no_rule() {
        assert_eq!(fields(&spec()), Vec::<String>::new());
    }

    #[test]
    fn every_broken_rule_is_told_at_once() {
        let waves = vec![Wave::Rest, Wave::Count(0), Wave::Percent(101), Wave::Version(String::new())];
        let bad = RolloutSpec {
            waves,
            probation_ms: 999,
            drain_within_ms: 0,
            max_in_flight: Some(0),
            exposure_tasks: 10_001,
            complete_percent: 0,
            lost_after_ms: 59_999,
            effort: EffortLimits { energy_permille: Some(10_001), ..EffortLimits::default() },
            ..spec()
        };
        let expected = [
            "waves[0]",
            "waves[1]",
            "waves[2]",
            "waves[3]",
            "drain_within_ms",
            "probation_ms",
            "lost_after_ms",
            "exposure_tasks",
            "effort.energy_permille",
            "max_in_flight",
            "complete_percent",
        ];
        assert_eq!(fields(&bad), expected);
        assert_eq!(fields(&RolloutSpec { complete_percent: 101, ..spec() }), ["complete_percent"]);
        assert_eq!(fields(&RolloutSpec { waves: vec![Wave::Rest], ..spec() }), ["waves"]);
        assert_eq!(
            fields(&RolloutSpec { waves: vec![Wave::Rest], allow_full_push: true, ..spec() }),
            Vec::<String>::new()
        );
    }
}
