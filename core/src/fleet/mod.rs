//! The law of the fleet: who gets which task, who may enter which place, what a heartbeat repairs, and why not now.
//!
//! `Fleet::cycle` takes what happened and gives items to commit and a report; the service around it only reads, commits and publishes.
//! Rooms: `rows` and `view` are what is known; `inbox`, `requests`, `timers`, `repair` are what happens; `tasks` moves tasks by
//! the table; `screen` and `assign` give work; `errands`, `places`, `desired` bring robots where they belong; `explain` says why not.
//! Invariant: no IO, no clock, no hash-map order; the same inputs give the same items.

pub mod rows;
pub mod tx;
pub mod view;
