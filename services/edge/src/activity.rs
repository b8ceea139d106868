//! Whether a connection is used: its first request, and the time since it last had a stream.
//!
//! Invariant: a stream is open from its head until its answer's body is sent or dropped, whatever becomes of it in between.

use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::timeout;

/// Why an unused connection is closed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Unused {
    /// No request came.
    NoRequest,
    /// None is open for a long time.
    Idle,
}

/// Streams of one connection.
#[derive(Clone, Debug)]
pub(crate) struct Activity(Arc<watch::Sender<u32>>);

/// One open stream.
#[derive(Debug)]
pub(crate) struct OpenStream(Arc<watch::Sender<u32>>);

impl Activity {
    pub fn new() -> Self {
        Self(Arc::new(watch::Sender::new(0)))
    }

    /// A stream begins.
    pub fn begin(&self) -> OpenStream {
        self.0.send_modify(|open| *open += 1);
        OpenStream(self.0.clone())
    }

    /// Resolves when the connection has not been used for too long; to be asked once, before the first request can come.
    pub async fn unused(&self, first_request: Duration, idle: Duration) -> Unused {
        let mut open = self.0.subscribe();
        // The sender lives as long as `self`: a change is the only way out of waiting for one.
        if timeout(first_request, open.changed()).await.is_err() {
            return Unused::NoRequest;
        }
        loop {
            let quiet = *open.borrow_and_update() == 0;
            if !quiet {
                let _ = open.changed().await;
            } else if timeout(idle, open.changed()).await.is_err() {
                return Unused::Idle;
            }
        }
    }
}

impl Drop for OpenStream {
    fn drop(&mut self) {
        self.0.send_modify(|open| *open -= 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::time::{Instant, sleep};

    const FIRST: Duration = Duration::from_secs(5);
    const IDLE: Duration = Duration::from_secs(300);

    #[tokio::test(start_paused = true)]
    async fn a_connection_without_a_request_is_unused() {
        let begun = Instant::now();
        assert_eq!(Activity::new().unused(FIRST, IDLE).await, Unused::NoRequest);
        assert_eq!(begun.elapsed(), FIRST);
    }

    #[tokio::test(start_paused = true)]
    async fn an_open_stream_keeps_it_for_ever_and_the_last_one_to_end_begins_the_time() {
        let (activity, begun) = (Activity::new(), Instant::now());
        let uses = async {
            let long = activity.begin();
            drop(activity.begin());
            sleep(IDLE * 100).await;
            drop(long);
            sleep(IDLE / 2).await;
            drop(activity.begin());
        };
        let (unused, ()) = tokio::join!(activity.unused(FIRST, IDLE), uses);
        assert_eq!((unused, begun.elapsed()), (Unused::Idle, IDLE * 100 + IDLE / 2 + IDLE));
    }
}
