//! The named workloads of a shift: what each asks for, and what goes wrong in it.

use super::workload::{Arrivals, Demand};
use std::ops::Range;
use std::time::Duration;

/// Tasks of one wave, and the time between two.
const WAVE: (usize, Duration) = (40, Duration::from_secs(60));
/// The planner is away for so long in the workload where it stops.
const PLANNER_STOP: Duration = Duration::from_secs(600);

/// A workload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Workload {
    /// Steady, at 60 % and at 95 % of the saturated rate.
    W1,
    /// Saturated: there are always tasks that wait.
    W2,
    /// Waves of 40 tasks each minute.
    W3,
    /// Steady at 95 % of the saturated rate; one task in ten is urgent.
    W4,
    /// Steady at 110 % of the saturated rate, with faults of bodies, and a planner that stops for ten minutes, or for a
    /// twelfth of a shift of less than two hours.
    W6,
}

/// One shift of a workload.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// Its name in figures.
    pub name: &'static str,
    /// What is asked for.
    pub demand: Demand,
    /// Bodies fail as often as a simulated body does by itself; else they never do.
    pub faults: BodyFaults,
    /// When the planner is away.
    pub planner_stop: Option<Range<Duration>>,
}

/// Whether bodies fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BodyFaults {
    /// They do not.
    None,
    /// As in `dev`; a person looks after them.
    Usual,
}

impl Workload {
    /// Its shifts, with loads that are multiples of the saturated rate of the same run.
    pub fn scenarios(self, saturated_per_hour: f64, lasts: Duration) -> Vec<Scenario> {
        let steady = |share: f64| Arrivals::Steady { per_hour: share * saturated_per_hour };
        let scenario = |name, arrivals| Scenario {
            name,
            demand: Demand { arrivals, urgent_permille: 0 },
            faults: BodyFaults::None,
            planner_stop: None,
        };
        match self {
            Self::W1 => vec![scenario("W1 60 %", steady(0.6)), scenario("W1 95 %", steady(0.95))],
            Self::W2 => vec![scenario("W2", Arrivals::Saturated)],
            Self::W3 => vec![scenario("W3", Arrivals::Waves { tasks: WAVE.0, every: WAVE.1 })],
            Self::W4 => {
                let demand = Demand { arrivals: steady(0.95), urgent_permille: 100 };
                vec![Scenario { demand, ..scenario("W4", demand.arrivals) }]
            }
            Self::W6 => {
                let begins = lasts / 3;
                let planner_stop = Some(begins..begins + PLANNER_STOP.min(lasts / 12));
                vec![Scenario { faults: BodyFaults::Usual, planner_stop, ..scenario("W6", steady(1.1)) }]
            }
        }
    }

    /// Whether its load depends on the saturated rate.
    pub fn needs_saturated_rate(self) -> bool {
        matches!(self, Self::W1 | Self::W4 | Self::W6)
    }
}
