//! The real reconciler over a store in memory, with robots and telemetry played by a script: what the law of the fleet promises,
//! one sentence a test. Time is tokio's paused clock; nothing here waits in real time.

mod harness;

mod drains;
mod errands;
mod explain;
mod holds;
mod offers;
mod people;
mod picture;
mod places;
mod races;
mod restart;
mod retries;
mod stopping;
mod twins;
mod uncertain;
mod waiting;
