//! Connections to PostgreSQL, each with the bounds that keep a broken process from holding others up.
//!
//! Invariant: every connection has a lock, statement and idle-in-transaction limit on the server's side, and every call one on
//! ours. No connection that writes is handed out by a server that would lose what it acknowledged. What is encrypted is TLS 1.3 with a server that proved its
//! name; what is not stays on this machine, or was said to be so in the address.

use crate::{Cause, Error, OpenError};
use sqlx::postgres::{PgConnectOptions, PgListener, PgPool, PgPoolOptions, PgSslMode};
use sqlx::{ConnectOptions, Connection, PgConnection, Row};
use std::net::IpAddr;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

/// Schema of what the services write as rows.
pub(super) const CONTROL_SCHEMA: &str = "control";
/// Schema of samples.
pub(super) const TELEMETRY_SCHEMA: &str = "telemetry";
// sqlx believes these roots beside the one that an address names: without the stand-in this does not compile (record 0048).
const _: () = assert!(webpki_roots::TLS_SERVER_ROOTS.is_empty(), "roots of the public web would be believed");

/// Oldest server that is tried out, as `server_version_num`.
const VERSION_MIN: u32 = 150_000;
/// A writer waits for the site's head at most so long, ms; its callers hear `Unavailable` and try again.
const LOCK_TIMEOUT_MS: u32 = 3_000;
/// A process that went silent inside a transaction loses it after this, ms, and the head is free again.
const IDLE_IN_TRANSACTION_MS: u32 = 3_000;
/// Longest statement of a commit, ms.
const WRITE_STATEMENT_MS: u32 = 5_000;
/// Longest statement of a read, ms.
const READ_STATEMENT_MS: u32 = 15_000;
/// Longest step of a migration, ms.
const MIGRATE_STATEMENT_MS: u32 = 600_000;
/// Longest copy of one table, ms.
const COPY_STATEMENT_MS: u32 = 6 * 3_600_000;
/// What a copy may do between two of its statements before the server gives it up, ms: files are named meanwhile.
const COPY_IDLE_MS: u32 = 600_000;
/// Silence after which the server believes a peer gone, ms.
const PEER_LOST_MS: u32 = 10_000;
/// So often the server looks whether its client is still there while it works for it or waits for a lock, ms. By itself it never looks, and a statement
/// of a process that is gone goes on to its end.
const CLIENT_LOOK: &str = "SELECT set_config('client_connection_check_interval', '1000', false)";
/// What one transaction of the writer may take up to its COMMIT, and the COMMIT itself, before we stop waiting for an answer.
pub(super) const WRITE_PATIENCE: Duration = Duration::from_secs(6);
/// The same for one read.
const READ_PATIENCE: Duration = Duration::from_secs(20);
/// Connecting, or waiting for a read connection.
const CONNECT_PATIENCE: Duration = Duration::from_secs(5);
/// A read connection that comes back and does not answer within this is given up.
const RETURN_PATIENCE: Duration = Duration::from_secs(2);
/// The TLS of this connection, as the server sees it.
const TLS_VERSION: &str = "SELECT version FROM pg_stat_ssl WHERE pid = pg_backend_pid()";
/// The only one that is spoken.
const TLS_NEEDED: &str = "TLSv1.3";
/// Read connections of one store: a list, a snapshot and two feeds at once.
const READERS: u32 = 4;
/// A few statements for each table and log.
const STATEMENTS_CACHED: usize = 512;

/// How a process hears of what others commit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Wakes {
    /// At once by LISTEN, and by looking at the head every 250 ms under it.
    #[default]
    Notified,
    /// By looking only: for servers without LISTEN.
    Swept,
}

/// Which database, and how to use it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PostgresConfig {
    /// `postgres://user:password@host:port/database`, with the parameters that libpq has. Never logged.
    pub url: String,
    /// How others' commits are heard of.
    pub wakes: Wakes,
}

impl PostgresConfig {
    /// The database at `url`, with notifications.
    pub fn new(url: impl Into<String>) -> Self {
        Self { url: url.into(), wakes: Wakes::Notified }
    }

