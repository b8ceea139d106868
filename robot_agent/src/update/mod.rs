//! The robot's updates beside the core: the jobs and who does them, what it believes, and the way to the repository.
//!
//! Rooms: `jobs` is what the core asks for, `updater` what it knows meanwhile, `trust` what it believes from its first
//! day; `io` does the jobs, `remote` asks the server, `migration` calls a committed program; `retry` says how long is
//! waited for what failed. Invariant: nothing is decided here. The core's room `update` decides.

pub mod io;
mod jobs;
pub(crate) mod migration;
pub mod remote;
pub(crate) mod retry;
pub mod trust;
mod updater;

pub use crate::storage::{DueMigration, HeldKeys, SoftwareRow, Update};
pub use jobs::{Done, Failure, Job};
pub use updater::UpdateConfig;
pub(crate) use updater::{Bad, Standing, Updater};
