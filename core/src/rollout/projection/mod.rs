//! The rollout service's projection: requests of people, rows by table, and indices derived from them.
//!
//! In reading order: `spec` and `requests` define what people ask. `timestamp` and `rows` define what is stored.
//! `queue` finds the robots whose turn it is. `state` is the projection, and `index` updates its indices. `ended` keeps
//! the roll-outs that have ended and are still needed. `retention` finds the bundles that are still needed.
//! Invariant: nothing here decides: this module makes no item and uses no sibling module.

pub mod ended;
mod index;
pub mod queue;
pub mod requests;
pub mod retention;
pub mod rows;
pub mod spec;
pub mod state;
pub mod timestamp;

pub use crate::projection::{RevisedRow, RowMap};
pub use state::RolloutProjection;
