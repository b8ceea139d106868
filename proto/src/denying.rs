//! What a service denies after the port had let the request pass, because only the service knows what it is about: told to the port, which writes it down
//! within its limits.
//!
//! Invariant: nothing waits for it. A command that leaves its own row in the audit with its refusal does not tell of it here too.

use midshift_core::reason::{Code, Kind, Refusal};
use std::fmt;
use std::sync::Arc;

/// Receives the denials of one request, to record them.
pub trait Told: Send + Sync {
    /// One request was denied for who asked.
    fn denied(&self, refusal: &Refusal);
}

/// Of one request, in its extensions. Clones are the same.
#[derive(Clone, Default)]
pub struct Denying(Option<Arc<dyn Told>>);

impl Denying {
    /// Told to `told`.
    pub fn new(told: Arc<dyn Told>) -> Self {
        Self(Some(told))
    }
    /// Of the port that a request came through; of one that came through none nobody is told.
    pub fn from_request<T>(request: &tonic::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_default()
    }
    /// Tells of a refusal that was for who asked, and of no other. Who showed nothing was denied nothing: it is asked to sign in.
    pub fn report(&self, refusal: &Refusal) {
        let is_denial = matches!(refusal.kind(), Kind::Denied | Kind::Unauthenticated);
        if let Some(told) = self.0.as_ref().filter(|_| is_denial && refusal.reason.code != Code::SignInNeeded) {
            told.denied(refusal);
        }
    }
}

impl fmt::Debug for Denying {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Denying")
    }
}
