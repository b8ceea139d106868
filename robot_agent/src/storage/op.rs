//! One change of what a robot remembers. Applying operations in order is the only way to change ledger and ring.

use super::device::DeviceKey;
use super::proven::Proven;
use super::rows::{Applied, Holder, PlacesRow, SessionMemory};
use super::software::SoftwareRow;
use midshift_bundle::trust::Trusted;
use midshift_core::desired_state::AreaRules;
use midshift_core::ids::{AttemptId, DrainId, Subject};
use midshift_core::robot::{Lane, ReportedAttempt};
use midshift_core::robot_events::{AttemptReport, Gap, Sample};
use std::sync::Arc;

/// One change of what a robot remembers.
#[derive(Clone, Debug, PartialEq)]
pub enum Op {
    /// The newest session.
    Session(SessionMemory),
    /// Generations applied.
    Applied(Applied),
    /// Rules of the areas.
    Policy(Vec<AreaRules>),
    /// Who holds the robot.
    Holder(Option<Box<Holder>>),
    /// Places and grants.
    Places(PlacesRow),
    /// The drain that holds the robot.
    Maintenance(Option<DrainId>),
    /// What it remembers of its software.
    Software(Box<SoftwareRow>),
    /// What is believed of the repository.
    Trusted(Arc<Trusted>),
    /// What may run, and why.
    Proven(Arc<Proven>),
    /// The key of this machine: once, at its first start.
    Device(DeviceKey),
    /// This epoch of the subject was seen, at this wall time (unix milliseconds): it is passed.
    Epoch(Subject, u64, i64),
    /// An attempt ended: its answer, how to list it until the server has it, and the wall time (unix milliseconds).
    Finish(Arc<AttemptReport>, ReportedAttempt, i64),
    /// The server has stored the end of this attempt.
    Closed(AttemptId),
    /// A subject is older than anything the server may ask for.
    Forget(Subject),
    /// A numbered sample.
    Append(Lane, Arc<Sample>),
    /// Acknowledged up to and with this number.
    Free(Lane, u64),
    /// A range that will never come; its samples go.
    Gap(Gap),
    /// The lane is emptied and goes on after this number.
    Jump(Lane, u64),
}
