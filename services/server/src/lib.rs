//! A server out of the services of its roles: what `serve` and `dev` start, on which store, beside which stop service.
//!
//! Invariant: the configuration, the environment and the clock of a server are read here, and by no service.

pub mod changed_map;
pub mod clock_doubt;
mod clock_jump;
mod components;
mod denials;
mod housekeeping;
pub mod keep_limits;
pub mod planning;
pub mod serve;
mod server;
pub mod stop_follower;
pub mod stop_service;
pub mod storage;

pub use components::{Components, NaiveRules};
pub use server::Server;

#[cfg(test)]
#[path = "../../../tests/src/postgres.rs"]
#[expect(dead_code, reason = "other tests need more of it")]
mod postgres_server;
