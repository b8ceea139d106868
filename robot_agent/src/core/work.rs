//! The attempt at hand: what is to be done, what of it is done, and what the body is busy with.
//!
//! Invariant: what must survive a restart is in `holder`, which the ledger has.

use crate::body::PathPoint;
use crate::storage::Holder;
use midshift_core::desired_state::Assignment;
use midshift_core::robot::Fault;
use midshift_core::robot::WorkState;
use midshift_core::step::{StepKind, WorkStep};
use std::sync::Arc;

/// Actions that the agent does by itself.
pub const CHARGE: &str = "charge";
/// See [`CHARGE`].
pub const PARK: &str = "park";

/// What the body is busy with for this attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Doing {
    /// Nothing: between two orders.
    Nothing,
    /// It drives along `path`.
    Driving,
    /// It acts or waits.
    Acting,
    /// It charges: the agent's own action.
    Charging,
    /// It takes the posture in which it may stand: the agent's own action.
    Parking,
}

/// How the attempt is to end at the next safe point.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Ending {
    /// The server took it back.
    Abort,
    /// It failed by the agent's own clock.
    Fail(Fault),
}

/// Whether the robot may go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pause {
    /// It may.
    No,
    /// It finishes what may not be interrupted and drives no further than the next standing place it holds.
    WindDown,
    /// A person, the maker's safety system or a fleet stop has it: it stands at once.
    Now,
}

/// The attempt at hand.
#[derive(Clone, Debug)]
pub(crate) struct Work {
    pub holder: Holder,
    /// What is to be done; none after a restart until the server has said it again.
    pub order: Option<Arc<Assignment>>,
    pub doing: Doing,
    /// The body was told to pause.
    pub paused: bool,
    /// Index of the last route point reached.
    pub reached: Option<usize>,
    /// `reached` means something in this route.
    pub located: bool,
    pub ending: Option<Ending>,
    /// Ordered and not yet reached.
    pub path: Vec<PathPoint>,
    /// The body has moved or acted for it.
    pub started: bool,
    /// The step at hand may have been under way before a break: look before doing.
    pub recheck: bool,
    /// The intent on the ledger is of this life and its step has not begun.
    pub intent_fresh: bool,
    pub step_elapsed_ms: u64,
    pub told: Option<(WorkState, u32)>,
}

impl Work {
    /// As it stands on the ledger after a restart.
    pub(crate) fn restored(holder: Holder) -> Self {
        Self { recheck: true, started: true, ..Self::new(holder) }
    }

    pub(crate) fn new(holder: Holder) -> Self {
        Self {
            holder,
            order: None,
            doing: Doing::Nothing,
            paused: false,
            reached: None,
            located: false,
            ending: None,
            path: Vec::new(),
            started: false,
            recheck: false,
            intent_fresh: false,
            step_elapsed_ms: 0,
            told: None,
        }
    }

    /// The step at hand.
    pub(crate) fn step(&self) -> Option<&WorkStep> {
        self.order.as_ref()?.steps.get(self.holder.step as usize)
    }

    /// The step goes on without any sign from the body.
    pub(crate) fn goes_on_by_itself(&self) -> bool {
        let waits = matches!(self.step(), Some(WorkStep { kind: StepKind::Wait { .. }, .. }));
        !self.paused && (self.doing == Doing::Charging || (waits && self.doing == Doing::Acting))
    }
}
