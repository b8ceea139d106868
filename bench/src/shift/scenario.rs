//! The named workloads of a shift: what each asks for, and what goes wrong in it.

use super::workload::{Arrivals, Demand};
use midshift_proto::fleet::v1::AreaPolicy;
use midshift_sim::energy::EnergyScale;
use std::ops::Range;
use std::time::Duration;

/// Tasks of one wave, and the time between two.
const WAVE: (usize, Duration) = (40, Duration::from_secs(60));
/// The planner is away for so long in the workload where it stops.
const PLANNER_STOP: Duration = Duration::from_secs(600);
/// That workload lasts so long at least: a backlog has an hour to go then.
const W6_MIN: Duration = Duration::from_secs(2 * 3_600);

/// Tasks an hour of one robot in the shift of batteries: 1,700 for fifty.
const BATTERY_LOAD: f64 = 34.0;
/// How fast batteries empty and fill there, so that a robot at work loses the 0.02 % a second of the reference on
/// average and a charger gives its 0.06 %. One that stands loses 0.003 %. The planner believes the model still.
pub const BATTERY_RATES: EnergyScale = EnergyScale { draw_permille: 1_610, charge_permille: 1_440 };

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
    /// Steady at 34 tasks an hour a robot with batteries that empty; twice, by two rules of charging.
    W5,
    /// Saturated, on a site with a door and an aisle for one: bodies are delayed, and two of them fall silent inside.
    W7,
    /// As W2 with 1,000 and with 5,000 robots, however many are asked for.
    W8,
    /// Steady at 110 % of the saturated rate for two hours at least, with faults of bodies, and a planner that stops
    /// for ten minutes.
    W6,
}

/// What loads are multiples of.
#[derive(Clone, Copy, Debug)]
pub struct Load {
    /// Tasks in an hour of the same run while there are always some that wait; 0 where nothing depends on it.
    pub saturated_per_hour: f64,
    /// Robots that work.
    pub robots: usize,
}

/// One shift of a workload.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// Its name in figures.
    pub name: &'static str,
    /// How long it lasts.
    pub lasts: Duration,
    /// Robots that work; none: as many as were asked for.
    pub robots: Option<usize>,
    /// What is asked for.
    pub demand: Demand,
    /// Bodies fail as often as a simulated body does by itself; else they never do.
    pub faults: BodyFaults,
    /// Robots fall silent inside passages.
    pub losses: Losses,
    /// When robots charge; none: batteries do not empty.
    pub charging: Option<ChargingRule>,
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
    /// Obstacles hold them up, four times as often as usual; a person looks after those that gave up.
    Delays,
}

/// Whether robots fall silent inside a passage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Losses {
    /// They do not.
    None,
    /// Two do, one after the other.
    Two,
}

/// When robots charge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChargingRule {
    /// As areas say that say nothing: also while nothing waits.
    Opportunity,
    /// Only once they must, and then to full.
    Simple,
}

impl ChargingRule {
    /// What is put for an area, if it is other than what the area says by itself.
    pub fn change_policy(self, policy: AreaPolicy) -> Option<AreaPolicy> {
        let must = policy.charge_mandatory_permille;
        match self {
            Self::Opportunity => None,
            Self::Simple => Some(AreaPolicy {
                charge_opportunistic_permille: must,
                charge_stop_permille: Some(1_000),
                charge_preemptible_permille: Some(1_000),
                ..policy
            }),
        }
    }
}

impl Workload {
    /// Its shifts.
    pub fn scenarios(self, load: Load, lasts: Duration) -> Vec<Scenario> {
        let steady = |share: f64| Arrivals::Steady { per_hour: share * load.saturated_per_hour };
        let scenario = |name, arrivals| Scenario {
            name,
            lasts,
            robots: None,
            demand: Demand { arrivals, urgent_permille: 0 },
            faults: BodyFaults::None,
            losses: Losses::None,
            charging: None,
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
            Self::W5 => {
                let arrivals = Arrivals::Steady { per_hour: BATTERY_LOAD * load.robots as f64 };
                let charging = |name, rule| Scenario { charging: Some(rule), ..scenario(name, arrivals) };
                vec![charging("W5", ChargingRule::Opportunity), charging("W5 simple", ChargingRule::Simple)]
            }
            Self::W8 => {
                let large = |name, robots| Scenario { robots: Some(robots), ..scenario(name, Arrivals::Saturated) };
                vec![large("W8 of 1,000", 1_000), large("W8 of 5,000", 5_000)]
            }
            Self::W7 => {
                let delayed = Scenario { faults: BodyFaults::Delays, ..scenario("W7", Arrivals::Saturated) };
                vec![Scenario { losses: Losses::Two, ..delayed }]
            }
            Self::W6 => {
                let lasts = lasts.max(W6_MIN);
                let planner_stop = Some(lasts / 3..lasts / 3 + PLANNER_STOP);
                vec![Scenario { lasts, faults: BodyFaults::Usual, planner_stop, ..scenario("W6", steady(1.1)) }]
            }
        }
    }

    /// Seeds that it is run with at most: a thousand robots take long.
    pub fn seeds_max(self) -> usize {
        if self == Self::W8 { 1 } else { usize::MAX }
    }

    /// Target of the design that its time by the wall answers.
    pub fn target_of_wall(self) -> &'static str {
        if self == Self::W8 { "P11" } else { "P7" }
    }

    /// Whether its load depends on the saturated rate.
    pub fn needs_saturated_rate(self) -> bool {
        matches!(self, Self::W1 | Self::W4 | Self::W6)
    }
}
