//! The midshift binary as a library: wiring of services, `dev`, `serve`, robots in processes, and the commands that start them.
//!
//! Called by `main.rs`, by the tests and by the benchmarks. Of a server's
//! configuration, environment and clock nothing is read elsewhere.

pub mod backup;
mod changed_map;
pub mod clock_doubt;
mod clock_jump;
pub mod commands;
mod components;
mod denials;
pub mod dev;
pub mod enrol_simulated;
mod housekeeping;
#[cfg(test)]
mod old_connections {
    mod tests;
}
pub mod planning;
pub mod robots;
pub mod serve;
pub mod server;
mod software;
pub mod stop;
pub mod stop_follower;
pub mod storage;

pub use midshift_process::{clock, door, logs, recorder};

#[cfg(test)]
#[path = "../../../tests/src/postgres.rs"]
#[expect(dead_code, reason = "other tests need more of it")]
mod postgres_server;
