//! Numbers behind a gate of a roll-out: what so many robots and tasks prove of new software, and what they do not.
//!
//! Invariant: the same counts give the same verdict on every machine and at every replay. Logarithms are whole micro-nats worked out in
//! integers; floating point, where there is any, only adds, multiplies and divides, which IEEE 754 rounds in one way.
//! Called by the rollout service, which latches an abort with the evidence that made it: a verdict here knows no yesterday.

mod bound;
mod effort;
mod evidence;
mod fixed;
mod rates;
mod sprt;

pub use bound::{RobotOutcomes, false_abort_permille, upper_bound_permille};
pub use effort::{Effort, EffortLimits, Efforts};
pub use evidence::{FailureEvidence, Suspicion, TaskTally};
pub use rates::{
    ABORT_EVIDENCE, BAD_PERMILLE, BOUND_ERROR_PERMILLE, FAILURE_RATIO, FALSE_ABORT_PERMILLE, FALSE_PROMOTE_PERMILLE,
    FEW_ROBOTS, GOOD_PERMILLE,
};
pub use sprt::{OutcomeEvidence, Verdict};
