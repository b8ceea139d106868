//! Fleet stop as a service: stops are engaged at once, kept in files of its own, told to every robot, and shown as each robot itself confirms them.
//!
//! An operational stop request: not a safety function, no performance level. The independent emergency stop is the hardware of the robot's maker and
//! integrator, whose state midshift shows and never replaces; midshift is not suitable as part of a safety system.
//!
//! Called by its program, [`program`], and by `dev`: [`StopService::open`], [`StopService::routes`], [`StopService::run`] and [`serve`]. Invariant: nothing of the store, the task
//! queue or another service lies on its way; an engage waits for no robot, and for the disk only with its answer; a folder without its memory, or one that
//! cannot be read, begins with the fleet stopped. Absent on purpose: who may come in: that is the port's, and is told here only so that it can be recorded.

pub mod audit;
mod changes;
mod confirm;
mod disk;
mod downlink;
mod engaged;
mod error;
mod first_start;
mod folder;
mod frames;
mod grpc;
mod holder;
mod inner;
mod line;
mod opening;
mod outbox;
pub mod port;
pub mod program;
mod proof;
mod robot_rpc;
mod robots;
mod service;
mod site_index;
mod snapshot;
mod status;
mod threads;
mod writer;

pub use error::Error;
pub use first_start::{FIRST, announce_first_start, withdraw_first_start};
pub use folder::{latch, verify};
pub use holder::{HOLDER, NotEnded, end_holder, is_held};
pub use inner::Parts;
pub use service::{StopService, serve};
pub use snapshot::{Copied, Principals, Roster};
