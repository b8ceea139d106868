//! Makes an old site in a database: tasks go straight into the tables, in one transaction, and the rest through the store.
//!
//! Invariants:
//! 1. What goes in is what [`OldSite`] composes for the store's items; the columns are those of the store's golden schema.
//! 2. The newest tasks are committed as services do, so that logs, inbox and audit end like those of a site that grew.
//!
//! Used by the tests of whole servers and by the bench, which includes this file.

use super::old_site::{ENTRIES_KEPT, OldSite, commit, spec, submitted};
use anyhow::Context;
use midshift_core::ids::SiteId;
use midshift_core::item::{Item, RowChange, Write as Change};
use midshift_core::rows::{Index, Table, Writer};
use midshift_process::clock::clock;
use midshift_server::keep_limits::KeepLimits;
use midshift_server::storage::{Database, Storage};
use sqlx::postgres::PgConnectOptions;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqliteSynchronous};
use sqlx::{AssertSqlSafe, ConnectOptions, Connection, PgConnection, SqliteConnection};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;
use std::sync::Arc;

/// Tasks that are committed at the end, as services do it.
const COMMITTED: u64 = 1_000;
/// Items that are gathered before they are written: of fifty tasks each.
const ITEMS_AT_ONCE: usize = 200;
/// Rows of one statement of SQLite.
const ROWS_PER_STATEMENT: usize = 128;
/// Columns of a row, as the golden schema has them.
const COLUMNS: &str = "site_id, id, revision, state, parent, ord, body";
/// Pages that SQLite keeps while it is filled, KiB below zero.
const CACHE: &str = "-262144";

/// Makes `site` in an empty database, or in empty files in `data`.
pub async fn make(site: &OldSite, database: &Database, data: &Path, site_id: &SiteId) -> anyhow::Result<()> {
    let first_committed = site.ended.saturating_sub(COMMITTED) + 1;
    let storage = open(database, data, site_id).await?;
    let store = storage.store();
    site.begin(&*store).await;
    let asked = OldSite::slices(1..=first_committed - 1).map(|_| {
        let mut item = Item::new(Writer::Task, "task");
        item.audit(submitted());
        item
    });
    commit(&*store, asked.collect()).await;
    let first_kept = site.ended.saturating_sub(ENTRIES_KEPT) + 1;
    commit(&*store, OldSite::slices(first_kept..=first_committed - 1).map(|numbers| site.inbox(numbers)).collect())
        .await;
    storage.close().await;
    drop(store);
    let mut tables = Tables::open(database, data).await?;
    let spec = spec();
    let mut items = Vec::new();
    for numbers in OldSite::slices(1..=first_committed - 1) {
        items.extend(site.rows(numbers, &spec));
        if items.len() >= ITEMS_AT_ONCE {
            tables.put_items(site_id, std::mem::take(&mut items)).await?;
        }
    }
    tables.put_items(site_id, items).await?;
    tables.close().await?;
    let storage = open(database, data, site_id).await?;
    let store = storage.store();
    site.write_tasks(&*store, first_committed..=site.ended).await;
    site.finish(&*store).await;
    storage.close().await;
    Ok(())
}

async fn open(database: &Database, data: &Path, site_id: &SiteId) -> anyhow::Result<Storage> {
    database.open(data, site_id.clone(), clock(1000), KeepLimits::default().status_log_bytes).await
}

/// The tables of an engine, in a transaction.
enum Tables {
    Sqlite(SqliteConnection),
    Postgres(PgConnection),
}

/// A row that is created.
struct NewRow {
    id: Arc<str>,
    index: Index,
    body: Arc<str>,
}

impl NewRow {
    /// Its sort key as both engines keep it: a row without one sorts first.
    fn order(&self) -> i64 {
        self.index.order.unwrap_or(i64::MIN)
    }
}

