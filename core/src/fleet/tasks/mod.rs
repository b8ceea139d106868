//! Moves tasks and attempts by the table, and judges what robots say of them.
//!
//! In reading order: `attempts` begins them; `load`, `claims`, `plausible` and `arrivals` judge a robot's word; `eligibility` says which robot
//! could do a task; `breaker` and `place_breaker` count failures, `energy_sums` what work took; `transitions` moves a task, `errand_reports` an errand; `timers` fires deadlines. Invariant: a
//! task changes its phase in `transitions` only, and only by the table of [`crate::task::machine`].

pub mod arrivals;
pub mod attempts;
pub mod breaker;
pub mod claims;
pub mod eligibility;
pub mod energy_sums;
pub mod errand_reports;
pub mod load;
pub mod place_breaker;
pub mod plausible;
pub mod timers;
pub mod transitions;
