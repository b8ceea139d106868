//! The raw limit of everything durable: appending a page to a file and waiting until the disk has it.

use std::fs::OpenOptions;
use std::io::Write;
use std::path::Path;
use tokio::time::Instant;

/// What one commit writes at least, bytes.
const PAGE_BYTES: usize = 4096;

/// Milliseconds of each of `times` appends with fdatasync, in a file of its own in `dir`.
pub fn appends_ms(dir: &Path, times: usize) -> anyhow::Result<Vec<f64>> {
    let path = dir.join("fsync");
    let mut file = OpenOptions::new().create(true).append(true).open(&path)?;
    let page = [0x5a_u8; PAGE_BYTES];
    let mut took = Vec::with_capacity(times);
    for _ in 0..times {
        let begun = Instant::now();
        file.write_all(&page)?;
        file.sync_data()?;
        took.push(begun.elapsed().as_secs_f64() * 1e3);
    }
    std::fs::remove_file(path)?;
    Ok(took)
}
