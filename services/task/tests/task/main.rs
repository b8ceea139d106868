//! Task intake over the in-memory store, through its gRPC face, with fleet played by `core::fleet` where it must answer.

mod asks;
mod batch;
mod changes;
#[path = "../../../../tests/src/counted.rs"]
mod counted;
mod errors;
mod forms;
mod intake;
mod lists;
mod lookups;
mod many;
mod prune;
mod reach;
mod types;
mod watches;
mod world;
