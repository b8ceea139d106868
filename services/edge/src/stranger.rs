//! The seat of a connection among those that have not shown yet who they are: taken before the handshake, given back with the first certificate or the first
//! good token.
//!
//! Invariant: it only ever goes; a connection that was known once is no stranger again.

use crate::seats::Seat;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};

/// One connection; an empty one is no stranger.
#[derive(Clone, Debug, Default)]
pub(crate) struct Stranger(Arc<Mutex<Option<Seat<IpAddr>>>>);

impl Stranger {
    pub fn new(seat: Option<Seat<IpAddr>>) -> Self {
        Self(Arc::new(Mutex::new(seat)))
    }

    /// It has shown who it is.
    pub fn is_known(&self) {
        drop(self.0.lock().unwrap_or_else(PoisonError::into_inner).take());
    }
}
