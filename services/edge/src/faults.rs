//! A fault of a service: it panicked when it was called, or in the middle of its answer. That call ends, and nothing else.
//!
//! Invariant: what calls share is whole after it, because nothing here is changed across a call of a service, and locks that a panic left are taken.

use futures_util::FutureExt;
use midshift_core::reason::{Code, Kind, Refusal};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::task::Poll;

/// Awaits an answer.
///
/// # Errors
/// The service panicked.
pub(crate) async fn await_answer<T>(answer: impl Future<Output = T>) -> Result<T, Refusal> {
    AssertUnwindSafe(answer).catch_unwind().await.map_err(|_| count_fault("call"))
}

/// Asks for the next part of an answer.
///
/// # Errors
/// It panicked, and must not be asked again.
pub(crate) fn poll_body<T>(poll: impl FnOnce() -> Poll<T>) -> Result<Poll<T>, Refusal> {
    catch_unwind(AssertUnwindSafe(poll)).map_err(|_| count_fault("body"))
}

/// The panic itself is on standard error.
fn count_fault(at: &'static str) -> Refusal {
    metrics::counter!("midshift_edge_panics_total", "at" => at).increment(1);
    tracing::error!(at, "a service panicked");
    Refusal::new(Kind::Internal, Code::Internal)
}
