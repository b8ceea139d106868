//! What releases left behind, read by this build: stores, robots' memory, frames of the link. And the run that leaves it.
//!
//! `tests/fixtures/VERSION` is what a real run of that release wrote; see [`midshift_tests::released`] and docs/decisions/0038.

#[path = "../e2e/engine.rs"]
mod engine;
#[path = "../e2e/harness.rs"]
#[expect(dead_code, reason = "the end-to-end tests use the rest of it")]
mod harness;
#[path = "../e2e/secrets.rs"]
#[expect(dead_code, reason = "the end-to-end tests use the rest of it")]
mod secrets;

mod carried;
mod frames;
mod plant;
mod recorded;
mod robots;
mod run;
mod schemas;
mod stores;
mod tap;
