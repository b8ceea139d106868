//! Fleet stop: the rules that the stop service and every robot share. An operational request, not a safety function.
//!
//! A stop is engaged once and reset once, by its name. Both facts only accumulate ([`latch`]), so their order, number
//! and path to a robot do not matter. Each robot decides by its own pose whether it lies inside a stop ([`region`]). A
//! robot that hears nothing slows down, then stands ([`ladder`]). [`robot`] computes the level that one robot obeys;
//! [`roster`] computes what people are shown of it.
//!
//! Invariant: nothing here moves a robot that stands. A reset ends a stop and leaves `resume:<id>`, which only a
//! person's resume removes.
//! Absent on purpose: the store, the task queue, a level that cuts power.

pub mod hung;
pub mod ladder;
pub mod latch;
pub mod record;
pub mod region;
pub mod robot;
pub mod roster;
pub mod scope;

pub use latch::{Latch, Reset, Stop};
pub use region::Region;
pub use scope::Scope;

/// The folder of the stop service's files, below the data folder of its server.
pub const FOLDER: &str = "stop";
/// The file in that folder with what a stop service writes that `serve` started.
pub const LOG: &str = "log";
/// Port of the stop service, beside the 7420 of the business.
pub const PORT: u16 = 7421;
