//! Counters of the server, as laws look at them. A seed has a process of its own, so they are of one run.

use crate::observer::Observer;
use midshift_tests::metrics::Metrics;

/// What stands for long has a reason that says what it does or names what it waits for.
pub const TOLD: &str = "what does not move is explained";

/// Looks at that law: the server counts what it cannot explain itself.
pub fn nothing_stands_unexplained(counted: &Metrics, seen: &mut Observer) {
    let unexplained = counted.sum("midshift_fleet_unexplained_total", "");
    seen.check(TOLD, unexplained == 0, || format!("{unexplained} robots and tasks"));
}

/// What the server counted of itself until this moment.
pub fn counted() -> Metrics {
    Metrics(midshift_process::recorder::handle().map(|handle| handle.render()).unwrap_or_default())
}
