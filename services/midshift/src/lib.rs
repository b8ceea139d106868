//! The midshift program as a library: its commands, and simulated robots and agents in processes of their own.
//!
//! Called by `main.rs`, by the tests and by the benchmarks.

pub mod commands;
pub mod enrol_simulated;
pub mod robots;
mod software;
