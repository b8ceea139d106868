//! Fleet stop beside the core: what a robot was told, what it says of that, and what must be kept.
//!
//! Rooms: `messages` is what passes on the line, `known` what the robot knows and when it must say something; `line` is
//! the shell's connection to the stop service, `keep` the file. What the body does about it is the core's. Invariant: a
//! stop is obeyed before it is written or answered.

pub mod keep;
mod known;
pub mod line;
mod messages;

pub(crate) use known::{Floor, Stops};
pub(crate) use messages::StopOrder;
pub use messages::{CheckIn, StopNews};
