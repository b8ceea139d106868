//! The robot's one durable thing: ledger and ring, changed by ordered operations, kept by a [`Store`].
//!
//! Invariant: the core applies an operation to its own copy and hands it out in the same order; nothing that depends on an
//! operation leaves the robot (a message, a movement) before the batch that holds it is durable. Two stores: [`crate::memory`]
//! for swarms and [`crate::sqlite`] for robots; one contract suite runs over both.

use crate::device::DeviceKey;
use crate::ledger::{Applied, Holder, Ledger, PlacesRow, SessionMemory};
use crate::ring::Ring;
use crate::update::SoftwareRow;
use crate::update::proven::Proven;
use async_trait::async_trait;
use midshift_bundle::trust::Trusted;
use midshift_core::ids::{AttemptId, DrainId, Subject};
use midshift_core::policy::AreaPolicy;
use midshift_core::robot::{Lane, ReportedAttempt};
use midshift_core::work::{AttemptReport, Gap, Sample};
use std::io;
use std::sync::Arc;

/// A store that could not keep or give back.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The database refused.
    #[error("using the robot's database: {0}")]
    Database(#[from] sqlx::Error),
    /// What it holds cannot be read.
    #[error("reading {what} from the robot's database: {detail}")]
    Unreadable {
        /// Which row.
        what: String,
        /// What was wrong.
        detail: String,
    },
    /// Its file, or the lock against a second agent, could not be had.
    #[error("{doing}: {source}")]
    Io {
        /// What was being done.
        doing: String,
        /// Why not.
        source: io::Error,
    },
    /// The file is in a mode that would lose data.
    #[error("opening the robot's database: {0}")]
    WrongMode(String),
}

/// One change of what a robot remembers.
#[derive(Clone, Debug, PartialEq)]
pub enum Op {
    /// The newest session.
    Session(SessionMemory),
    /// Generations applied.
    Applied(Applied),
    /// Rules of the areas.
    Policy(Vec<AreaPolicy>),
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

/// All that a robot remembers.
#[derive(Clone, Debug, PartialEq)]
pub struct Kept {
    /// What it remembers of its work.
    pub ledger: Ledger,
    /// Samples that are not yet acknowledged.
    pub ring: Ring,
}

impl Kept {
    /// Nothing yet, with a ring of this id.
    pub fn new(ring_id: impl Into<String>) -> Self {
        Self { ledger: Ledger::default(), ring: Ring::new(ring_id) }
    }

    /// Applies one operation.
    pub fn apply(&mut self, op: &Op) {
        self.ledger.apply(op);
        self.ring.apply(op);
    }
}

/// Keeps what a robot must remember.
#[async_trait]
pub trait Store: Send {
    /// Everything kept. A new store formats its ring with `new_ring_id`; an old one ignores it.
    async fn load(&mut self, new_ring_id: &str) -> Result<Kept, Error>;
    /// Makes these operations durable, in order, all or none.
    async fn commit(&mut self, ops: &[Op]) -> Result<(), Error>;
}
