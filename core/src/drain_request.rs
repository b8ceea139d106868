//! What the rollout service says to fleet: take this robot out of work, give it back, a person should look into this.
//!
//! Written by the rollout service, read by fleet, which answers with its own drain and the robot's mutex. Invariant: fleet holds a robot only for a
//! request that stands without a release, and a release says why nothing that was permitted can still happen.

use crate::ids::{DrainId, RobotId, RolloutId};
use crate::rows::{Index, Record, Table, body_is_json};
use serde::{Deserialize, Serialize};

/// Kind of the fact that a person should look into something; its body is the reason. Fleet opens an incident for it.
pub const INCIDENT: &str = "rollout.incident";

/// Fleet is asked to take a robot out of work.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DrainRequest {
    /// Never used again.
    pub drain_id: DrainId,
    /// The robot that is to be taken out of work.
    pub robot_id: RobotId,
    /// For which roll-out.
    pub rollout_id: RolloutId,
    /// What for, for people.
    pub reason: String,
    /// Milliseconds of site time that it may take, from its begin.
    pub within_ms: u64,
    /// The robot gets no work from now on, whatever the area's budget.
    pub urgent: bool,
    /// The robot leaves aborted software. Its drain waits only for other drains that end without a person.
    #[serde(default)]
    pub is_way_back: bool,
    /// The robot changes to something new: while the area's window is shut or the area is frozen its drain does not begin.
    #[serde(default)]
    pub forward: bool,
    /// The robot is lost, and a person or the roll-out's policy said that it counts in no budget until it is heard.
    #[serde(default)]
    pub written_off: bool,
}

impl Record for DrainRequest {
    const TABLE: Table = Table::DrainRequest;
    body_is_json!();
    fn id(&self) -> String {
        self.drain_id.to_string()
    }
    fn index(&self) -> Index {
        Index { parent: Some(self.robot_id.as_str().into()), ..Index::default() }
    }
}

/// Fleet may give a robot back: nothing that was permitted in the drain can still happen.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DrainRelease {
    /// Which drain.
    pub drain_id: DrainId,
    /// Why nothing can happen any more.
    pub why: ReleasedBy,
}

/// Why a drain may be released. Time alone is none of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ReleasedBy {
    /// No permission was given in it.
    NoGrant,
    /// The robot reported how it ended.
    Reported,
    /// Past the life of the permission, the robot's ledger says that it was not used.
    NotUsed,
    /// A person took the robot out of the fleet.
    Retired,
}

impl Record for DrainRelease {
    const TABLE: Table = Table::DrainRelease;
    body_is_json!();
    fn id(&self) -> String {
        self.drain_id.to_string()
    }
}
