//! What a server has spent so far, by the kernel's books and its own.

use crate::child::Child;
use anyhow::Context;
use std::path::Path;

/// Groups of items that a server has committed, each with one sync of the disk.
const GROUPS: &str = "midshift_store_groups_total";

/// Spent since the start of a process.
#[derive(Clone, Copy, Debug, Default)]
pub struct Usage {
    /// Of all its threads, seconds, in whole clock ticks.
    pub cpu_s: f64,
    /// Of the threads that it has now, wanted and unwanted.
    pub switches: f64,
    /// Handed to the disk.
    pub written_bytes: f64,
    /// Committed.
    pub groups: f64,
}

impl Usage {
    /// Of a server until now.
    pub fn of(server: &mut Child) -> anyhow::Result<Self> {
        let process = Path::new("/proc").join(server.pid().to_string());
        let mut switches = 0.0;
        for thread in std::fs::read_dir(process.join("task"))? {
            // One that ended meanwhile counts for nothing.
            let Ok(status) = std::fs::read_to_string(thread?.path().join("status")) else { continue };
            switches += field(&status, "voluntary_ctxt_switches:")? + field(&status, "nonvoluntary_ctxt_switches:")?;
        }
        let io = std::fs::read_to_string(process.join("io"))?;
        let groups = server.ask(GROUPS)? as f64;
        Ok(Self { cpu_s: server.cpu_s()?, switches, written_bytes: field(&io, "write_bytes:")?, groups })
    }

    /// What was spent from `then` until this, each second.
    pub fn a_second_since(self, then: Self, seconds: f64) -> Self {
        Self {
            cpu_s: (self.cpu_s - then.cpu_s) / seconds,
            switches: (self.switches - then.switches) / seconds,
            written_bytes: (self.written_bytes - then.written_bytes) / seconds,
            groups: (self.groups - then.groups) / seconds,
        }
    }
}

/// The number behind a name at the beginning of a line.
fn field(text: &str, name: &str) -> anyhow::Result<f64> {
    let number = text.lines().find_map(|line| line.strip_prefix(name));
    number.and_then(|n| n.trim().parse().ok()).with_context(|| format!("no {name} in /proc"))
}
