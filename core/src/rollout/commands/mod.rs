//! What people ask of roll-outs and of robots' software.
//!
//! In reading order: `objects` says who may ask it, `dry_run` what it would come to, `check` whether it fits what is
//! known, `carry_out` does it, `audit` notes it.

mod audit;
pub mod carry_out;
pub(in crate::rollout) mod check;
pub mod dry_run;
pub mod objects;
