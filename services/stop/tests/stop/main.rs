//! The stop service over real connections and real files.

#![expect(clippy::unwrap_used, reason = "a test that unwraps fails with the place where it did")]

mod audit;
mod confirmed;
mod disk;
mod harness;
mod kept;
mod killed;
mod lines;
mod lost;
mod reach;
#[expect(dead_code, reason = "shared with the agent's tests, which ask for more")]
#[path = "../../../../tests/src/strace.rs"]
mod strace;
