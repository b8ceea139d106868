//! Carries out software updates for the core: its jobs, its trust in signatures, and its access to the repository.
//!
//! Modules: `jobs` defines what the core asks for. `updater` holds volatile state; `trust_anchors` holds what the robot trusts
//! from its first day. `io` does the jobs, `remote` calls the server, `migration` calls a committed program. `retry`
//! computes how long to wait after a failure.
//! Invariant: nothing is decided here. The core's module `update` decides.

pub mod io;
mod jobs;
pub(crate) mod migration;
pub mod remote;
pub(crate) mod retry;
pub mod trust_anchors;
mod updater;

pub use crate::storage::{DueMigration, HeldKeys, SoftwareRow, Update};
pub use jobs::{Done, Failure, Job};
pub use updater::UpdateConfig;
pub(crate) use updater::{Integrity, IntegrityFault, Updater};
