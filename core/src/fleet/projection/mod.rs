//! Fleet's projection: its rows by table, indices derived from them, and memory of this process alone.
//!
//! In reading order: `rows` and `command` define the rows that only fleet writes. `queue`, `ready`, `same_key`, `memory`, `chosen`, `plans`,
//! `start_estimates`, `broken_steps` and `refused` are parts of the projection, and `state` is the whole. `index` updates the indices; `loading` reads rows in. `liveness`
//! answers whether a robot is heard, `objects` whether a caller may act on something.
//! Invariant: nothing here decides: this module makes no item and uses no sibling module.

pub mod broken_steps;
pub mod chosen;
pub mod command;
pub mod index;
pub mod liveness;
pub mod loading;
pub mod memory;
pub mod objects;
pub mod plans;
pub mod queue;
pub mod ready;
pub mod refused;
pub mod rows;
pub mod same_key;
pub mod start_estimates;
pub mod state;

pub use crate::projection::{RevisedRow, RowMap};
pub use loading::{alive, named};
pub use state::FleetProjection;