    /// How the database is reached.
    ///
    /// # Errors
    /// If the address cannot be read.
    pub fn road(&self) -> Result<Road, OpenError> {
        Ok(road(&read(&self.url)?))
    }
}

/// How a database is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Road {
    /// Within this machine, in plain text: a socket file, or loopback.
    Local,
    /// TLS 1.3 with a server that proves its name by the root in the address (`sslmode=verify-full`).
    Proven,
    /// Plain text over a network, and the address says so: `sslmode=disable`.
    Plain,
    /// Over a network, and whatever is there would be believed: no `sslmode`, or one that proves nothing.
    Unproven,
}

fn read(url: &str) -> Result<PgConnectOptions, OpenError> {
    PgConnectOptions::from_str(url)
        .map_err(|source| OpenError::Sql { doing: "reading the address of PostgreSQL", source })
}

fn road(options: &PgConnectOptions) -> Road {
    let host = options.get_host().trim_matches(['[', ']']);
    let is_loopback = host.parse::<IpAddr>().map_or(host == "localhost", |ip| ip.is_loopback());
    match options.get_ssl_mode() {
        PgSslMode::VerifyFull => Road::Proven,
        // Whoever asks for TLS gets it, also within the machine.
        PgSslMode::Prefer | PgSslMode::Allow | PgSslMode::Disable if is_loopback || options.get_socket().is_some() => {
            Road::Local
        }
        PgSslMode::Disable => Road::Plain,
        _ => Road::Unproven,
    }
}

/// One PostgreSQL schema of the database: `control` or `telemetry`.
#[derive(Clone)]
pub(super) struct Database {
    options: PgConnectOptions,
    road: Road,
    pub(super) schema: &'static str,
}

/// What a connection is for.
#[derive(Clone, Copy)]
enum Purpose {
    Write,
    Read,
    Migrate,
    Copy,
}

impl Database {
    pub(super) fn new(config: &PostgresConfig, schema: &'static str) -> Result<Self, OpenError> {
        let options = read(&config.url)?;
        let road = road(&options);
        // A server of this machine with a certificate for nobody in particular is not asked for it.
        let options = if road == Road::Local { options.ssl_mode(PgSslMode::Disable) } else { options };
        Ok(Self { options, road, schema })
    }

    fn options(&self, purpose: Purpose) -> PgConnectOptions {
        let statement_ms = match purpose {
            Purpose::Write => WRITE_STATEMENT_MS,
            Purpose::Read => READ_STATEMENT_MS,
            Purpose::Migrate => MIGRATE_STATEMENT_MS,
            Purpose::Copy => COPY_STATEMENT_MS,
        };
        let (lock_ms, idle_ms) = match purpose {
            Purpose::Write | Purpose::Read => (LOCK_TIMEOUT_MS, IDLE_IN_TRANSACTION_MS),
            Purpose::Migrate => (MIGRATE_STATEMENT_MS, IDLE_IN_TRANSACTION_MS),
            Purpose::Copy => (MIGRATE_STATEMENT_MS, COPY_IDLE_MS),
        };
        let limits = [
            ("lock_timeout", lock_ms),
            ("statement_timeout", statement_ms),
            ("idle_in_transaction_session_timeout", idle_ms),
            ("tcp_user_timeout", PEER_LOST_MS),
            ("tcp_keepalives_idle", PEER_LOST_MS / 2_000),
            ("tcp_keepalives_interval", 1),
            ("tcp_keepalives_count", PEER_LOST_MS / 2_000),
        ];
        // A copy whose rows a policy would hide fails instead.
        let security = matches!(purpose, Purpose::Copy).then_some(("row_security", "off"));
        self.options
            .clone()
            .application_name("midshift")
            .statement_cache_capacity(STATEMENTS_CACHED)
            .options(limits)
            .options([("search_path", self.schema), ("client_min_messages", "warning")])
            .options(security)
            .disable_statement_logging()
    }

