//! What a durable answer costs at least: one append to the disk, or one commit of the database.

use crate::fsync::Disk;
use sqlx::PgConnection;
use tokio::time::Instant;

/// Bytes of the row of one commit, as pgbench's history has it, rounded up.
const COMMIT_BYTES: usize = 64;

/// The raw limit of a durable answer.
pub enum DurableBaseline {
    /// An append to a file, with fdatasync.
    Disk(Disk),
    /// One INSERT of a small row, which is a transaction of its own, on a connection of its own.
    Commit(Box<PgConnection>),
}

impl DurableBaseline {
    /// Milliseconds of one.
    pub async fn measure_ms(&mut self) -> anyhow::Result<f64> {
        match self {
            Self::Disk(disk) => disk.append_ms(),
            Self::Commit(connection) => {
                let begun = Instant::now();
                let insert =
                    sqlx::query("INSERT INTO raw_commit (body) VALUES ($1)").bind([0x5a_u8; COMMIT_BYTES].as_slice());
                insert.execute(&mut **connection).await?;
                Ok(begun.elapsed().as_secs_f64() * 1e3)
            }
        }
    }
    /// The same of several in a row.
    pub async fn several_ms(&mut self, times: usize) -> anyhow::Result<Vec<f64>> {
        let mut took_ms = Vec::with_capacity(times);
        for _ in 0..times {
            took_ms.push(self.measure_ms().await?);
        }
        Ok(took_ms)
    }
}
