//! What people ask of roll-outs and of the software of robots, as values.
//!
//! Invariant: nothing is decided here; [`commands`](crate::rollout::commands::carry_out) checks a request and carries
//! it out.

use super::spec::RolloutSpec;
use crate::idempotency;
use crate::identity::Caller;
use crate::ids::{BundleId, RobotId, RolloutId};
use crate::rows::{Revision, Table};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// One request about a roll-out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verb {
    /// Check it, and go on to VALIDATED.
    Submit,
    /// Stand for it.
    Approve,
    /// Begin with the first wave.
    Start {
        /// Roll-outs that have some of the robots are aborted first.
        supersede: bool,
    },
    /// Stand still: no new drain, no new permission.
    Pause,
    /// Go on.
    Resume,
    /// Go on though the gate did not say so.
    Promote,
    /// End it; robots go back.
    Abort,
    /// Once more with the robots that failed or were skipped; their quarantine is lifted.
    RetryFailed,
    /// Leave a robot out.
    Exclude(RobotId),
    /// Count a robot that is lost in no budget until it is heard.
    WriteOff(RobotId),
}

/// One request.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Command {
    /// Write a roll-out down.
    Create {
        /// Its id.
        rollout_id: RolloutId,
        /// What it is asked to be.
        spec: Arc<RolloutSpec>,
    },
    /// Take a completed roll-out back with another.
    Rollback {
        /// The completed roll-out that is taken back.
        of: RolloutId,
        /// Id of the other.
        rollout_id: RolloutId,
    },
    /// Something about one.
    Do {
        /// The roll-out that it is about.
        rollout_id: RolloutId,
        /// What is to happen to it.
        verb: Verb,
        /// Why; may be empty.
        reason: String,
    },
    /// Take a bundle back: nobody gets it any more.
    Revoke {
        /// The bundle that nobody gets any more.
        bundle: BundleId,
        /// Why, in a person's words.
        reason: String,
    },
    /// Keep a robot at what it runs.
    Pin {
        /// The robot that keeps its software.
        robot_id: RobotId,
        /// Why, in a person's words.
        reason: String,
    },
    /// Let it take part again.
    Unpin {
        /// The robot that roll-outs may reach again.
        robot_id: RobotId,
    },
    /// A person mended what kept the robot from going back: it is told to go back once more.
    Unstick {
        /// The robot that is told.
        robot_id: RobotId,
        /// What was done.
        reason: String,
    },
    /// The machine that shows this device key is the robot's.
    AcceptKey {
        /// The robot whose key it is.
        robot_id: RobotId,
        /// The key, 64 lower-case hexadecimal digits.
        device_key: String,
    },
    /// A person has looked: the robot may have the bundle again.
    LiftQuarantine {
        /// The robot that is in quarantine.
        robot_id: RobotId,
        /// The bundle that it may have again.
        bundle: BundleId,
    },
}

impl Command {
    /// The roll-outs that it names: whoever decides on it must have them.
    pub fn rollouts(&self) -> Vec<&RolloutId> {
        match self {
            Self::Create { rollout_id, .. } | Self::Do { rollout_id, .. } => vec![rollout_id],
            Self::Rollback { of, rollout_id } => vec![of, rollout_id],
            Self::Revoke { .. } | Self::Pin { .. } | Self::Unpin { .. } => Vec::new(),
            Self::Unstick { .. } | Self::AcceptKey { .. } | Self::LiftQuarantine { .. } => Vec::new(),
        }
    }
}

impl idempotency::IdempotentRequest for Command {
    const KEYS: Table = Table::OtaCommandKey;
}

/// A command as somebody asks for it.
#[derive(Clone, Debug)]
pub struct Ask {
    /// The command, not yet checked.
    pub command: Command,
    /// Only if the roll-out is still as this says.
    pub seen: Option<Revision>,
    /// To be checked and not carried out.
    pub check_only: CheckOnly,
    /// The same id with the same command is one request. A [`Verb::Start`] and a [`Verb::RetryFailed`] take none: they
    /// are more than one item.
    pub request_id: Option<String>,
    /// Who asks.
    pub by: Caller,
}

/// Whether a command is only checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CheckOnly {
    /// Nothing is written.
    Yes,
    /// It is carried out.
    No,
}

/// The outcome of a command that no rule refuses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommandOutcome {
    /// It is carried out, or may be if it was only to be checked. It may be that it changes nothing.
    Now,
    /// It was carried out then under its request_id, UTC of the wall. Nothing is done now, nor would be.
    Before(Utc),
}
