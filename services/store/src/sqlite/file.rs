//! A SQLite file on disk: its directory, its lock, its connections, and the promise that a commit is on the disk.
//!
//! Invariant: no connection that writes is handed out before `journal_mode = wal` and `synchronous = FULL` have been read back
//! from it. One process at a time has the file.

use super::schema;
use crate::OpenError;
use crate::migrations::{Migrated, Migration};
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{ConnectOptions, Row, SqliteConnection};
use std::fs::{DirBuilder, File, OpenOptions, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::oneshot;

/// File of what the services write as rows.
pub(super) const CONTROL_DB: &str = "control.db";
/// File of samples.
pub(super) const TELEMETRY_DB: &str = "telemetry.db";
/// A file that ended a moment ago may hold its lock for a little longer than its owner.
const LOCK_ATTEMPTS: u32 = 25;
const LOCK_PAUSE: Duration = Duration::from_millis(20);
/// Longer than any checkpoint; only a checkpoint ever makes the writer wait.
const BUSY_TIMEOUT: Duration = Duration::from_secs(30);
/// Texts of groups: a text for each set of tables and logs that one group writes.
const STATEMENTS_CACHED: usize = 128;
/// Results that wait to be looked at: of each statement of the longest text, so that it never waits for whoever asked.
const RESULTS_WAITING: usize = 256;
/// Read connections: a list, a snapshot and two feeds at once; more only share the disk.
const READERS: u32 = 4;
/// Pause between checkpoints.
const CHECKPOINT_PAUSE: Duration = Duration::from_secs(1);
/// A checkpoint that empties the log holds the writer up while it waits for a slow reader: at most so long, then it tries later.
const CHECKPOINT_BUSY: &str = "PRAGMA busy_timeout = 200";
/// A write-ahead log of so many pages begins anew in the same file, with the writer waiting for the last of them: where there are blocks already, a
/// sync writes nothing but them.
const WAL_PAGES_MAX: i64 = 4 * 1024;
/// A write-ahead log above this is emptied with the writer waiting, which bounds the disk and the next start.
const WAL_BYTES_MAX: u64 = 64 * 1024 * 1024;

/// One of the two files of a data directory, locked.
#[derive(Clone)]
pub(crate) struct DataFile {
    name: &'static str,
    path: PathBuf,
    /// Held until the last task that uses the file has ended.
    _lock: Arc<File>,
}

impl DataFile {
    /// Creates the directory (0700) if need be, locks the file `<name>.db` and brings its schema up to date.
    pub(crate) async fn open(
        dir: &Path,
        name: &'static str,
        migrations: &[Migration],
    ) -> Result<(Self, Migrated), OpenError> {
        make_private_dir(dir).map_err(|source| OpenError::Io { doing: "creating the data directory", source })?;
        let stem = name.strip_suffix(".db").unwrap_or(name);
        let lock = lock(dir, stem).await?;
        let file = Self { name, path: dir.join(name), _lock: Arc::new(lock) };
        let mut connection = file.writer().await?;
        let migrated = schema::apply(&mut connection, name, migrations).await?;
        Ok((file, migrated))
    }

    fn options(&self) -> SqliteConnectOptions {
        SqliteConnectOptions::new()
            .filename(&self.path)
            .busy_timeout(BUSY_TIMEOUT)
            .statement_cache_capacity(STATEMENTS_CACHED)
            .disable_statement_logging()
    }

    /// A connection that may write and whose commits are durable.
    pub(crate) async fn writer(&self) -> Result<SqliteConnection, OpenError> {
        let options = self
            .options()
            .create_if_missing(true)
            .row_buffer_size(RESULTS_WAITING)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .pragma("wal_autocheckpoint", "0")
            // What takes a statement back would come into a temporary file, of which a container may have none.
            .pragma("temp_store", "MEMORY");
        let mut connection =
            options.connect().await.map_err(|source| OpenError::Sql { doing: "opening for writing", source })?;
        assert_pragma(&mut connection, "journal_mode", "wal").await?;
        assert_pragma(&mut connection, "synchronous", "2").await?;
        Ok(connection)
    }

    /// Connections that only read. They stay, and are not asked whether they live before each use: nothing ends one of a file, the question would be
    /// one hop more to its thread and back, and a new one would be a new thread that reads the schema and fills its pages anew.
    pub(crate) async fn readers(&self) -> Result<SqlitePool, OpenError> {
        SqlitePoolOptions::new()
            .max_connections(READERS)
            .max_lifetime(None)
            .idle_timeout(None)
            .test_before_acquire(false)
            .connect_with(self.options().pragma("query_only", "1"))
            .await
            .map_err(|source| OpenError::Sql { doing: "opening for reading", source })
    }

    /// Moves the write-ahead log into the file beside the writer's path, until the writer's end (`ended`).
    pub(crate) async fn checkpoint(self, mut ended: oneshot::Receiver<()>) {
        let mut connection = None;
        loop {
            tokio::select! {
                _ = &mut ended => return,
                () = tokio::time::sleep(CHECKPOINT_PAUSE) => {}
            }
            if let Err(error) = self.checkpoint_once(&mut connection).await {
                connection = None;
                tracing::warn!(file = %self.path.display(), %error, "checkpoint failed");
            }
        }
    }

    async fn checkpointer(&self) -> Result<SqliteConnection, OpenError> {
        let mut connection = self.writer().await?;
        let set = sqlx::query(CHECKPOINT_BUSY).execute(&mut connection).await;
        set.map_err(|source| OpenError::Sql { doing: "opening for checkpoints", source })?;
        Ok(connection)
    }

    async fn checkpoint_once(&self, connection: &mut Option<SqliteConnection>) -> Result<(), OpenError> {
        let wal = self.path.with_extension("db-wal");
        let bytes = wal.metadata().map_or(0, |m| m.len());
        if bytes == 0 {
            return Ok(());
        }
        let connection = match connection {
            Some(connection) => connection,
            None => connection.insert(self.checkpointer().await?),
        };
        let failed = |source| OpenError::Sql { doing: "checkpointing", source };
        let done = sqlx::query("PRAGMA wal_checkpoint(PASSIVE)").fetch_one(&mut *connection).await.map_err(failed)?;
        let pages: i64 = done.try_get(1).map_err(failed)?;
        if bytes > WAL_BYTES_MAX {
            sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)").execute(connection).await.map_err(failed)?;
        } else if pages > WAL_PAGES_MAX {
            sqlx::query("PRAGMA wal_checkpoint(RESTART)").execute(connection).await.map_err(failed)?;
        }
        metrics::gauge!("midshift_store_wal_bytes", "file" => self.name).set(bytes as f64);
        Ok(())
    }
}

