//! The agent without IO: `step(now, input)` decides, drives the body, and says what to keep and what to send.
//!
//! Rooms, from below: `interface` is what passes between it and the shell; `work`, `load`, `places`, `lanes`,
//! `throttle` and `governor` are values with their rules; `state` is what it knows; `attempt`, `drive`, `offer`,
//! `stops`, `installed` and `update` decide; `step` is on top. Invariant: no clock, no randomness, no waiting. Called
//! by the shell ([`crate::session`]) and by simulations.

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
