//! The two engines that a server may keep its rows in, and the raw limit of each in the same run: of SQLite the disk, of PostgreSQL a
//! single commit by itself and rows by COPY.
//!
//! Invariant: each round has a directory or a database of its own, taken away with it. PostgreSQL keeps its promises: `fsync` is on and
//! a commit waits for its log. Called by `submit`, `offer` and `link`.

use crate::child::{Child, cpu_of_s};
use crate::fsync::Disk;
use crate::submit::place;
use anyhow::{Context, ensure};
use sqlx::postgres::{PgConnection, PgPoolCopyExt};
use sqlx::{Connection, Executor, PgPool};
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use tokio::time::Instant;

#[expect(clippy::expect_used, clippy::panic, reason = "shared with the tests, which fail by panicking")]
#[expect(dead_code, reason = "shared with the tests, which ask for more")]
#[path = "../../tests/src/postgres.rs"]
mod postgres_server;
use postgres_server::PostgresServer;

/// Name of the limit that a durable answer stands beside where rows are in PostgreSQL.
const COMMIT: &str = "single commit of PostgreSQL";
/// Bytes of the row of one commit, as pgbench's history has it, rounded up.
const COMMIT_BYTES: usize = 64;

/// Which engines are measured.
#[derive(Clone, Debug, clap::Args)]
pub struct EngineArgs {
    /// Leave PostgreSQL out, of which a server is started for the run from the machine's own programs.
    #[arg(long)]
    no_postgres: bool,
    /// Where the databases are made and taken away again. Without it the temporary directory; it should be a real disk.
    #[arg(long)]
    pub dir: Option<PathBuf>,
}

/// Where servers keep their rows.
pub enum Engine {
    /// In files of the server's data directory.
    Sqlite,
    /// In a server of its own, which ends with this.
    Postgres(PostgresServer),
}

impl EngineArgs {
    /// SQLite, and PostgreSQL if the machine has it; says so if it is left out.
    pub fn engines(&self, say: &dyn Fn(&str)) -> Vec<Engine> {
        let mut engines = vec![Engine::Sqlite];
        if self.no_postgres {
            return engines;
        }
        if PostgresServer::is_installed() {
            engines.push(Engine::Postgres(PostgresServer::start_in(self.dir.as_deref())));
        } else {
            say("PostgreSQL is left out: the machine has no server programs of it; install the package postgresql");
        }
        engines
    }
}

impl Engine {
    /// What names of figures end with.
    pub fn suffix(&self) -> &'static str {
        match self {
            Self::Sqlite => "",
            Self::Postgres(_) => ", on PostgreSQL",
        }
    }
    /// Name of the raw limit of a durable answer.
    pub fn limit(&self) -> &'static str {
        match self {
            Self::Sqlite => "fdatasync of 4 KiB",
            Self::Postgres(_) => COMMIT,
        }
    }
    /// A new place for one round, below `dir` or the temporary directory.
    pub fn bed(&self, dir: Option<&PathBuf>) -> anyhow::Result<Bed> {
        let url = match self {
            Self::Sqlite => None,
            Self::Postgres(server) => Some(server.database()),
        };
        Ok(Bed { dir: place(dir)?, url })
    }
    /// CPU spent so far by the database's own processes, seconds; none where it is the server itself.
    pub fn cpu_s(&self) -> anyhow::Result<Option<f64>> {
        let Self::Postgres(server) = self else { return Ok(None) };
        let postmaster = server.pid().context("PostgreSQL does not say its number")?;
        let mut cpu_s = cpu_of_s(postmaster)?;
        for entry in std::fs::read_dir("/proc")? {
            let name = entry?.file_name();
            let Some(pid) = name.to_str().and_then(|name| name.parse::<u32>().ok()) else { continue };
            // A process that has ended meanwhile is counted by nobody, which is less than a clock tick.
            if parent_of(pid) == Some(postmaster) {
                cpu_s += cpu_of_s(pid).unwrap_or(0.0);
            }
        }
        Ok(Some(cpu_s))
    }
}

fn parent_of(pid: u32) -> Option<u32> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()
}

/// The place of one server's rows.
pub struct Bed {
    dir: TempDir,
    url: Option<String>,
}

impl Bed {
    /// A directory beside the rows.
    pub fn path(&self) -> &Path {
        self.dir.path()
    }
    /// A server of midshift here, once it listens.
    pub async fn serve(&self, site: Option<&Path>, core: Option<usize>) -> anyhow::Result<Child> {
        Child::serve(&self.dir.path().join("data"), site, self.url.as_deref(), core).await
    }
    /// The raw limit here.
    pub async fn raw(&self) -> anyhow::Result<Raw> {
        let Some(url) = &self.url else { return Ok(Raw::Disk(Disk::beside(self.dir.path())?)) };
        let mut connection = PgConnection::connect(url).await?;
        connection.execute("CREATE TABLE raw_commit (id bigserial PRIMARY KEY, body bytea NOT NULL)").await?;
        Ok(Raw::Commit(Box::new(connection)))
    }
    /// Rows a second of `bytes` each by COPY on one connection, so many in each commit; none where there is no such thing.
    pub async fn copied_per_s(&self, rows: usize, bytes: usize, in_commit: usize) -> anyhow::Result<Option<f64>> {
        let Some(url) = &self.url else { return Ok(None) };
        let pool = PgPool::connect(url).await?;
        pool.execute("CREATE TABLE raw_copy (id bigint PRIMARY KEY, body bytea NOT NULL)").await?;
        let (body, begun) = ("5a".repeat(bytes), Instant::now());
        let mut first = 0;
        while first < rows {
            let last = (first + in_commit.max(1)).min(rows);
            let text: String = (first..last).map(|id| format!("{id}\t\\\\x{body}\n")).collect();
            let mut copy = pool.copy_in_raw("COPY raw_copy FROM STDIN").await?;
            copy.send(text.as_bytes()).await?;
            ensure!(copy.finish().await? == (last - first) as u64, "COPY lost rows");
            first = last;
        }
        let per_s = rows as f64 / begun.elapsed().as_secs_f64();
        pool.execute("DROP TABLE raw_copy").await?;
        pool.close().await;
        Ok(Some(per_s))
    }
}

/// The raw limit of a durable answer.
pub enum Raw {
    /// An append to a file, with fdatasync.
    Disk(Disk),
    /// One INSERT of a small row, which is a transaction of its own, on a connection of its own.
    Commit(Box<PgConnection>),
}

impl Raw {
    /// Milliseconds of one.
    pub async fn ms(&mut self) -> anyhow::Result<f64> {
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
            took_ms.push(self.ms().await?);
        }
        Ok(took_ms)
    }
}