    async fn connect(&self, purpose: Purpose) -> Result<PgConnection, OpenError> {
        let failed = |source| OpenError::Sql { doing: "connecting to PostgreSQL", source };
        let options = self.options(purpose);
        let connecting = tokio::time::timeout(CONNECT_PATIENCE, async {
            let mut connection = options.connect().await?;
            welcome(&mut connection, self.road).await?;
            Ok(connection)
        });
        let connection = connecting.await.map_err(|_| failed(sqlx::Error::PoolTimedOut))?.map_err(failed)?;
        let version = connection.server_version_num().unwrap_or_default();
        if version < VERSION_MIN {
            let found = format!("{}.{}", version / 10_000, version % 10_000);
            return Err(OpenError::Unfit { name: "version", needed: "15 or newer", found });
        }
        Ok(connection)
    }

    /// A connection whose commits are durable.
    pub(super) async fn writer(&self) -> Result<PgConnection, OpenError> {
        self.durable(Purpose::Write).await
    }

    /// A connection for whole tables, out or in, whose commits are durable.
    pub(super) async fn copier(&self) -> Result<PgConnection, OpenError> {
        self.durable(Purpose::Copy).await
    }

    async fn durable(&self, purpose: Purpose) -> Result<PgConnection, OpenError> {
        let mut connection = self.connect(purpose).await?;
        let durable = async {
            for name in ["fsync", "full_page_writes", "synchronous_commit"] {
                if setting(&mut connection, name).await? == "off" {
                    return Err(OpenError::NotDurable { name, expected: "on", found: "off".to_owned() });
                }
            }
            let found = setting(&mut connection, "server_encoding").await?;
            if found != "UTF8" {
                return Err(OpenError::Unfit { name: "the encoding", needed: "UTF8", found });
            }
            Ok(())
        };
        let slow = |_| OpenError::Sql { doing: "reading settings", source: sqlx::Error::PoolTimedOut };
        tokio::time::timeout(CONNECT_PATIENCE, durable).await.map_err(slow)??;
        Ok(connection)
    }

    /// A connection for changes of the schema.
    pub(super) async fn migrator(&self) -> Result<PgConnection, OpenError> {
        self.connect(Purpose::Migrate).await
    }

    /// Connections that only read. One whose reader has stopped waiting comes back in the middle of an answer, and the pool waits for the
    /// rest of it without a limit: behind a network that swallows everything that would keep its place for a quarter of an hour.
    pub(super) fn readers(&self) -> PgPool {
        let road = self.road;
        PgPoolOptions::new()
            .max_connections(READERS)
            .acquire_timeout(CONNECT_PATIENCE)
            .after_connect(move |connection, _| Box::pin(welcome(connection, road)))
            .after_release(|connection, _| {
                Box::pin(async move {
                    let answered = tokio::time::timeout(RETURN_PATIENCE, connection.ping()).await;
                    answered.unwrap_or(Err(sqlx::Error::PoolTimedOut)).map(|()| true)
                })
            })
            .connect_lazy_with(self.options(Purpose::Read).options([("default_transaction_read_only", "on")]))
    }

    /// A connection that hears `channel`; it has no limits, because it waits.
    pub(super) async fn listener(&self, channel: &str) -> Result<PgListener, sqlx::Error> {
        let options = self.options(Purpose::Read).options([("statement_timeout", 0)]);
        let pool = PgPoolOptions::new().max_connections(1).acquire_timeout(CONNECT_PATIENCE).max_lifetime(None);
        let mut listener = PgListener::connect_with(&pool.idle_timeout(None).connect_with(options).await?).await?;
        listener.ignore_pool_close_event(true);
        listener.eager_reconnect(false);
        listener.listen(channel).await?;
        Ok(listener)
    }
}

/// What every connection begins with, but that of a listener, which only hears numbers.
async fn welcome(connection: &mut PgConnection, road: Road) -> Result<(), sqlx::Error> {
    if road == Road::Proven {
        check_version(connection).await?;
    }
    look_after(connection).await
}

