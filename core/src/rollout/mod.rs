//! Plans roll-outs: which robot takes which bundle and when, how each is judged, and how robots go back.
//!
//! [`cycle()`] turns new facts into items to commit. The service around it reads, signs, commits and publishes.
//! Modules, from the lowest to the highest; each uses only those before it:
//! 1. [`projection`]: requests, rows by table, and indices derived from them.
//! 2. [`decision`]: turns one decision into one item, and composes directives.
//! 3. [`members`]: assigns robots to roll-outs and waves, and bundles to robots that come later.
//! 4. [`judgement`]: weighs what speaks for and against a bundle, and decides how a roll-out ends.
//! 5. [`robots`]: finds and writes the next move of each robot.
//! 6. [`phases`]: moves a roll-out through waves, gates and pauses, and takes it back.
//! 7. [`facts`]: applies feed entries and the reports of robots.
//! 8. [`commands`]: checks and carries out requests of people.
//!
//! `explain` says what a robot waits for. `bugs` holds deliberately naive rules, with which a test shows what the real
//! rule prevents. Items that other crates use are re-exported here.
//! Invariant: no IO, no clock, no hash-map order; the same inputs give the same items.

pub mod bugs;
pub mod commands;
mod cycle;
pub mod decision;
pub mod explain;
pub mod facts;
pub mod judgement;
pub mod members;
pub mod phases;
pub mod projection;
pub mod robots;

#[cfg(test)]
mod tests;

pub use crate::fleet::Board;
pub use commands::carry_out::decide_request;
pub use commands::{dry_run, objects};
pub use cycle::cycle;
pub use decision::directive::{Order, Sign};
pub use decision::plan::Plan;
pub use facts::feed::{LOGS, absorb, follow_rows, obeyed, reread, tell_damaged};
pub use judgement::verdict;
pub use projection::{ended, requests, retention, rows, spec, timestamp};

use crate::leadership::Contenders;

/// Says whether other processes may contend for the lease of the rollout planner.
pub fn contenders(is_shared: bool, bugs: bugs::Bugs) -> Contenders {
    match (bugs.everybody_leads(), is_shared) {
        (true, _) => Contenders::Ignored,
        (false, true) => Contenders::Some,
        (false, false) => Contenders::None,
    }
}
