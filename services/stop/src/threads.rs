//! How threads of the service share and wait: locks that outlive a panic, and work with files beside the threads that answer.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// A lock whose holder panicked holds what it held: the latch only ever adds up.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Work with files, off the threads that answer.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    match tokio::task::spawn_blocking(work).await {
        Ok(done) => done,
        Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
        // The runtime goes away, and with it whoever waits.
        Err(_) => std::future::pending().await,
    }
}
