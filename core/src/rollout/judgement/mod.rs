//! What counts for and against a bundle, and how a roll-out ends.
//!
//! In reading order: `failures` notes what counts against a bundle, `refusals` sorts what robots would not take;
//! `infrastructure` and `jams` tell a lost or jammed robot from a bad network or a jammed floor; `effort` is what work
//! costs; `verdict` judges a wave, `ending` the whole.

pub mod effort;
pub mod ending;
pub mod failures;
pub mod infrastructure;
pub mod jams;
pub mod refusals;
pub mod verdict;
