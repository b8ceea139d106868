//! The store of a robot: ledger and ring in one SQLite file (WAL, `synchronous = FULL`), each batch one transaction.
//!
//! Invariant: a batch is durable when its commit returned, or nothing of it is; two processes never open one file; a
//! file that is not in the right mode is not opened. What a newer version has added (a fact, a table, a column, a
//! field) is left where it is and not looked at, since a robot that goes back to its kept set opens what the other one
//! wrote (record 0095): so each statement names its columns, and no row is put in place of another. Called by the shell
//! alone.

use super::op::Op;
use super::ring::LaneBuffer;
use super::rows::SubjectRow;
use super::store::{Error, RobotMemory, Store};
use async_trait::async_trait;
use midshift_core::Boxed;
use midshift_core::ids::Subject;
use midshift_core::reason::{Code, Reason};
use midshift_core::robot::{Lane, ReportedAttempt};
use midshift_core::robot_events::{Gap, Sample};
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
/// Version of the tables below. It rises only with what an older version must not open: never before COMMIT, nor while
/// a way back leads there.
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
    pub fn open(path: &Path) -> Boxed<'_, Result<Self, Error>> {
        Box::pin(async move {
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
            let version: i64 = sqlx::query("SELECT user_version FROM pragma_user_version")
                .fetch_one(&mut connection)
                .await?
                .try_get(0)?;
            if version > VERSION {
                return Err(Error::WrongMode(format!("the file has version {version}, this agent knows {VERSION}")));
            }
            sqlx::raw_sql(TABLES).execute(&mut connection).await?;
            Ok(Self { connection, _lock: lock })
        })
    }

    async fn facts(&mut self, memory: &mut RobotMemory) -> Result<(), Error> {
        for row in sqlx::query("SELECT key, value FROM fact").fetch_all(&mut self.connection).await? {
            let (key, value): (String, String) = (row.try_get(0)?, row.try_get(1)?);
            let ledger = &mut memory.ledger;
            match key.as_str() {
                "ring" => memory.ring.id = value,
                "session" => ledger.session = read(&key, &value)?,
                "applied" => ledger.applied = read(&key, &value)?,
                "policy" => ledger.policy = read(&key, &value)?,
                "holder" => ledger.holder = read(&key, &value)?,
                "places" => ledger.places = read(&key, &value)?,
                "maintenance" => ledger.maintenance = read(&key, &value)?,
                "software" => ledger.software = read(&key, &value)?,
                "trusted" => ledger.trusted = Some(Arc::new(read(&key, &value)?)),
                "proven" => ledger.proven = Some(Arc::new(read(&key, &value)?)),
                "device" => ledger.device = Some(read(&key, &value)?),
                // A newer version's.
                _ => {}
            }
        }
        Ok(())
    }

    async fn subjects(&mut self, memory: &mut RobotMemory) -> Result<(), Error> {
        let all = "SELECT subject, epoch, at_unix_ms, report FROM subject";
        for row in sqlx::query(all).fetch_all(&mut self.connection).await? {
            let name: String = row.try_get(0)?;
            // Of a kind that nobody here can be asked for.
            let Ok(subject) = Subject::parse(&name) else { continue };
            let report: Option<String> = row.try_get(3)?;
            let report = report.map(|text| read("report", &text)).transpose()?.map(Arc::new);
            let epoch = row.try_get::<i64, _>(1)? as u64;
            memory.ledger.put_subject(subject, SubjectRow { epoch, at_unix_ms: row.try_get(2)?, report });
        }
        for row in sqlx::query("SELECT value FROM unclosed").fetch_all(&mut self.connection).await? {
            let listed: ReportedAttempt = read("unclosed", row.try_get::<String, _>(0)?.as_str())?;
            memory.ledger.unclosed.insert(listed.attempt.clone(), listed);
        }
        Ok(())
    }

    async fn lanes(&mut self, memory: &mut RobotMemory) -> Result<(), Error> {
        for row in sqlx::query("SELECT lane, produced, acked FROM lane").fetch_all(&mut self.connection).await? {
            let Some(lane) = lane_of(row.try_get(0)?) else { continue };
            let lane = memory.ring.lane_mut(lane);
            (lane.produced, lane.acked) = (row.try_get::<i64, _>(1)? as u64, row.try_get::<i64, _>(2)? as u64);
        }
        let samples = "SELECT lane, value, seq FROM sample ORDER BY lane, seq";
        for row in sqlx::query(samples).fetch_all(&mut self.connection).await? {
            let Some(lane) = lane_of(row.try_get(0)?) else { continue };
            let buffer = memory.ring.lane_mut(lane);
            match serde_json::from_str::<Sample>(row.try_get::<String, _>(1)?.as_str()) {
                Ok(sample) => buffer.samples.push_back(Arc::new(sample)),
                Err(error) => set_aside(buffer, lane, row.try_get::<i64, _>(2)? as u64, &error),
            }
        }
        let gaps = "SELECT lane, value FROM gap ORDER BY lane, from_seq";
        for row in sqlx::query(gaps).fetch_all(&mut self.connection).await? {
            let Some(lane) = lane_of(row.try_get(0)?) else { continue };
            let gap: Gap = read("gap", row.try_get::<String, _>(1)?.as_str())?;
            memory.ring.lane_mut(lane).gaps.push_back(gap);
        }
        for lane in Lane::ALL {
            memory.ring.lane_mut(lane).gaps.make_contiguous().sort_by_key(|gap| gap.from_seq);
        }
        Ok(())
    }
}

