//! The store of a robot: ledger and ring in one SQLite file (WAL, `synchronous = FULL`), each batch one transaction.
//!
//! Invariant: a batch is durable when its commit returned, or nothing of it is; two processes never open one file; a file
//! that is not in the right mode, or is of a newer version, is not opened. Called by the shell alone.

use crate::ledger::SubjectRow;
use crate::store::{Error, Kept, Op, Store};
use async_trait::async_trait;
use midshift_core::ids::Subject;
use midshift_core::robot::{Lane, ReportedAttempt};
use midshift_core::work::{Gap, Sample};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sqlx::sqlite::{SqliteArguments, SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};
use sqlx::{ConnectOptions, Connection, Row};
use std::fs::{File, OpenOptions, Permissions};
use std::io;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// How long a start waits for the file of a process that is just ending.
const BUSY: Duration = Duration::from_secs(5);
/// Version of the tables below.
const VERSION: i64 = 1;

/// Mode of the file: its owner reads and writes, nobody else.
const PRIVATE: u32 = 0o600;

const TABLES: &str = "
CREATE TABLE IF NOT EXISTS fact (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID, STRICT;
CREATE TABLE IF NOT EXISTS subject (subject TEXT PRIMARY KEY, epoch INTEGER NOT NULL, at_unix_ms INTEGER NOT NULL, report TEXT) WITHOUT ROWID, STRICT;
CREATE TABLE IF NOT EXISTS unclosed (attempt TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID, STRICT;
CREATE TABLE IF NOT EXISTS lane (lane INTEGER PRIMARY KEY, produced INTEGER NOT NULL, acked INTEGER NOT NULL) STRICT;
CREATE TABLE IF NOT EXISTS sample (lane INTEGER NOT NULL, seq INTEGER NOT NULL, value TEXT NOT NULL, PRIMARY KEY (lane, seq)) WITHOUT ROWID, STRICT;
CREATE TABLE IF NOT EXISTS gap (lane INTEGER NOT NULL, from_seq INTEGER NOT NULL, to_seq INTEGER NOT NULL, value TEXT NOT NULL, PRIMARY KEY (lane, from_seq)) WITHOUT ROWID, STRICT;
PRAGMA user_version = 1;
";

/// One robot's file.
#[derive(Debug)]
pub struct SqliteStore {
    connection: SqliteConnection,
    _lock: File,
}

impl SqliteStore {
    /// Opens or makes the file, which only its owner may read: it holds secrets. Its folder must exist.
    pub async fn open(path: &Path) -> Result<Self, Error> {
        let lock = lock(path)?;
        keep_private(path).map_err(io_error(format!("keeping {} private", path.display())))?;
        let mut connection = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .busy_timeout(BUSY)
            .disable_statement_logging()
            .connect()
            .await?;
        let mode = "SELECT journal_mode || ' ' || synchronous FROM pragma_journal_mode, pragma_synchronous";
        let found: String = sqlx::query(mode).fetch_one(&mut connection).await?.try_get(0)?;
        if found != "wal 2" {
            return Err(Error::WrongMode(format!("journal_mode and synchronous are {found}, not wal 2")));
        }
        let version: i64 =
            sqlx::query("SELECT user_version FROM pragma_user_version").fetch_one(&mut connection).await?.try_get(0)?;
        if version > VERSION {
            return Err(Error::WrongMode(format!("the file has version {version}, this agent knows {VERSION}")));
        }
        sqlx::raw_sql(TABLES).execute(&mut connection).await?;
        Ok(Self { connection, _lock: lock })
    }

    async fn facts(&mut self, kept: &mut Kept) -> Result<(), Error> {
        for row in sqlx::query("SELECT key, value FROM fact").fetch_all(&mut self.connection).await? {
            let (key, value): (String, String) = (row.try_get(0)?, row.try_get(1)?);
            let ledger = &mut kept.ledger;
            match key.as_str() {
                "ring" => kept.ring.id = value,
                "session" => ledger.session = read(&key, &value)?,
                "applied" => ledger.applied = read(&key, &value)?,
                "policy" => ledger.policy = read(&key, &value)?,
                "holder" => ledger.holder = read(&key, &value)?,
                "places" => ledger.places = read(&key, &value)?,
                "maintenance" => ledger.maintenance = read(&key, &value)?,
                "software" => ledger.software = read(&key, &value)?,
                "trusted" => ledger.trusted = Some(Arc::new(read(&key, &value)?)),
                "device" => ledger.device = Some(read(&key, &value)?),
                _ => return Err(unreadable(&key, "not a known fact")),
            }
        }
        Ok(())
    }

    async fn subjects(&mut self, kept: &mut Kept) -> Result<(), Error> {
        let all = "SELECT subject, epoch, at_unix_ms, report FROM subject";
        for row in sqlx::query(all).fetch_all(&mut self.connection).await? {
            let name: String = row.try_get(0)?;
            let subject = Subject::parse(&name).map_err(|e| unreadable("subject", e))?;
            let report: Option<String> = row.try_get(3)?;
            let report = report.map(|text| read("report", &text)).transpose()?.map(Arc::new);
            let epoch = row.try_get::<i64, _>(1)? as u64;
            kept.ledger.put_subject(subject, SubjectRow { epoch, at_unix_ms: row.try_get(2)?, report });
        }
        for row in sqlx::query("SELECT value FROM unclosed").fetch_all(&mut self.connection).await? {
            let listed: ReportedAttempt = read("unclosed", row.try_get::<String, _>(0)?.as_str())?;
            kept.ledger.unclosed.insert(listed.attempt.clone(), listed);
        }
        Ok(())
    }

    async fn lanes(&mut self, kept: &mut Kept) -> Result<(), Error> {
        for row in sqlx::query("SELECT lane, produced, acked FROM lane").fetch_all(&mut self.connection).await? {
            let lane = kept.ring.lane_mut(lane_of(row.try_get(0)?)?);
            (lane.produced, lane.acked) = (row.try_get::<i64, _>(1)? as u64, row.try_get::<i64, _>(2)? as u64);
        }
        let samples = "SELECT lane, value FROM sample ORDER BY lane, seq";
        for row in sqlx::query(samples).fetch_all(&mut self.connection).await? {
            let sample: Sample = read("sample", row.try_get::<String, _>(1)?.as_str())?;
            kept.ring.lane_mut(lane_of(row.try_get(0)?)?).samples.push_back(Arc::new(sample));
        }
        let gaps = "SELECT lane, value FROM gap ORDER BY lane, from_seq";
        for row in sqlx::query(gaps).fetch_all(&mut self.connection).await? {
            let gap: Gap = read("gap", row.try_get::<String, _>(1)?.as_str())?;
            kept.ring.lane_mut(lane_of(row.try_get(0)?)?).gaps.push_back(gap);
        }
        Ok(())
    }
}

#[async_trait]
impl Store for SqliteStore {
    async fn load(&mut self, new_ring_id: &str) -> Result<Kept, Error> {
        let ring = sqlx::query("INSERT INTO fact VALUES ('ring', $1) ON CONFLICT DO NOTHING").bind(new_ring_id);
        ring.execute(&mut self.connection).await?;
        let mut kept = Kept::new(new_ring_id);
        self.facts(&mut kept).await?;
        self.subjects(&mut kept).await?;
        self.lanes(&mut kept).await?;
        Ok(kept)
    }

    async fn commit(&mut self, ops: &[Op]) -> Result<(), Error> {
        let mut transaction = self.connection.begin_with("BEGIN IMMEDIATE").await?;
        for op in ops {
            write(&mut transaction, op).await?;
        }
        transaction.commit().await?;
        Ok(())
    }
}

type Query = sqlx::query::Query<'static, sqlx::Sqlite, SqliteArguments>;

async fn run(on: &mut SqliteConnection, query: Query) -> Result<(), Error> {
    query.execute(on).await?;
    Ok(())
}

async fn write(on: &mut SqliteConnection, op: &Op) -> Result<(), Error> {
    match op {
        Op::Session(memory) => fact(on, "session", memory).await,
        Op::Applied(applied) => fact(on, "applied", applied).await,
        Op::Policy(areas) => fact(on, "policy", areas).await,
        Op::Holder(holder) => fact(on, "holder", holder).await,
        Op::Places(places) => fact(on, "places", places).await,
        Op::Maintenance(drain_id) => fact(on, "maintenance", drain_id).await,
        Op::Software(row) => fact(on, "software", row).await,
        Op::Trusted(trusted) => fact(on, "trusted", trusted.as_ref()).await,
        Op::Device(key) => fact(on, "device", key).await,
        Op::Epoch(subject, epoch, at_unix_ms) => {
            let upsert = "INSERT INTO subject (subject, epoch, at_unix_ms) VALUES ($1, $2, $3)
                ON CONFLICT (subject) DO UPDATE SET epoch = max(epoch, excluded.epoch), at_unix_ms = excluded.at_unix_ms";
            let query = sqlx::query(upsert).bind(subject.to_string()).bind(*epoch as i64).bind(*at_unix_ms);
            run(on, query).await
        }
        Op::Finish(report, listed, at_unix_ms) => {
            let upsert = "INSERT INTO subject (subject, epoch, at_unix_ms, report) VALUES ($1, $2, $3, $4)
                ON CONFLICT (subject) DO UPDATE SET epoch = max(epoch, excluded.epoch), at_unix_ms = excluded.at_unix_ms,
                report = excluded.report";
            let attempt = &report.attempt;
            let query = sqlx::query(upsert)
                .bind(attempt.subject.to_string())
                .bind(attempt.epoch as i64)
                .bind(*at_unix_ms)
                .bind(text(report.as_ref())?);
            run(on, query).await?;
            let listing = sqlx::query("INSERT OR REPLACE INTO unclosed VALUES ($1, $2)");
            run(on, listing.bind(attempt.to_string()).bind(text(listed)?)).await
        }
        Op::Closed(attempt) => {
            run(on, sqlx::query("DELETE FROM unclosed WHERE attempt = $1").bind(attempt.to_string())).await
        }
        Op::Forget(subject) => {
            run(on, sqlx::query("DELETE FROM subject WHERE subject = $1").bind(subject.to_string())).await
        }
        Op::Append(..) | Op::Free(..) | Op::Gap(_) | Op::Jump(..) => write_lane(on, op).await,
    }
}

async fn write_lane(on: &mut SqliteConnection, op: &Op) -> Result<(), Error> {
    match op {
        Op::Append(lane, sample) => {
            let seq = sample.seq as i64;
            let insert = sqlx::query("INSERT INTO sample VALUES ($1, $2, $3)").bind(*lane as i64).bind(seq);
            run(on, insert.bind(text(sample.as_ref())?)).await?;
            let produced = "INSERT INTO lane VALUES ($1, $2, 0)
                ON CONFLICT (lane) DO UPDATE SET produced = excluded.produced";
            run(on, sqlx::query(produced).bind(*lane as i64).bind(seq)).await
        }
        Op::Free(lane, seq) => {
            let acked = "INSERT INTO lane VALUES ($1, $2, $2)
                ON CONFLICT (lane) DO UPDATE SET acked = max(acked, excluded.acked)";
            run(on, sqlx::query(acked).bind(*lane as i64).bind(*seq as i64)).await?;
            for sql in
                ["DELETE FROM sample WHERE lane = $1 AND seq <= $2", "DELETE FROM gap WHERE lane = $1 AND to_seq <= $2"]
            {
                run(on, sqlx::query(sql).bind(*lane as i64).bind(*seq as i64)).await?;
            }
            Ok(())
        }
        Op::Gap(gap) => {
            let (lane, from, to) = (gap.lane as i64, gap.from_seq as i64, gap.to_seq as i64);
            for sql in [
                "DELETE FROM sample WHERE lane = $1 AND seq BETWEEN $2 AND $3",
                "DELETE FROM gap WHERE lane = $1 AND from_seq >= $2 AND to_seq <= $3",
            ] {
                run(on, sqlx::query(sql).bind(lane).bind(from).bind(to)).await?;
            }
            let insert = sqlx::query("INSERT INTO gap VALUES ($1, $2, $3, $4)").bind(lane).bind(from).bind(to);
            run(on, insert.bind(text(gap)?)).await
        }
        Op::Jump(lane, watermark) => {
            for sql in ["DELETE FROM sample WHERE lane = $1", "DELETE FROM gap WHERE lane = $1"] {
                run(on, sqlx::query(sql).bind(*lane as i64)).await?;
            }
            let set = "INSERT OR REPLACE INTO lane VALUES ($1, $2, $2)";
            run(on, sqlx::query(set).bind(*lane as i64).bind(*watermark as i64)).await
        }
        _ => Ok(()),
    }
}

async fn fact<T: Serialize + Sync>(on: &mut SqliteConnection, key: &'static str, value: &T) -> Result<(), Error> {
    let value = text(value)?;
    run(on, sqlx::query("INSERT OR REPLACE INTO fact VALUES ($1, $2)").bind(key).bind(value)).await
}

fn lock(path: &Path) -> Result<File, Error> {
    let name = path.with_extension("lock");
    let file = File::create(&name).map_err(io_error(format!("making {}", name.display())))?;
    let held = midshift_latch::lock(&file).map_err(io::Error::from);
    held.map_err(io_error(format!("locking {} against another agent", path.display())))?;
    Ok(file)
}

fn io_error(doing: String) -> impl FnOnce(io::Error) -> Error {
    move |source| Error::Io { doing, source }
}

/// An empty file is a new database; the files that SQLite makes beside it have the same mode.
fn keep_private(path: &Path) -> io::Result<()> {
    let file = OpenOptions::new().create(true).append(true).mode(PRIVATE).open(path)?;
    file.set_permissions(Permissions::from_mode(PRIVATE))
}

fn lane_of(number: i64) -> Result<Lane, Error> {
    let lane = Lane::ALL.into_iter().find(|lane| *lane as i64 == number);
    lane.ok_or_else(|| unreadable("lane", format!("{number} is not a lane")))
}

fn text<T: Serialize>(value: &T) -> Result<String, Error> {
    serde_json::to_string(value).map_err(|e| unreadable("value", e))
}

fn read<T: DeserializeOwned>(what: &str, value: &str) -> Result<T, Error> {
    serde_json::from_str(value).map_err(|e| unreadable(what, e))
}

fn unreadable(what: &str, detail: impl ToString) -> Error {
    Error::Unreadable { what: what.to_owned(), detail: detail.to_string() }
}
