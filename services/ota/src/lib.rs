//! Software of robots on the server: keeps files of signed releases and says which release is the newest.
//!
//! Called by the binary. Invariant: nothing is decided about robots here, and nothing is signed that says what software is good.

pub mod content;
#[cfg(test)]
mod fixture;
pub mod repository;

use std::panic::resume_unwind;

/// Does what blocks away from the threads that serve.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    match tokio::task::spawn_blocking(work).await.map_err(tokio::task::JoinError::try_into_panic) {
        Ok(done) => done,
        Err(Ok(panic)) => resume_unwind(panic),
        // The process ends: whoever waits ends with it.
        Err(Err(_)) => std::future::pending().await,
    }
}
