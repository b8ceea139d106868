//! The report of a cycle: what was done, what was counted, and why the rest was not done.

use crate::task::figures::TaskFigures;

/// The fact of a reason that names what is waited for.
pub const WAITS_FOR: &str = "waits_for";

/// What was counted on the way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Reports of an epoch that had passed, or of nothing that is known.
    pub fenced: u64,
    /// Messages that robots refused for their authority.
    pub stale_authority: u64,
    /// Differences between a heartbeat and the rows that were repaired.
    pub repaired: u64,
    /// Robots whose differences do not count yet.
    pub pending: u64,
    /// Robots that wait for a place.
    pub waiting_for_place: u64,
}

/// What a cycle did and why the rest was not done.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// Tasks offered.
    pub offers: u64,
    /// Errands offered.
    pub errands: u64,
    /// Ready tasks looked at.
    pub looked: u64,
    /// Something was left for the next turn.
    pub more: bool,
    /// Tasks that have ended.
    pub ended: Vec<TaskFigures>,
    /// What was counted on the way.
    pub tally: Tally,
    /// Robots and tasks that stand for long without a reason, once each; logged.
    pub unexplained: Vec<String>,
    /// Rows or entries that could not be read; each was passed over and is logged.
    pub unreadable: Vec<String>,
}
