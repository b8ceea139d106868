//! Tests of the store through its public face: one contract over all engines, projections, and what outlives a process.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

mod audit;
mod coarse;
mod contract;
mod copied;
mod copied_wrong;
mod failure;
mod heard;
#[path = "../../../../tests/src/line.rs"]
mod line;
mod partition;
mod postgres;
mod postgres_failure;
mod postgres_tls;
mod projection;
mod reopen;
#[expect(dead_code, reason = "other crates' tests use the rest of it")]
#[path = "../../../../tests/src/postgres.rs"]
mod server;
#[expect(dead_code, reason = "other crates' tests use the rest of it")]
#[path = "../../../../tests/src/strace.rs"]
mod strace;
mod support;
mod synced;
mod turns;
