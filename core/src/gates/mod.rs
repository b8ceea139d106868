//! Numbers behind a gate of a roll-out: what so many robots and tasks prove of new software, and what they do not.
//!
//! Invariant: the same counts give the same verdict on every machine and at every replay. Logarithms are whole micro-nats worked out in
//! integers; floating point, where there is any, only adds, multiplies and divides, which IEEE 754 rounds in one way.
//! Called by the rollout service, which latches an abort with the evidence that made it: a verdict here knows no yesterday.

mod bound;
mod effort;
mod evidence;
mod fixed;
mod sprt;

pub use bound::{false_abort_permille, upper_bound_permille};
pub use effort::{Effort, EffortLimits, Efforts};
pub use evidence::{FailureEvidence, Suspicion, TaskTally};
pub use sprt::{OutcomeEvidence, RobotOutcomes, Verdict};

/// Rate of failing robots of a release that is good enough, permille.
pub const GOOD_PERMILLE: u16 = 20;
/// Rate of failing robots of a release that must not go on, permille.
pub const BAD_PERMILLE: u16 = 200;
/// How often the sequential test may abort a good release, permille: α.
pub const FALSE_ABORT_PERMILLE: u16 = 50;
/// How often the sequential test may promote a bad release, permille: β.
pub const FALSE_PROMOTE_PERMILLE: u16 = 100;
/// What a bound of the failure rate may be wrong, permille: one-sided 95 %.
pub const BOUND_ERROR_PERMILLE: u16 = 50;
/// With fewer robots attempted than this, one failure is judged by policy: no number of robots lets the sequential test abort on it.
pub const FEW_ROBOTS: u32 = 10;
/// How many times as often tasks fail on a bad release as beside it: the alternative R of the test of task failures.
pub const FAILURE_RATIO: u64 = 3;
/// Evidence E at which task failures speak for an abort. By Ville's inequality a release that is no worse gets there in 1 of 20 roll-outs at most.
pub const ABORT_EVIDENCE: u64 = 20;
