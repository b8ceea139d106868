//! What the kernel's files in /proc say of a process.

use anyhow::Context;

/// What a process has in memory now.
#[derive(Clone, Copy, Debug)]
pub struct Memory {
    /// Its own (RssAnon), MiB.
    pub own_mib: f64,
    /// With pages of files, the program's too, that others may share (VmRSS), MiB.
    pub all_mib: f64,
}

impl Memory {
    /// Reads it of a process.
    pub fn read(pid: u32) -> anyhow::Result<Self> {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
        let mib = |name: &str| anyhow::Ok(find_field(&status, name)? / 1_024.0);
        Ok(Self { own_mib: mib("RssAnon:")?, all_mib: mib("VmRSS:")? })
    }
}

/// Finds the number behind a name at the beginning of a line.
pub fn find_field(text: &str, name: &str) -> anyhow::Result<f64> {
    let number = text.lines().find_map(|line| line.strip_prefix(name));
    let number = number.and_then(|n| n.trim().trim_end_matches(" kB").parse().ok());
    number.with_context(|| format!("no {name} in /proc"))
}
