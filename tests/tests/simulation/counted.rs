//! Counters of the server, as laws look at them. A seed has a process of its own, so they are of one run.

use crate::observer::Observer;

/// What stands for long has a reason that says what it does or names what it waits for.
pub const TOLD: &str = "what does not move is explained";

/// Looks at that law: the server counts what it cannot explain itself.
pub fn nothing_stands_unexplained(seen: &mut Observer) {
    let unexplained = Counted::now().sum("midshift_fleet_unexplained_total", "");
    seen.check(TOLD, unexplained == 0, || format!("{unexplained} robots and tasks"));
}

/// What the server counted of itself.
pub struct Counted(String);

impl Counted {
    /// At this moment.
    pub fn now() -> Self {
        Self(midshift::recorder::handle().map(|handle| handle.render()).unwrap_or_default())
    }
    /// Sum over all labels that have `label`.
    pub fn sum(&self, name: &str, label: &str) -> u64 {
        let of_name = |line: &&str| line.starts_with(name) && !line.starts_with('#') && line.contains(label);
        let value = |line: &str| line.rsplit(' ').next().and_then(|n| n.parse::<f64>().ok()).unwrap_or(0.0) as u64;
        self.0.lines().filter(of_name).map(value).sum()
    }
}
