//! The two engines that a server may keep its rows in, and the raw limit of each in the same run: of SQLite the disk, of PostgreSQL a
//! single commit by itself and rows by COPY.
//!
//! Invariant: each round has a directory or a database of its own, taken away with it. PostgreSQL keeps its promises: `fsync` is on and
//! a commit waits for its log. Called by each measurement of a server.

use crate::child::{Child, cpu_of_ended_s, cpu_of_s};
use crate::durable_baseline::DurableBaseline;
use crate::fsync::{Disk, place};
use anyhow::{Context, bail, ensure};
use sqlx::postgres::PgConnection;
use sqlx::{Connection, Executor};
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

/// How often the CPU of the database's processes is added up anew because one of them ended meanwhile.
const COUNTS_MAX: usize = 16;
/// How what COPY is given begins in PostgreSQL's binary format: its mark, then no flags and no extension.
const COPY_BEGIN: &[u8] = b"PGCOPY\n\xff\r\n\0\0\0\0\0\0\0\0\0";
/// What a row says of its columns that is none but the end.
const COPY_END: i16 = -1;

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
    /// PostgreSQL, with its files below `dir`.
    pub fn postgres(dir: Option<&Path>) -> anyhow::Result<Self> {
        ensure!(
            PostgresServer::is_installed(),
            "the machine has no server programs of PostgreSQL: install the package postgresql"
        );
        Ok(Self::Postgres(PostgresServer::start_in(dir)))
    }
    /// Number of the database's first process; none where it is the server itself.
    pub fn pid(&self) -> Option<u32> {
        match self {
            Self::Sqlite => None,
            Self::Postgres(server) => server.pid(),
        }
    }
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
    pub fn bed(&self, dir: Option<&PathBuf>) -> anyhow::Result<Bed<'_>> {
        let database = match self {
            Self::Sqlite => None,
            Self::Postgres(server) => Some((server, server.database())),
        };
        Ok(Bed { dir: place(dir)?, database })
    }
    /// CPU spent so far by the database's own processes, also by those that have ended, seconds; none where it is the server itself.
    pub fn cpu_s(&self) -> anyhow::Result<Option<f64>> {
        let Self::Postgres(server) = self else { return Ok(None) };
        let postmaster = server.pid().context("PostgreSQL does not say its number")?;
        for _ in 0..COUNTS_MAX {
            let ended_s = cpu_of_ended_s(postmaster)?;
            let living_s = cpu_of_s(postmaster)? + cpu_of_children_s(postmaster)?;
            // What ended meanwhile would be counted twice or by nobody.
            if cpu_of_ended_s(postmaster)? == ended_s {
                return Ok(Some(living_s + ended_s));
            }
        }
        bail!("processes of PostgreSQL end faster than their CPU can be added up")
    }
}

fn cpu_of_children_s(parent: u32) -> anyhow::Result<f64> {
    Ok(children_of(parent)?.into_iter().map(|pid| cpu_of_s(pid).unwrap_or(0.0)).sum())
}

/// Processes that a process has started and that live.
pub fn children_of(parent: u32) -> anyhow::Result<Vec<u32>> {
    let mut children = Vec::new();
    for entry in std::fs::read_dir("/proc")? {
        let name = entry?.file_name();
        let pid = name.to_str().and_then(|name| name.parse().ok());
        children.extend(pid.filter(|pid| parent_of(*pid) == Some(parent)));
    }
    Ok(children)
}

fn parent_of(pid: u32) -> Option<u32> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    stat.rsplit_once(')')?.1.split_whitespace().nth(1)?.parse().ok()
}

/// The place of one server's rows. Its database goes with it, whoever uses it still.
pub struct Bed<'e> {
    dir: TempDir,
    /// The server and the address of the database.
    database: Option<(&'e PostgresServer, String)>,
}

impl Drop for Bed<'_> {
    fn drop(&mut self) {
        if let Some((server, url)) = &self.database {
            server.drop_database(url);
        }
    }
}

