//! The store of a swarm: in memory, shared by handle, so that a simulated crash keeps what a disk would.
//!
//! Invariant: it forgets nothing that was committed as long as one handle lives. Called by swarms and simulations.

use super::op::Op;
use super::store::{Error, RobotMemory, Store};
use async_trait::async_trait;
use std::sync::{Arc, Mutex, PoisonError};

/// A store in memory: a handle whose clones share the robot's memory.
#[derive(Clone, Debug, Default)]
pub struct MemoryStore(Arc<Mutex<Option<RobotMemory>>>);

impl MemoryStore {
    /// An empty one.
    pub fn new() -> Self {
        Self::default()
    }

    /// The memory that is durable now; none before the first load.
    pub fn memory(&self) -> Option<RobotMemory> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Loads the whole memory, without waiting.
    pub fn load_now(&self, new_ring_id: &str) -> RobotMemory {
        self.0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .get_or_insert_with(|| RobotMemory::new(new_ring_id))
            .clone()
    }

    /// Commits these operations, without waiting.
    pub fn commit_now(&self, ops: &[Op]) {
        let mut memory = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let memory = memory.get_or_insert_with(|| RobotMemory::new(""));
        ops.iter().for_each(|op| memory.apply(op));
    }
}

#[async_trait]
impl Store for MemoryStore {
    async fn load(&mut self, new_ring_id: &str) -> Result<RobotMemory, Error> {
        Ok(self.load_now(new_ring_id))
    }
    async fn commit(&mut self, ops: &[Op]) -> Result<(), Error> {
        self.commit_now(ops);
        Ok(())
    }
}
