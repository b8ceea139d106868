//! A runtime of its own for fleet's cycle: a plan computes for tens of milliseconds, and no session may wait for that.
//!
//! Invariant: sessions, the way down and calls run where the process runs; only what is spawned here may compute for long.

use anyhow::Context;
use tokio::runtime::{Builder, Handle, Runtime};

/// The runtime; ends without waiting when it is dropped.
pub struct Planning(Option<Runtime>);

impl Planning {
    /// Starts its one thread.
    pub fn start() -> anyhow::Result<Self> {
        let runtime = Builder::new_multi_thread().worker_threads(1).thread_name("midshift-plan").enable_all().build();
        Ok(Self(Some(runtime.context("starting the thread that plans")?)))
    }

    /// Where to spawn.
    pub fn handle(&self) -> Handle {
        self.0.as_ref().map_or_else(Handle::current, |r| r.handle().clone())
    }
}

impl Drop for Planning {
    fn drop(&mut self) {
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}
