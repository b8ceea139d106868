//! Moments of a turn, by a clock that all processes share.

/// The machine's monotonic clock, which is the same in all processes.
pub fn now_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs()
}

/// When one robot was told and had the answer to its acknowledgement, ns of the machine's monotonic clock.
#[derive(Clone, Copy, Debug, Default, serde::Serialize, serde::Deserialize)]
pub struct Moments {
    /// It read the stop.
    pub told_ns: u64,
    /// It read the answer to what it said then. 0: not yet.
    pub acked_ns: u64,
}
