//! What a release of robot software makes a simulated robot do: `behaviour.toml`, a component of its set.
//!
//! A new version changes what the robot really does, so that a roll-out has something true to see: good releases, ones
//! that wear, and ones that crash, hang, or go wrong only under load. Invariant: it never drives faster than it is
//! asked to. Speed, faults, energy and heat are the body's ([`crate::body`]); crash and hang are the program's that
//! runs it.

use crate::faults::FaultRates;
use midshift_core::reason::{Refusal, Violations};
use midshift_core::robot::Load;
use serde::Deserialize;
use std::fs::File;
use std::io::{self, Read};
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// Name of the component, which is of kind config.
pub const COMPONENT: &str = "behaviour";
/// Bytes of the file.
pub const FILE_BYTES_MAX: u64 = 64 * 1024;
const SPEED_PERMILLE: RangeInclusive<u32> = 100..=1_000;
const FAULT_RATE_PERMILLE: RangeInclusive<u32> = 0..=1_000_000;
const ENERGY_PERMILLE: RangeInclusive<u32> = 100..=10_000;
const CLIMB_MILLIDEGREES_PER_S: RangeInclusive<u32> = 0..=10_000;

/// A behaviour. What a file does not name is as in a robot that has none.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Behaviour {
    /// How fast it drives of what it is asked for, 100..=1000.
    pub speed_permille: u32,
    /// Obstacles met, picks missed and jams, of the body's own rates, 0..=1000000.
    pub fault_rate_permille: u32,
    /// Energy taken from the battery, of the body's own, 100..=10000.
    pub energy_permille: u32,
    /// Its program ends with an error at once.
    pub crash_on_start: bool,
    /// So long after its start its program hangs, if it is on probation; none: it does not.
    pub hang_in_probation_after_ms: Option<u64>,
    /// Its hottest joint warms by so much on top of its work, without end, 0..=10000.
    pub joint_temperature_climb_millidegrees_per_s: u32,
    /// The other rate of faults holds only while it carries something.
    pub faults_only_with_load: bool,
}

impl Default for Behaviour {
    fn default() -> Self {
        Self {
            speed_permille: 1_000,
            fault_rate_permille: 1_000,
            energy_permille: 1_000,
            crash_on_start: false,
            hang_in_probation_after_ms: None,
            joint_temperature_climb_millidegrees_per_s: 0,
            faults_only_with_load: false,
        }
    }
}

/// A behaviour that could not be read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file.
    #[error("reading {path}: {source}")]
    Io {
        /// The file that was read.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Its content.
    #[error("{path}: {refusal}")]
    Refused {
        /// The file that was read.
        path: PathBuf,
        /// Every broken rule.
        refusal: Box<Refusal>,
    },
}

impl Behaviour {
    /// Reads a file.
    ///
    /// # Errors
    /// If it cannot be read; or everything that is wrong with it.
    pub fn read(path: &Path) -> Result<Self, Error> {
        let read = || {
            let mut text = String::new();
            File::open(path)?.take(FILE_BYTES_MAX + 1).read_to_string(&mut text)?;
            if text.len() as u64 > FILE_BYTES_MAX { Err(io::ErrorKind::FileTooLarge.into()) } else { Ok(text) }
        };
        let text = read().map_err(|source| Error::Io { path: path.to_owned(), source })?;
        Self::parse(&text).map_err(|refusal| Error::Refused { path: path.to_owned(), refusal: Box::new(refusal) })
    }

    /// From the text of a file.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn parse(text: &str) -> Result<Self, Refusal> {
        let this: Self = toml::from_str(text).map_err(|e| Refusal::field(COMPONENT, e.message()))?;
        let mut bad = Violations::default();
        let mut within = |field: &str, value: u32, range: RangeInclusive<u32>| {
            if !range.contains(&value) {
                bad.add(field, format!("must be {} to {}", range.start(), range.end()));
            }
        };
        within("speed_permille", this.speed_permille, SPEED_PERMILLE);
        within("fault_rate_permille", this.fault_rate_permille, FAULT_RATE_PERMILLE);
        within("energy_permille", this.energy_permille, ENERGY_PERMILLE);
        let climb = this.joint_temperature_climb_millidegrees_per_s;
        within("joint_temperature_climb_millidegrees_per_s", climb, CLIMB_MILLIDEGREES_PER_S);
        bad.finish()?;
        Ok(this)
    }

    /// How often things go wrong in a body with these rates of its own. Networks and people are no matter of software.
    pub fn rates(&self, own: &FaultRates, load: Option<&Load>) -> FaultRates {
        if self.faults_only_with_load && load.is_none() {
            return *own;
        }
        let changed = own.times(f64::from(self.fault_rate_permille) / 1000.0);
        FaultRates { silence_per_hour: own.silence_per_hour, manual_per_hour: own.manual_per_hour, ..changed }
    }

    /// The speed it drives at, millimetres per second, of the one it is asked for.
    pub fn speed_mm_s(&self, asked_mm_s: u32) -> u32 {
        (u64::from(asked_mm_s) * u64::from(self.speed_permille) / 1000) as u32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_says_only_what_is_other_and_is_refused_with_all_that_is_wrong() {
        assert_eq!(Behaviour::parse(""), Ok(Behaviour::default()));
        let slow = Behaviour { speed_permille: 700, crash_on_start: true, ..Behaviour::default() };
        assert_eq!(Behaviour::parse("speed_permille = 700\ncrash_on_start = true\n"), Ok(slow));
        let fields = |text: &str| {
            let refusal = Behaviour::parse(text).expect_err("is refused");
            refusal.violations.into_iter().map(|v| v.field).collect::<Vec<_>>()
        };
        assert_eq!(fields("speed = 700"), ["behaviour"]);
        assert_eq!(fields("speed_permille = 1001\nenergy_permille = 0"), ["speed_permille", "energy_permille"]);
        assert_eq!(
            fields("joint_temperature_climb_millidegrees_per_s = 10001\nfault_rate_permille = 1000001"),
            ["fault_rate_permille", "joint_temperature_climb_millidegrees_per_s"]
        );
    }

    #[test]
    fn networks_and_people_are_as_they_were_and_faults_may_need_a_load() {
        let own = FaultRates { manual_per_hour: 0.1, ..FaultRates::default() };
        let load = Load { task_id: None, item: "SKU-1".to_owned() };
        let bad = Behaviour { fault_rate_permille: 20_000, ..Behaviour::default() };
        let rates = bad.rates(&own, None);
        assert_eq!((rates.silence_per_hour, rates.manual_per_hour), (own.silence_per_hour, own.manual_per_hour));
        assert_eq!(rates.obstacle_per_km, own.obstacle_per_km * 20.0);
        let loaded = Behaviour { faults_only_with_load: true, ..bad };
        assert_eq!((loaded.rates(&own, None), loaded.rates(&own, Some(&load))), (own, rates));
        assert_eq!(Behaviour::default().rates(&own, Some(&load)), own);
    }
}
