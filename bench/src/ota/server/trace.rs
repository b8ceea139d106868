//! CPU of a server over time, so that it can be told afterwards what had been spent by a moment that is known only then.

use crate::child::cpu_of_s;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::task::JoinSet;
use tokio::time::Instant;

/// How often it is looked at; the kernel counts in ticks of about 10 ms.
const LOOK_EVERY: Duration = Duration::from_millis(5);

/// Looks until it is dropped.
pub struct Trace {
    seen: Arc<Mutex<Vec<(Instant, f64)>>>,
    _looks: JoinSet<()>,
}

impl Trace {
    /// Of the process with this number, as long as it lives.
    pub fn begin(pid: u32) -> Self {
        let seen = Arc::new(Mutex::new(Vec::new()));
        let mut looks = JoinSet::new();
        let kept = seen.clone();
        looks.spawn(async move {
            let mut tick = tokio::time::interval(LOOK_EVERY);
            while let Ok(cpu_s) = cpu_of_s(pid) {
                kept.lock().unwrap_or_else(PoisonError::into_inner).push((Instant::now(), cpu_s));
                tick.tick().await;
            }
        });
        Self { seen, _looks: looks }
    }
    /// Seconds spent between two moments: from the last look before the first to the first look after the second.
    pub fn between_s(&self, from: Instant, to: Instant) -> f64 {
        let seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        let before = seen.iter().rev().find(|(at, _)| *at <= from).or(seen.first());
        let after = seen.iter().find(|(at, _)| *at >= to).or(seen.last());
        before.zip(after).map_or(0.0, |(before, after)| after.1 - before.1)
    }
}