impl Bed<'_> {
    /// A directory beside the rows.
    pub fn path(&self) -> &Path {
        self.dir.path()
    }
    /// Address of the database, if it is not files in the server's directory.
    pub fn url(&self) -> Option<&str> {
        self.database.as_ref().map(|(_, url)| url.as_str())
    }
    /// A server of midshift here, once it listens.
    pub async fn serve(&self, site: Option<&Path>, core: Option<usize>) -> anyhow::Result<Child> {
        Child::serve(&self.dir.path().join("data"), site, self.url(), core).await
    }
    /// Bytes of the database, if it is not files in the server's directory; else 0.
    pub async fn database_bytes(&self) -> anyhow::Result<u64> {
        let Some(url) = self.url() else { return Ok(0) };
        let mut connection = PgConnection::connect(url).await?;
        let bytes: i64 =
            sqlx::query_scalar("SELECT pg_database_size(current_database())").fetch_one(&mut connection).await?;
        connection.close().await?;
        Ok(bytes.cast_unsigned())
    }
    /// The raw limit here.
    pub async fn baseline(&self) -> anyhow::Result<DurableBaseline> {
        let Some(url) = self.url() else { return Ok(DurableBaseline::Disk(Disk::beside(self.dir.path())?)) };
        let mut connection = PgConnection::connect(url).await?;
        connection.execute("CREATE TABLE raw_commit (id bigserial PRIMARY KEY, body bytea NOT NULL)").await?;
        Ok(DurableBaseline::Commit(Box::new(connection)))
    }
    /// Rows a second of `bytes` each by COPY in the binary format on one connection, so many in each commit; none where there is no such thing.
    /// What is sent lies ready before the clock runs.
    pub async fn copied_per_s(&self, rows: usize, bytes: usize, in_commit: usize) -> anyhow::Result<Option<f64>> {
        let Some(url) = self.url() else { return Ok(None) };
        let ids: Vec<i64> = (0..rows as i64).collect();
        let body = vec![0x5a; bytes];
        let ready: Vec<(u64, Vec<u8>)> = ids
            .chunks(in_commit.max(1))
            .map(|ids| Ok((ids.len() as u64, copied(ids, &body)?)))
            .collect::<anyhow::Result<_>>()?;
        let mut connection = PgConnection::connect(url).await?;
        connection.execute("CREATE TABLE raw_copy (id bigint PRIMARY KEY, body bytea NOT NULL)").await?;
        let begun = Instant::now();
        for (count, bytes) in &ready {
            let mut copy = connection.copy_in_raw("COPY raw_copy FROM STDIN (FORMAT binary)").await?;
            copy.send(bytes.as_slice()).await?;
            ensure!(copy.finish().await? == *count, "COPY lost rows");
        }
        let per_s = rows as f64 / begun.elapsed().as_secs_f64();
        connection.execute("DROP TABLE raw_copy").await?;
        connection.close().await?;
        Ok(Some(per_s))
    }
}

/// Rows of an id and a body as COPY takes them.
fn copied(ids: &[i64], body: &[u8]) -> anyhow::Result<Vec<u8>> {
    let mut all = COPY_BEGIN.to_vec();
    for id in ids {
        all.extend(2_i16.to_be_bytes());
        for field in [&id.to_be_bytes()[..], body] {
            all.extend(i32::try_from(field.len())?.to_be_bytes());
            all.extend(field);
        }
    }
    all.extend(COPY_END.to_be_bytes());
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DATABASES: &str = "SELECT count(*) FROM pg_database WHERE datname LIKE 'test_%'";

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn the_database_of_a_round_goes_with_it_and_copy_takes_what_lay_ready() {
        let engine = Engine::Postgres(PostgresServer::start());
        let Engine::Postgres(server) = &engine else { unreachable!("it is") };
        let bed = engine.bed(None).expect("a place");
        assert!(bed.copied_per_s(10, 100, 3).await.expect("rows").is_some_and(|per_s| per_s > 0.0));
        // Somebody uses it still.
        let _baseline = bed.baseline().await.expect("a connection");
        assert_eq!(server.ask(&server.url("postgres"), DATABASES), "1");
        drop(bed);
        assert_eq!(server.ask(&server.url("postgres"), DATABASES), "0");
    }

    #[test]
    fn what_a_process_of_the_database_spent_that_has_ended_is_counted() {
        let engine = Engine::Postgres(PostgresServer::start());
        let Engine::Postgres(server) = &engine else { unreachable!("it is") };
        let cpu_s = || engine.cpu_s().expect("numbers").expect("of PostgreSQL");
        let before_s = cpu_s();
        let work = "SELECT pg_backend_pid() FROM (SELECT sum(sqrt(n)) FROM generate_series(1, 3000000) AS n) AS done";
        let pid = server.ask(&server.url("postgres"), work);
        let is_there = || Path::new("/proc").join(&pid).exists();
        // A look takes a microsecond or two.
        let looks = (0..50_000_000_u64).take_while(|_| is_there()).inspect(|_| std::thread::yield_now()).count();
        assert!(!is_there(), "the process of an ended session stays after {looks} looks");
        let spent_s = cpu_s() - before_s;
        assert!(spent_s >= 0.1, "{spent_s} s of three million roots");
    }
}
