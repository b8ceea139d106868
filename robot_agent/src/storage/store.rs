//! Defines the durable memory of a robot, its ledger and its ring, and the [`Store`] that keeps it by ordered operations.
//!
//! Invariant: the core applies an operation to its own copy and hands it out in the same order; nothing that depends on
//! an operation leaves the robot (a message, a movement) before the batch that holds it is durable. Two stores:
//! [`super::memory`] for swarms and [`super::sqlite`] for robots; one contract suite runs over both.

use super::device::DeviceKey;
use super::ledger::Ledger;
pub use super::op::Op;
use super::ring::Ring;
use async_trait::async_trait;
use std::io;

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

/// The durable memory of a robot: its ledger and its ring.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotMemory {
    /// The ledger of its work and software.
    pub ledger: Ledger,
    /// Samples that are not yet acknowledged.
    pub ring: Ring,
}

impl RobotMemory {
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

/// Stores the memory of a robot.
#[async_trait]
pub trait Store: Send {
    /// Loads the whole memory. A new store formats its ring with `new_ring_id`; an old one ignores it.
    async fn load(&mut self, new_ring_id: &str) -> Result<RobotMemory, Error>;
    /// Makes these operations durable, in order, all or none.
    async fn commit(&mut self, ops: &[Op]) -> Result<(), Error>;
}

/// The key on a ledger, made if it has none. A new store formats its ring with `new_ring_id`.
///
/// # Errors
/// The ledger cannot be read or written.
pub async fn device_key(store: &mut dyn Store, new_ring_id: &str) -> Result<DeviceKey, Error> {
    if let Some(key) = store.load(new_ring_id).await?.ledger.device {
        return Ok(key);
    }
    let key = DeviceKey::draw();
    store.commit(&[Op::Device(key.clone())]).await?;
    Ok(key)
}