async fn assert_pragma(
    connection: &mut SqliteConnection,
    name: &'static str,
    expected: &'static str,
) -> Result<(), OpenError> {
    let sql = match name {
        "journal_mode" => "SELECT CAST(journal_mode AS TEXT) FROM pragma_journal_mode",
        _ => "SELECT CAST(synchronous AS TEXT) FROM pragma_synchronous",
    };
    let row = sqlx::query(sql).fetch_one(connection).await;
    let found: String =
        row.and_then(|row| row.try_get(0)).map_err(|source| OpenError::Sql { doing: "reading a pragma", source })?;
    if found == expected {
        return Ok(());
    }
    Err(OpenError::NotDurable { name, expected, found })
}

fn make_private_dir(dir: &Path) -> std::io::Result<()> {
    let mut builder = DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(dir)
}

async fn lock(dir: &Path, stem: &str) -> Result<File, OpenError> {
    let io = |source| OpenError::Io { doing: "locking the data directory", source };
    let path = dir.join(format!("{stem}.lock"));
    let file = OpenOptions::new().create(true).truncate(false).write(true).open(path).map_err(io)?;
    for _ in 0..LOCK_ATTEMPTS {
        match file.try_lock() {
            Ok(()) => return Ok(file),
            Err(TryLockError::WouldBlock) => tokio::time::sleep(LOCK_PAUSE).await,
            Err(TryLockError::Error(source)) => return Err(io(source)),
        }
    }
    Err(OpenError::Locked { dir: dir.to_owned() })
}