#[async_trait]
impl Store for SqliteStore {
    async fn load(&mut self, new_ring_id: &str) -> Result<RobotMemory, Error> {
        let ring = sqlx::query("INSERT INTO fact (key, value) VALUES ('ring', $1) ON CONFLICT DO NOTHING");
        let ring = ring.bind(new_ring_id);
        ring.execute(&mut self.connection).await?;
        let mut memory = RobotMemory::new(new_ring_id);
        self.facts(&mut memory).await?;
        self.subjects(&mut memory).await?;
        self.lanes(&mut memory).await?;
        Ok(memory)
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
        Op::Proven(proven) => fact(on, "proven", proven.as_ref()).await,
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
            let listing = "INSERT INTO unclosed (attempt, value) VALUES ($1, $2)
                ON CONFLICT (attempt) DO UPDATE SET value = excluded.value";
            run(on, sqlx::query(listing).bind(attempt.to_string()).bind(text(listed)?)).await
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
            let insert =
                sqlx::query("INSERT INTO sample (lane, seq, value) VALUES ($1, $2, $3)").bind(*lane as i64).bind(seq);
            run(on, insert.bind(text(sample.as_ref())?)).await?;
            let produced = "INSERT INTO lane (lane, produced, acked) VALUES ($1, $2, 0)
                ON CONFLICT (lane) DO UPDATE SET produced = excluded.produced";
            run(on, sqlx::query(produced).bind(*lane as i64).bind(seq)).await
        }
        Op::Free(lane, seq) => {
            let acked = "INSERT INTO lane (lane, produced, acked) VALUES ($1, $2, $2)
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
            let insert = sqlx::query("INSERT INTO gap (lane, from_seq, to_seq, value) VALUES ($1, $2, $3, $4)");
            run(on, insert.bind(lane).bind(from).bind(to).bind(text(gap)?)).await
        }
        Op::Jump(lane, watermark) => {
            for sql in ["DELETE FROM sample WHERE lane = $1", "DELETE FROM gap WHERE lane = $1"] {
                run(on, sqlx::query(sql).bind(*lane as i64)).await?;
            }
            let set = "INSERT INTO lane (lane, produced, acked) VALUES ($1, $2, $2)
                ON CONFLICT (lane) DO UPDATE SET produced = excluded.produced, acked = excluded.acked";
            run(on, sqlx::query(set).bind(*lane as i64).bind(*watermark as i64)).await
        }
        _ => Ok(()),
    }
}

async fn fact<T: Serialize + Sync>(on: &mut SqliteConnection, key: &'static str, value: &T) -> Result<(), Error> {
    let upsert = "INSERT INTO fact (key, value) VALUES ($1, $2) ON CONFLICT (key) DO UPDATE SET value = excluded.value";
    run(on, sqlx::query(upsert).bind(key).bind(text(value)?)).await
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

/// None: a lane of a newer version.
fn lane_of(number: i64) -> Option<Lane> {
    Lane::ALL.into_iter().find(|lane| *lane as i64 == number)
}

/// A sample of a newer version is said to the server as missing, never in silence; its row stays until that is
/// acknowledged.
fn set_aside(buffer: &mut LaneBuffer, lane: Lane, seq: u64, error: &serde_json::Error) {
    if let Some(gap) = buffer.gaps.back_mut().filter(|gap| gap.to_seq + 1 == seq) {
        gap.to_seq = seq;
        return;
    }
    tracing::warn!(lane = lane.as_str(), seq, %error, "samples of a newer version are told as missing");
    let reason = Reason::from(Code::RowUnknown).with("row", format!("sample/{seq}"));
    buffer.gaps.push_back(Gap { lane, from_seq: seq, to_seq: seq, reason });
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
