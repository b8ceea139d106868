//! The law of roll-outs: which robot gets which bundle when, what counts for and against it, and the way back.
//!
//! [`cycle()`] takes what happened and gives items to commit; the service around it only reads, signs, commits and
//! publishes. Rooms, from the lowest to the highest; each uses only those before it:
//! 1. [`projection`]: what is asked for, and what is known.
//! 2. [`decision`]: how a decision becomes an item, and what a directive says.
//! 3. [`members`]: which robots belong to a roll-out, in which wave, and what robots get that come later.
//! 4. [`judgement`]: what counts for and against a bundle, and how a roll-out ends.
//! 5. [`robots`]: what is due for each robot, where that leads, and what is written for it.
//! 6. [`phases`]: waves, gates, pauses, and the way back of the whole.
//! 7. [`facts`]: what happened: entries of the feed, and what robots say.
//! 8. [`commands`]: what people ask.
//!
//! On top of them `explain` says what a robot waits for, and `bugs` are naive rules for twins of tests. Files that
//! other crates use are named here once more. Invariant: no IO, no clock, no hash-map order; the same inputs give the
//! same items.

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

use crate::lead::Rivals;

/// Who else may plan on a store that other processes open too, or not.
pub fn rivals(is_shared: bool, bugs: bugs::Bugs) -> Rivals {
    match (bugs.everybody_leads(), is_shared) {
        (true, _) => Rivals::Ignored,
        (false, true) => Rivals::Some,
        (false, false) => Rivals::None,
    }
}
