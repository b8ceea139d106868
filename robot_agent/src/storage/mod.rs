//! What a robot remembers: the ledger of its work and software, the ring of its samples, and the stores that keep both.
//!
//! Rooms, from below: `device`, `rows`, `software` and `proven` are what lies in the ledger; `op` is one change;
//! `ledger` and `ring` apply changes; `store` is the contract, `memory` and `sqlite` keep it. Invariant: no IO but in
//! the two stores.

pub mod device;
pub mod ledger;
pub mod memory;
mod op;
pub mod proven;
pub mod ring;
mod rows;
mod software;
pub mod sqlite;
pub mod store;

pub use device::DeviceKey;
pub use ledger::Ledger;
pub use op::Op;
pub use proven::Proven;
pub use ring::Ring;
pub use rows::{Applied, Holder, Intent, PlacesRow, SessionMemory, SubjectRow};
pub use software::{DueMigration, HeldKeys, SoftwareRow, Update};
pub use store::{RobotMemory, Store};
