//! Fleet stop: the law that the stop service and every robot share. An operational stop request, not a safety function.
//!
//! A stop is named, engaged once and reset by its name. Both are facts that only add up ([`latch`]), so it does not matter in which order, how
//! often or by which way a robot hears of them. Who lies inside a stop decides each robot by its own pose ([`region`]); who hears nothing slows
//! down and stands by itself ([`ladder`]); what all of it comes to for one robot is [`robot`], and what people are shown of it [`roster`].
//!
//! Invariant: nothing here makes a robot move that stood. A reset takes a stop away and leaves `resume:<id>`; only a person's resume ends that.
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
