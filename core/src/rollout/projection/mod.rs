//! What the rollout service knows: what people ask for, rows by table, and what is derived from them.
//!
//! In reading order: `spec` and `requests` are what is asked for, `timestamp` and `rows` are what is written down;
//! `queue` says whose turn it is; `state` is the projection, `index` keeps what is derived from its rows, `ended` what
//! it holds of roll-outs that have ended, `retention` which bundles are still needed. Invariant: nothing here decides:
//! this room makes no item and uses no other room.

pub mod ended;
mod index;
pub mod queue;
pub mod requests;
pub mod retention;
pub mod rows;
pub mod spec;
pub mod state;
pub mod timestamp;

pub use crate::projection::{Rowed, Slot};
pub use state::RolloutProjection;
