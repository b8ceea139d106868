//! Directives: what the service signs for a robot, on behalf of a decision.
//!
//! Invariant: no key is here; the same order gives the same envelope.

use crate::ids::{BundleId, RobotId, RolloutId};
use crate::time::Utc;

/// What a directive says.
#[derive(Clone, Copy, Debug)]
pub struct Order<'a> {
    /// To whom.
    pub robot_id: &'a RobotId,
    /// Rises with each directive of the robot.
    pub generation: u64,
    /// Which bundle.
    pub bundle: &'a BundleId,
    /// Bytes of its manifest.
    pub manifest_length: u64,
    /// No component may have a lower `rollback_index`.
    pub rollback_floor: u64,
    /// For which roll-out.
    pub rollout_id: &'a RolloutId,
    /// UTC of the wall.
    pub issued_at: Utc,
}

/// Signs directives. The same order gives the same envelope.
pub trait Sign {
    /// The envelope, as text.
    fn directive(&self, order: &Order) -> String;
}

/// Where nothing has to be signed.
pub(in crate::rollout) struct NoSign;

impl Sign for NoSign {
    fn directive(&self, _order: &Order) -> String {
        String::new()
    }
}
