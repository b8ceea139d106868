//! What a robot runs: the session to the server, the ring of samples, the ledger of work, the governor, and the body it drives.
//!
//! A maker implements [`body::Body`] and calls [`run`]; `examples/own_robot.rs` does.
//! Invariant: a buffered message never starts the body, and a finished task is never done again.

pub mod body;
pub mod boot;
pub mod bugs;
pub mod bulk;
pub mod core;
pub mod device;
pub mod dial;
mod drive;
pub mod enrolment;
pub mod environment;
pub mod governor;
mod installed;
pub mod lanes;
pub mod launcher;
pub mod ledger;
mod load;
pub mod memory;
mod offer;
pub mod places;
pub mod program;
pub mod pulse;
mod repeats;
pub mod replay;
pub mod ring;
pub mod session;
pub mod sets;
pub mod sqlite;
pub mod starts;
pub mod stop;
pub mod store;
pub mod switch;
pub mod throttle;
pub mod tls;
pub mod trust;
pub mod update;
pub mod work;

pub use midshift_os::clock;
pub use program::{Config, run};