/// The library would speak version 1.2 too. A server that does not say what it speaks has none of PostgreSQL's tables for that, and was proven all the same.
async fn check_version(connection: &mut PgConnection) -> Result<(), sqlx::Error> {
    let version: Option<String> =
        match sqlx::query_scalar::<_, Option<String>>(TLS_VERSION).fetch_optional(connection).await {
            Err(sqlx::Error::Database(_)) => None,
            told => told?.flatten(),
        };
    match version {
        Some(version) if version != TLS_NEEDED => Err(sqlx::Error::Configuration(
            format!("PostgreSQL speaks {version} and must speak {TLS_NEEDED}: set ssl_min_protocol_version = '{TLS_NEEDED}' there").into(),
        )),
        _ => Ok(()),
    }
}

/// Has the server end what it does for a client that is gone. Not an option of the connection: a server on a machine that cannot tell would refuse it,
/// and goes without.
async fn look_after(connection: &mut PgConnection) -> Result<(), sqlx::Error> {
    match sqlx::query(CLIENT_LOOK).execute(connection).await {
        Err(sqlx::Error::Database(_)) => Ok(()),
        looked => looked.map(drop),
    }
}

async fn setting(connection: &mut PgConnection, name: &'static str) -> Result<String, OpenError> {
    let row = sqlx::query("SELECT current_setting($1)").bind(name).fetch_one(connection).await;
    row.and_then(|row| row.try_get(0)).map_err(|source| OpenError::Sql { doing: "reading a setting", source })
}

/// What a read answers, or that the server has not answered in time.
pub(super) async fn patiently<T>(reading: impl Future<Output = Result<T, Error>>) -> Result<T, Error> {
    tokio::time::timeout(READ_PATIENCE, reading).await.unwrap_or_else(|_| Err(Error::Unavailable(no_answer())))
}

/// Serialization failure and deadlock: the server says that it wrote nothing, also when it says so at COMMIT.
pub(super) fn is_undone_by_others(error: &sqlx::Error) -> bool {
    error.as_database_error().and_then(|e| e.code()).is_some_and(|code| code == "40001" || code == "40P01")
}

/// The connection is no more: what was open on it is rolled back, and nothing can be said on it again. Classes 08 and 57P0x are the server's own words for it.
pub(super) fn is_gone(error: &sqlx::Error) -> bool {
    let told = |code: &str| code.starts_with("08") || code.starts_with("57P0");
    match error {
        sqlx::Error::Io(_) => true,
        sqlx::Error::Database(error) => error.code().is_some_and(|code| told(&code)),
        _ => false,
    }
}

/// The server has not answered.
pub(super) fn no_answer() -> Cause {
    Arc::new(std::io::Error::new(std::io::ErrorKind::TimedOut, "PostgreSQL has not answered in time"))
}

#[cfg(test)]
mod tests {
    use super::{PostgresConfig, Road};

    #[test]
    fn a_database_over_a_network_is_proven_or_its_address_says_that_it_is_plain() {
        let road = |rest: &str| PostgresConfig::new(format!("postgres://u:p@{rest}")).road().ok();
        for local in
            ["localhost/d", "127.0.0.1:5433/d", "x/d?host=/run/postgresql", "[::1]/d", "localhost/d?sslmode=disable"]
        {
            assert_eq!(road(local), Some(Road::Local), "{local}");
        }
        for unproven in ["db/d", "10.0.0.1/d", "db/d?sslmode=prefer", "db/d?sslmode=require", "db/d?sslmode=verify-ca"]
        {
            assert_eq!(road(unproven), Some(Road::Unproven), "{unproven}");
        }
        assert_eq!(road("x/d?host=db.local"), Some(Road::Unproven));
        assert_eq!(road("db/d?sslmode=disable"), Some(Road::Plain));
        assert_eq!(road("db/d?sslmode=verify-full&sslrootcert=/r"), Some(Road::Proven));
        assert_eq!(road("127.0.0.1/d?sslmode=verify-full&sslrootcert=/r"), Some(Road::Proven));
        assert!(PostgresConfig::new("postgres://[").road().is_err());
    }
}
