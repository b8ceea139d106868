//! What fleet knows: rows by table, what is derived from them, and what only this process knows.
//!
//! In reading order: `rows` and `command` are what fleet alone writes; `queue`, `memory` and `refused` are parts of the projection; `state` is
//! the projection; `index` keeps what is derived, `loading` reads rows into it; `liveness` and `objects` answer from it whether a robot is
//! heard, and who may see what. Invariant: nothing here decides: this room makes no item and uses no other room.

pub mod command;
pub mod index;
pub mod liveness;
pub mod loading;
pub mod memory;
pub mod objects;
pub mod queue;
pub mod refused;
pub mod rows;
pub mod state;

pub use crate::projection::{Rowed, Slot};
pub use loading::{alive, named};
pub use state::FleetProjection;
