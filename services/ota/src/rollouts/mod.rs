//! Roll-outs as a service: reads the feed and the heartbeats, lets `core::rollout` decide, signs, commits, answers
//! questions.
//!
//! Called by the server: [`RolloutService::new`], its gRPC face, and [`Planner::run`]. Invariant: nothing is decided
//! here; a lost wake costs one sweep; what is signed was decided by the planner and is committed with the row that
//! explains it.

mod decode;
mod directives;
mod encode;
mod ended;
mod grpc;
mod list;
mod reconcile;
mod releases;
mod requests;
mod service;
mod standby;
mod watch;

pub use directives::Signer;
pub use reconcile::{Parts, Planner};
pub use releases::known_bundles;
pub use service::RolloutService;
