//! The slot of a connection among those that have not shown yet who they are: taken before the handshake, given back with the first certificate or the first
//! good token.
//!
//! Invariant: it only ever goes; a connection that authenticated once is never counted again.

use crate::quota::Slot;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

/// One connection; an empty one counts for nothing.
#[derive(Clone, Debug, Default)]
pub(crate) struct Unauthenticated(Arc<Mutex<Option<Slot<IpAddr>>>>);

impl Unauthenticated {
    pub fn new(slot: Option<Slot<IpAddr>>) -> Self {
        Self(Arc::new(Mutex::new(slot)))
    }

    /// It has authenticated.
    pub fn set_authenticated(&self) {
        drop(self.0.lock().unwrap_or_else(PoisonError::into_inner).take());
    }
}
