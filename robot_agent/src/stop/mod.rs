//! Connects a robot to the stop service: receives stops, stores them, and reports them in check-ins.
//!
//! Modules: `messages` defines what passes on the line. `state` holds the robot's stops and decides when to check in.
//! `line` is the connection of the shell, `storage` the file. The core decides what the body does.
//! Invariant: a stop is obeyed before it is written or answered.

pub mod line;
mod messages;
mod state;
pub mod storage;

pub(crate) use messages::StopOrder;
pub use messages::{CheckIn, StopNews};
pub(crate) use state::{Floor, StopState};
