//! The agent's decisions without IO: `step(now, input)` drives the body and returns what to store and to send.
//!
//! Modules, from the lowest to the highest: `interface` defines inputs and outputs. `work`, `load`, `places`, `lanes`,
//! `throttle` and `governor` are values with their rules. `state` holds them all. `attempt`, `drive`, `offer`, `stops`,
//! `installed` and `update` decide. `step` dispatches one input.
//! Invariant: no clock, no randomness, no waiting. Called by the shell ([`crate::session`]) and by simulations.

mod attempt;
mod drive;
mod governor;
mod installed;
mod interface;
mod lanes;
mod load;
mod offer;
mod places;
mod state;
mod step;
mod stops;
mod throttle;
mod update;
mod work;

pub use interface::{CoreConfig, ExitReason, Input, Output, Wake};
pub use state::AgentCore;
