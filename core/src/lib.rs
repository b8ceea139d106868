//! The law of midshift: what a task, an attempt, a robot and a place are, and every rule about them.
//!
//! Invariant: nothing here does IO, reads a clock, draws a random number by itself or awaits. Functions take
//! `now` and values and return values; services act on what is returned.

pub mod audit;
pub mod authority;
pub mod bugs;
pub mod desired_state;
pub mod drain_request;
pub mod energy;
pub mod fleet;
pub mod flood;
pub mod gates;
pub mod heartbeat;
pub mod idempotency;
pub mod identity;
pub mod ids;
pub mod item;
pub mod leadership;
pub mod limits;
pub mod nearest;
pub mod overload;
pub mod planner_policy;
pub mod policy;
pub mod presence;
pub mod privacy;
pub mod projection;
pub mod reason;
pub mod robot;
pub mod robot_events;
pub mod rollout;
pub mod rows;
pub mod session;
pub mod site;
pub mod step;
pub mod stop;
pub mod task;
pub mod time;
pub mod unknown_rows;
pub mod update;
pub mod wall_clock;

use std::pin::Pin;

/// What a door of a service answers with that goes on for long: its code is compiled where it is written, not where it is awaited.
pub type Boxed<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;
