//! Rules of the planner as a command line changes them.

use crate::{area, duration};
use clap::ValueEnum;
use midshift_proto::fleet::v1;
use std::time::Duration;

/// How robots are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Policy {
    /// All tasks that may be given at once, by least cost, with an eye to robots that are free soon.
    Rolling,
    /// Tasks in the order of the queue, each to the nearest robot that is free. Reads no other rule.
    FifoNearest,
}

/// What is to change; what is not named stays.
#[derive(clap::Args, Default)]
pub struct Rules {
    /// How robots are chosen.
    #[arg(long)]
    pub policy: Option<Policy>,
    /// A robot that is free within this time is taken into account already, at most 60s; 0s: none is.
    #[arg(long, value_parser = duration)]
    pub horizon: Option<Duration>,
    /// What a second on the way to an urgent task weighs, 1 to 100.
    #[arg(long, value_name = "WEIGHT")]
    pub urgent_weight: Option<u32>,
    /// The same of a normal task.
    #[arg(long, value_name = "WEIGHT")]
    pub normal_weight: Option<u32>,
    /// The same of a background task.
    #[arg(long, value_name = "WEIGHT")]
    pub background_weight: Option<u32>,
    /// What a task gains by each second that it has waited, in thousandths of a second on the way.
    #[arg(long, value_name = "PERMILLE")]
    pub ageing: Option<u32>,
    /// What each second past a deadline weighs, in thousandths of a second on the way.
    #[arg(long, value_name = "PERMILLE")]
    pub lateness: Option<u32>,
    /// What must be gained, in time on the way, before a task is meant for another robot than it was; at most 60s.
    #[arg(long, value_parser = duration)]
    pub hysteresis: Option<Duration>,
    /// What each watt-hour weighs that a robot takes more than a usual one on its way to a task, in milliseconds on the way;
    /// 0: nothing.
    #[arg(long, value_name = "MS")]
    pub energy_weight: Option<u32>,
}

impl Rules {
    /// The rules after the change.
    pub fn over(self, old: v1::PlannerPolicy) -> v1::PlannerPolicy {
        let policy = self.policy.map(|policy| match policy {
            Policy::Rolling => v1::AssignmentPolicy::Rolling as i32,
            Policy::FifoNearest => v1::AssignmentPolicy::FifoNearest as i32,
        });
        v1::PlannerPolicy {
            policy: policy.or(old.policy),
            horizon: self.horizon.map(area::milliseconds).or(old.horizon),
            urgent_travel_weight: self.urgent_weight.or(old.urgent_travel_weight),
            normal_travel_weight: self.normal_weight.or(old.normal_travel_weight),
            background_travel_weight: self.background_weight.or(old.background_travel_weight),
            ageing_permille: self.ageing.or(old.ageing_permille),
            lateness_permille: self.lateness.or(old.lateness_permille),
            hysteresis: self.hysteresis.map(area::milliseconds).or(old.hysteresis),
            energy_ms_per_wh: self.energy_weight.or(old.energy_ms_per_wh),
            ..old
        }
    }
}
