//! Which robot gets which task, and which errand a robot gets that is left.
//!
//! In reading order: `readiness` brings the queue up to now. `demand` is what is left of a task, `filters` says
//! why a robot gets no work, `estimate` when it is free.
//! `offers` writes an assignment; `rolling` and `nearest` (with its `candidates`) each choose what to give to whom, and `assign` asks
//! the one that the policy names. `errands` sends idle robots to charge and park. Invariant: a robot that gets nothing has a reason
//! by code.

pub mod assign;
pub mod candidates;
pub mod demand;
pub mod errands;
pub mod estimate;
pub mod filters;
pub mod nearest;
pub mod offers;
pub mod readiness;
pub mod rolling;
