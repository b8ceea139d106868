//! The updater's jobs in simulated time: each takes some milliseconds before and after its effect, and a crash in them cuts it off there.
//!
//! Invariant: work that the real worker gives to other threads is waited for in place, so that the order of everything follows from the
//! seed and not from how fast a thread was.

use crate::observer::Shared;
use midshift_agent::update::io::Worker;
use midshift_agent::update::{Done, Job};
use midshift_core::ids::RobotId;
use midshift_sim::launched::Launched;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::task::{Context, Poll, Wake, Waker};
use std::thread::ThreadId;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// A worker that takes its time and is watched.
pub struct SlowWorker {
    inner: Box<dyn Worker>,
    launched: Arc<Launched>,
    robot_id: RobotId,
    observer: Shared,
    rng: StdRng,
}

impl SlowWorker {
    /// Around `inner`.
    pub fn new(
        inner: Box<dyn Worker>,
        launched: Arc<Launched>,
        robot_id: &RobotId,
        observer: &Shared,
        seed: u64,
    ) -> Self {
        let rng = StdRng::seed_from_u64(seed ^ 0x736c_6f77);
        Self { inner, launched, robot_id: robot_id.clone(), observer: observer.clone(), rng }
    }
}

#[async_trait::async_trait]
impl Worker for SlowWorker {
    async fn work(&mut self, job: Job, leave: CancellationToken) -> Done {
        let (before, after) = (self.rng.random_range(0..12), self.rng.random_range(0..4));
        tokio::time::sleep(Duration::from_millis(before)).await;
        let done = Still(self.inner.work(job, leave)).await;
        if let Done::Written(switch) = &done {
            let set = self.launched.holdings().ok().and_then(|holdings| holdings.set(switch.running()));
            self.observer.switched(&self.robot_id, switch, set.as_ref());
        }
        tokio::time::sleep(Duration::from_millis(after)).await;
        done
    }
}

/// Wakes from the own thread pass; those of other threads are only noted.
struct OwnThread {
    own: ThreadId,
    inner: Waker,
    other: AtomicBool,
}

impl Wake for OwnThread {
    fn wake(self: Arc<Self>) {
        if std::thread::current().id() == self.own {
            self.inner.wake_by_ref();
        } else {
            self.other.store(true, SeqCst);
        }
    }
}

/// A future whose work on other threads is waited for where it stands.
struct Still<F>(Pin<Box<F>>)
where
    F: Future + ?Sized;

impl<F: Future + ?Sized> Future for Still<F> {
    type Output = F::Output;
    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<F::Output> {
        let (own, inner) = (std::thread::current().id(), cx.waker().clone());
        let wake = Arc::new(OwnThread { own, inner, other: AtomicBool::new(false) });
        let waker = Waker::from(wake.clone());
        let metrics = tokio::runtime::Handle::current().metrics();
        loop {
            if let Poll::Ready(done) = self.0.as_mut().poll(&mut Context::from_waker(&waker)) {
                return Poll::Ready(done);
            }
            while metrics.blocking_queue_depth() > 0
                || metrics.num_blocking_threads() > metrics.num_idle_blocking_threads()
            {
                std::thread::yield_now();
            }
            if !wake.other.swap(false, SeqCst) {
                return Poll::Pending;
            }
        }
    }
}
