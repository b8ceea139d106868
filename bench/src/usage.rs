//! What a server has spent so far, by the kernel's books and its own.

use crate::child::Child;
use crate::process_files::find_field;
use std::collections::BTreeMap;
use std::path::Path;

/// Groups of items that a server has committed; on SQLite each is one sync of the disk.
const GROUPS: &str = "midshift_store_groups_total";

/// Spent since the start of a process.
#[derive(Debug)]
pub struct Usage {
    cpu_s: f64,
    /// Of each thread that it has now, wanted and unwanted.
    switches: BTreeMap<String, f64>,
    written_bytes: f64,
    groups: f64,
}

/// Spent each second of a while.
#[derive(Clone, Copy, Debug)]
pub struct Rates {
    /// Of all threads, seconds.
    pub cpu_s: f64,
    /// Context switches of the threads that are there at the end of it.
    pub switches: f64,
    /// Handed to the disk by the server itself.
    pub written_bytes: f64,
    /// Groups of items that were committed.
    pub groups: f64,
}

impl Usage {
    /// Reads what a server has spent until now.
    pub fn read(server: &mut Child) -> anyhow::Result<Self> {
        let process = Path::new("/proc").join(server.pid().to_string());
        let mut switches = BTreeMap::new();
        for thread in std::fs::read_dir(process.join("task"))? {
            let thread = thread?;
            // One that ended meanwhile counts for nothing.
            let Ok(status) = std::fs::read_to_string(thread.path().join("status")) else { continue };
            let count =
                find_field(&status, "voluntary_ctxt_switches:")? + find_field(&status, "nonvoluntary_ctxt_switches:")?;
            switches.insert(thread.file_name().to_string_lossy().into_owned(), count);
        }
        let io = std::fs::read_to_string(process.join("io"))?;
        let groups = server.ask(GROUPS)? as f64;
        Ok(Self { cpu_s: server.cpu_s()?, switches, written_bytes: find_field(&io, "write_bytes:")?, groups })
    }

    /// What was spent from `then` until this, each second.
    pub fn a_second_since(&self, then: &Self, seconds: f64) -> Rates {
        let of_thread = |(thread, count): (&String, &f64)| count - then.switches.get(thread).unwrap_or(&0.0);
        Rates {
            cpu_s: (self.cpu_s - then.cpu_s) / seconds,
            switches: self.switches.iter().map(of_thread).sum::<f64>() / seconds,
            written_bytes: (self.written_bytes - then.written_bytes) / seconds,
            groups: (self.groups - then.groups) / seconds,
        }
    }
}
