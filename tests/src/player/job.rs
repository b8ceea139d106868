//! An attempt of the player, as far as it has come.

use midshift_core::desired_state::Assignment;

/// An attempt that it took.
pub(super) struct Job {
    pub(super) assignment: Assignment,
    pub(super) step: u32,
    /// It is done with the step at hand then, milliseconds.
    pub(super) due: u64,
}
