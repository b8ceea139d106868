//! Awaits the optional parts of a session. Each future stays pending for ever where the session lacks the part.

use crate::enrolment::Waits;
use crate::inner::Inner;
use crate::registry::Replay;
use midshift_core::Boxed;
use std::sync::Arc;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::time::Instant;

/// The database that several processes share has not been reached for long; never, if there is none.
pub async fn is_cut_off(cut_off: &mut Option<watch::Receiver<bool>>) {
    match cut_off {
        // The sender lives as long as the service.
        Some(cut_off) => drop(cut_off.wait_for(|cut_off| *cut_off).await),
        None => std::future::pending().await,
    }
}

/// What a session waits for has come; never, if it waits for nothing.
pub async fn until_over(inner: Arc<Inner>, waits: Option<Waits>) {
    match waits {
        Some(waits) => waits.until_over(inner).await,
        None => std::future::pending().await,
    }
}

/// That moment; never, if there is none.
pub async fn sleep_until(moment: Option<Instant>) {
    match moment {
        Some(moment) => tokio::time::sleep_until(moment).await,
        None => std::future::pending().await,
    }
}

/// The next replay; never, if there can be none. The session holds a sender itself, so there is always another.
pub async fn next_replay(replays: &mut Option<mpsc::Receiver<Replay>>) -> Replay {
    match replays {
        Some(replays) => match replays.recv().await {
            Some(replay) => replay,
            None => std::future::pending().await,
        },
        None => std::future::pending().await,
    }
}

/// STATUS of one session that is being kept.
pub struct Keeping {
    /// Up to which number.
    pub last_seq: u64,
    /// The writer was told not to wait for more.
    pub is_hurried: bool,
    /// Whether it is.
    pub written: oneshot::Receiver<bool>,
}

/// Whether what is being kept is kept; never, if nothing is.
pub async fn await_kept(keeping: &mut Option<Keeping>) -> bool {
    match keeping {
        Some(keeping) => (&mut keeping.written).await.unwrap_or_default(),
        None => std::future::pending().await,
    }
}

/// Waits for a write under way and takes it away.
pub async fn finish<T>(slot: &mut Option<Boxed<'static, T>>) -> T {
    match slot {
        Some(write) => {
            let done = write.await;
            *slot = None;
            done
        }
        None => std::future::pending().await,
    }
}
