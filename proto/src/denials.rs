//! Reports to the port what a service denies after the port let the request pass. The port records it within its limits.
//!
//! Invariant: nothing waits for it. A command that leaves its own row in the audit with its refusal is not reported here too.

use midshift_core::reason::{Code, Kind, Refusal};
use std::fmt;
use std::sync::Arc;

/// Receives the denials of one request, to record them.
pub trait DenialSink: Send + Sync {
    /// Records that the caller of the request was denied.
    fn denied(&self, refusal: &Refusal);
}

/// Reports the denials of one request, in whose extensions it stands. Clones report to the same sink.
#[derive(Clone, Default)]
pub struct DenialReporter(Option<Arc<dyn DenialSink>>);

impl DenialReporter {
    /// Reports to `sink`.
    pub fn new(sink: Arc<dyn DenialSink>) -> Self {
        Self(Some(sink))
    }
    /// The reporter of the port that a request came through; without a port it reports to nobody.
    pub fn from_request<T>(request: &tonic::Request<T>) -> Self {
        request.extensions().get::<Self>().cloned().unwrap_or_default()
    }
    /// Reports a refusal if it denies the caller. A caller without credentials was denied nothing: it is asked to sign in.
    pub fn report(&self, refusal: &Refusal) {
        let is_denial = matches!(refusal.kind(), Kind::Denied | Kind::Unauthenticated);
        if let Some(sink) = self.0.as_ref().filter(|_| is_denial && refusal.reason.code != Code::SignInNeeded) {
            sink.denied(refusal);
        }
    }
}

impl fmt::Debug for DenialReporter {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("DenialReporter")
    }
}
