//! Rates that a gate tells apart, and how often it may be wrong.

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
