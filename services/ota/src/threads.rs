//! On which threads work is done.

use std::panic::resume_unwind;
use tokio::runtime::RuntimeFlavor;

/// Does what blocks away from the threads that serve. A runtime of one thread is a simulation's or a test's: there it is done in place,
/// so that the order of everything follows from what was asked and not from how fast a disk was.
pub async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    if is_of_one_thread() {
        return work();
    }
    match tokio::task::spawn_blocking(work).await.map_err(tokio::task::JoinError::try_into_panic) {
        Ok(done) => done,
        Err(Ok(panic)) => resume_unwind(panic),
        // The process ends: whoever waits ends with it.
        Err(Err(_)) => std::future::pending().await,
    }
}

/// Whether everything of this runtime happens on one thread.
pub fn is_of_one_thread() -> bool {
    tokio::runtime::Handle::current().runtime_flavor() == RuntimeFlavor::CurrentThread
}
