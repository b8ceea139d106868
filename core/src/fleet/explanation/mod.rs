//! Says why: what a task or a robot waits for, and what stands that nobody can explain.
//!
//! In reading order: `wait_reasons` says what is done or waited for; `explain` tells a person; `unexplained` counts what has no reason; `lasting`
//! opens incidents of robots that stand for long; `figures` counts what robots do. Invariant: an answer is made by the filters and the grants themselves, never by a copy.

pub mod explain;
pub mod figures;
pub mod lasting;
pub mod unexplained;
pub mod wait_reasons;
