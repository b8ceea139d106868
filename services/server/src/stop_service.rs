//! The stop service as this program has it: in `dev` a thread of its own, beside `serve` on one box the program
//! `midshift-stop`, which outlives it.
//!
//! An operational stop request, not a safety function. Invariant: nothing of the store, the task queue or the business
//! server lies on its way. `serve` starts one where none is, leaves one that answers alone, and replaces one that hangs.
//! Rooms: `supervisor` is that, `program` finds the program, `first_start` says that one may begin with nothing engaged.

mod first_start;
mod program;
mod supervisor;

pub use first_start::{Occasion, announce};
pub use program::{check_program, replace_this};
pub use supervisor::Supervisor;

use midshift_core::site::Site;
use midshift_core::time::Clock;
use midshift_process::{door, recorder};
use midshift_stop::{Parts, StopService, port};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

/// The stop service of `dev`: a thread with a runtime of its own, so that no plan and no simulated robot holds it up.
pub struct InProcessStopService {
    shutdown: CancellationToken,
    thread: Option<std::thread::JoinHandle<anyhow::Result<()>>>,
    address: SocketAddr,
}

impl InProcessStopService {
    /// Begins to serve `listener`.
    ///
    /// # Errors
    /// No thread or no runtime.
    pub fn start(
        folder: PathBuf,
        site: Arc<Site>,
        clock: Arc<dyn Clock>,
        listener: std::net::TcpListener,
    ) -> anyhow::Result<Self> {
        let address = listener.local_addr()?;
        listener.set_nonblocking(true)?;
        let shutdown = CancellationToken::new();
        let stop = shutdown.clone();
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let work = move || {
            let served = runtime.block_on(async {
                let listener = TcpListener::from_std(listener)?;
                recorder::handle();
                let service = StopService::open(Parts { folder, site: Some(site), clock }, stop)?;
                port::serve(service, (door::alone(port::NAME), None), listener).await
            });
            if let Err(error) = &served {
                tracing::error!(%error, "the stop service ended");
            }
            runtime.shutdown_timeout(Duration::from_secs(2));
            served
        };
        let thread = std::thread::Builder::new().name("stop".to_owned()).spawn(work)?;
        Ok(Self { shutdown, thread: Some(thread), address })
    }
    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for InProcessStopService {
    fn drop(&mut self) {
        self.shutdown.cancel();
        // It ends within its own bounds; why it ended was logged.
        let _ = self.thread.take().map(std::thread::JoinHandle::join);
    }
}
