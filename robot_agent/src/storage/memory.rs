//! The store of a swarm: in memory, shared by handle, so that a simulated crash keeps what a disk would.
//!
//! Invariant: it forgets nothing that was committed as long as one handle lives. Called by swarms and simulations.

use super::op::Op;
use super::store::{Error, Kept, Store};
use async_trait::async_trait;
use std::sync::{Arc, Mutex, PoisonError};

/// A handle; clones share what is kept.
#[derive(Clone, Debug, Default)]
pub struct MemoryStore(Arc<Mutex<Option<Kept>>>);

impl MemoryStore {
    /// An empty one.
    pub fn new() -> Self {
        Self::default()
    }

    /// What is durable now; none before the first load.
    pub fn kept(&self) -> Option<Kept> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Gives back everything kept, without waiting.
    pub fn load_now(&self, new_ring_id: &str) -> Kept {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert_with(|| Kept::new(new_ring_id)).clone()
    }

    /// Keeps these operations, without waiting.
    pub fn commit_now(&self, ops: &[Op]) {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let kept = kept.get_or_insert_with(|| Kept::new(""));
        ops.iter().for_each(|op| kept.apply(op));
    }
}

#[async_trait]
impl Store for MemoryStore {
    async fn load(&mut self, new_ring_id: &str) -> Result<Kept, Error> {
        Ok(self.load_now(new_ring_id))
    }
    async fn commit(&mut self, ops: &[Op]) -> Result<(), Error> {
        self.commit_now(ops);
        Ok(())
    }
}
