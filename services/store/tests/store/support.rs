//! What the store's tests share: items without records, a clock that stands still, all engines.

use crate::server::PostgresServer;
use midshift_core::ids::SiteId;
use midshift_core::item::{Expect, Item, RowChange, Write};
use midshift_core::rows::{Index, Key, Revision, Table, Writer};
use midshift_core::time::{Clock, Now, Utc};
use midshift_store::{
    Applied, CommitError, MemoryStore, PostgresConfig, PostgresStore, SqliteStore, Store, StoreId, migrate_postgres,
};
use sqlx::{AssertSqlSafe, Connection, PgConnection};
use std::sync::Arc;

/// Wall time of every test.
pub const WALL: i64 = 1_780_000_000_000;

pub struct StandingClock;

impl Clock for StandingClock {
    fn now(&self) -> Now {
        Now { wall: Utc(WALL), utc: Utc(WALL), ..Now::default() }
    }
    fn rate_permille(&self) -> u32 {
        1000
    }
}

pub fn clock() -> Arc<dyn Clock> {
    Arc::new(StandingClock)
}

pub fn site() -> SiteId {
    SiteId::parse("north").expect("a site id")
}

/// A store under test; the directory goes when it does.
pub struct Bench {
    pub store: Arc<dyn Store>,
    pub _dir: Option<tempfile::TempDir>,
}

pub fn memory() -> Bench {
    let store = MemoryStore::new(site(), StoreId(Arc::from("memory")), clock());
    Bench { store: Arc::new(store), _dir: None }
}

pub async fn sqlite() -> Bench {
    let dir = tempfile::tempdir().expect("a directory");
    let store = SqliteStore::open(dir.path(), site(), clock()).await.expect("a new store");
    Bench { store: Arc::new(store), _dir: Some(dir) }
}

/// The address of a database of its own on the shared server, with the schema in it and nothing else.
pub async fn database() -> PostgresConfig {
    static TEMPLATE: tokio::sync::OnceCell<()> = tokio::sync::OnceCell::const_new();
    let server = PostgresServer::shared();
    TEMPLATE
        .get_or_init(async || {
            // The first one that is made.
            let template = PostgresConfig::new(server.database_named("template_midshift"));
            migrate_postgres(&template).await.expect("migrations");
        })
        .await;
    PostgresConfig::new(server.database_from("template_midshift"))
}

/// Someone else on the database, who may break the rules.
pub async fn stranger(config: &PostgresConfig) -> PgConnection {
    let mut connection = PgConnection::connect(&config.url).await.expect("a connection");
    say(&mut connection, "SET search_path TO control").await;
    connection
}

pub async fn say(stranger: &mut PgConnection, sql: &str) {
    sqlx::raw_sql(AssertSqlSafe(sql)).execute(stranger).await.expect(sql);
}

/// The one number that `sql` asks for.
pub async fn number(stranger: &mut PgConnection, sql: &str) -> i64 {
    sqlx::query_scalar(AssertSqlSafe(sql)).fetch_one(stranger).await.expect(sql)
}

/// Returns once a writer of the store waits for a lock that someone else has.
pub async fn until_a_writer_waits(stranger: &mut PgConnection) {
    let waiting = "SELECT COUNT(*) FROM pg_stat_activity WHERE datname = current_database() \
                   AND application_name = 'midshift' AND wait_event_type = 'Lock'";
    while number(stranger, waiting).await == 0 {}
}

pub async fn postgres_at(config: &PostgresConfig) -> PostgresStore {
    PostgresStore::open(config, site(), clock()).await.expect("a store")
}

pub async fn postgres() -> Bench {
    Bench { store: Arc::new(postgres_at(&database().await).await), _dir: None }
}

pub fn put(table: Table, id: &str, expect: Expect, body: &str) -> RowChange {
    indexed(table, id, expect, body, Index::default())
}

pub fn indexed(table: Table, id: &str, expect: Expect, body: &str, index: Index) -> RowChange {
    let write = Write::Put { index, body: Arc::from(body) };
    RowChange { key: Key::new(table, id), expect, write, kind: "row.put" }
}

pub fn item(writer: Writer, rows: Vec<RowChange>) -> Item {
    Item { rows, ..Item::new(writer, "test") }
}

/// Commits one item.
pub async fn one(store: &dyn Store, writer: Writer, rows: Vec<RowChange>) -> Result<Applied, CommitError> {
    store.commit(vec![item(writer, rows)]).await.remove(0)
}

pub const fn at(revision: u64) -> Expect {
    Expect::At(Revision(revision))
}