fn rows_of(items: Vec<Item>) -> BTreeMap<Table, Vec<NewRow>> {
    let mut rows: BTreeMap<Table, Vec<NewRow>> = BTreeMap::new();
    for RowChange { key, write, .. } in items.into_iter().flat_map(|item| item.rows) {
        if let Change::Put { index, body } = write {
            rows.entry(key.table).or_default().push(NewRow { id: key.id, index, body });
        }
    }
    rows
}

impl Tables {
    async fn open(database: &Database, data: &Path) -> anyhow::Result<Self> {
        let Some(url) = &database.store else {
            // Nobody needs these files after a failure.
            let options = SqliteConnectOptions::new()
                .filename(data.join("control.db"))
                .journal_mode(SqliteJournalMode::Off)
                .synchronous(SqliteSynchronous::Off)
                .pragma("cache_size", CACHE)
                .disable_statement_logging();
            let mut connection = options.connect().await.context("opening control.db")?;
            sqlx::query("BEGIN EXCLUSIVE").execute(&mut connection).await?;
            return Ok(Self::Sqlite(connection));
        };
        let options: PgConnectOptions = url.parse().context("the address of the database")?;
        let mut connection = options.disable_statement_logging().connect().await.context("the database")?;
        sqlx::query("BEGIN").execute(&mut connection).await?;
        Ok(Self::Postgres(connection))
    }

    async fn put_items(&mut self, site_id: &SiteId, items: Vec<Item>) -> anyhow::Result<()> {
        for (table, mut rows) in rows_of(items) {
            match self {
                Self::Sqlite(connection) => {
                    // In the order of the key, so that neighbours meet in the file.
                    rows.sort_by(|a, b| a.id.cmp(&b.id));
                    for rows in rows.chunks(ROWS_PER_STATEMENT) {
                        insert(connection, table, site_id, rows).await?;
                    }
                }
                Self::Postgres(connection) => copy(connection, table, site_id, &rows).await?,
            }
        }
        Ok(())
    }

    async fn close(self) -> anyhow::Result<()> {
        match self {
            Self::Sqlite(mut connection) => {
                sqlx::query("COMMIT").execute(&mut connection).await?;
                connection.close().await?;
            }
            Self::Postgres(mut connection) => {
                sqlx::query("COMMIT").execute(&mut connection).await?;
                connection.close().await?;
            }
        }
        Ok(())
    }
}

async fn insert(
    connection: &mut SqliteConnection,
    table: Table,
    site_id: &SiteId,
    rows: &[NewRow],
) -> anyhow::Result<()> {
    let tuples = vec!["(?, ?, 1, ?, ?, ?, ?)"; rows.len()].join(", ");
    let sql = format!("INSERT INTO {} ({COLUMNS}) VALUES {tuples}", table.name());
    let mut insert = sqlx::query(AssertSqlSafe(sql));
    for row in rows {
        insert = insert
            .bind(site_id.as_str())
            .bind(row.id.clone())
            .bind(row.index.state)
            .bind(row.index.parent.clone())
            .bind(row.order())
            .bind(row.body.clone());
    }
    insert.execute(connection).await?;
    Ok(())
}

async fn copy(connection: &mut PgConnection, table: Table, site_id: &SiteId, rows: &[NewRow]) -> anyhow::Result<()> {
    let mut text = String::new();
    for row in rows {
        // Bodies are JSON: of what COPY minds they have backslashes alone.
        let state = row.index.state.map_or_else(|| "\\N".to_owned(), |state| state.to_string());
        let parent = row.index.parent.as_deref().unwrap_or("\\N");
        let body = row.body.replace('\\', "\\\\");
        writeln!(text, "{site_id}\t{}\t1\t{state}\t{parent}\t{}\t{body}", row.id, row.order())?;
    }
    let mut copying = connection.copy_in_raw(&format!("COPY control.{} ({COLUMNS}) FROM STDIN", table.name())).await?;
    copying.send(text.into_bytes()).await?;
    copying.finish().await?;
    Ok(())
}
