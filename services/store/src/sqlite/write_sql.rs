//! The statements of the writer: many rows each, because every statement costs a hop to SQLite's thread and back.
//!
//! Invariant: only table and column names from closed lists are ever spliced into text; every value is bound.
//!
//! Multi-row statements use plain `?`: SQLite finds a numbered name by walking all names, so that thousands of `$n` would cost a
//! square. An engine that needs numbers writes them in [`placeholders`].

use crate::audit::{self, Heads};
use crate::group::{CurrentRevision, Group};
use crate::sql::{self, ENTRY_COLUMNS, ROW_COLUMNS, ROW_CONFLICT, ord};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Revision, Row, Seq, Table};
use sqlx::sqlite::SqliteArguments;
use sqlx::{AssertSqlSafe, Row as _, Sqlite, SqliteConnection, query::Query};
use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

/// Rows of the largest statement. Sizes are powers of two up to this, so that the prepared ones are few and found again.
const ROWS_PER_STATEMENT: usize = 128;

type Statement<'q> = Query<'q, Sqlite, SqliteArguments>;

/// `rows` tuples of `columns` placeholders.
pub(super) fn placeholders(rows: usize, columns: usize) -> String {
    let tuple = format!("({})", vec!["?"; columns].join(", "));
    vec![tuple; rows].join(", ")
}

/// Cuts a slice into statements' worth.
fn statements<T>(mut rest: &[T]) -> impl Iterator<Item = &[T]> {
    std::iter::from_fn(move || {
        let size = ROWS_PER_STATEMENT.min(1 << rest.len().checked_ilog2()?);
        let (now, later) = rest.split_at(size);
        rest = later;
        Some(now)
    })
}

fn prepared<'q>(sql: String) -> Statement<'q> {
    sqlx::query(AssertSqlSafe(sql))
}

/// Writes what a group leaves of its rows.
pub(super) async fn rows(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    rows: &BTreeMap<Key, Option<Row>>,
) -> Result<(), sqlx::Error> {
    let mut put: BTreeMap<Table, Vec<&Row>> = BTreeMap::new();
    let mut gone: BTreeMap<Table, Vec<&Arc<str>>> = BTreeMap::new();
    for (key, row) in rows {
        match row {
            Some(row) => put.entry(key.table).or_default().push(row),
            None => gone.entry(key.table).or_default().push(&key.id),
        }
    }
    for (table, rows) in put {
        for slice in statements(&rows) {
            upsert(table, site_id, slice).execute(&mut *connection).await?;
        }
    }
    for (table, ids) in gone {
        for slice in statements(&ids) {
            let ids = placeholders(1, slice.len());
            let mut delete = prepared(format!("DELETE FROM {} WHERE site_id = ? AND id IN {ids}", table.name()))
                .bind(site_id.as_str());
            for id in slice {
                delete = delete.bind(Arc::clone(id));
            }
            delete.execute(&mut *connection).await?;
        }
    }
    Ok(())
}

fn upsert<'q>(table: Table, site_id: &'q SiteId, rows: &[&Row]) -> Statement<'q> {
    let mut statement = prepared(format!(
        "INSERT INTO {} ({ROW_COLUMNS}) VALUES {} {ROW_CONFLICT}",
        table.name(),
        placeholders(rows.len(), 7),
    ));
    for row in rows {
        statement = statement
            .bind(site_id.as_str())
            .bind(row.key.id.clone())
            .bind(row.revision.0.cast_signed())
            .bind(row.index.state)
            .bind(row.index.parent.clone())
            .bind(ord(row.index.order))
            .bind(row.body.clone());
    }
    statement
}

/// Appends a group's entries to their logs.
pub(super) async fn entries(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    entries: &[Entry],
) -> Result<(), sqlx::Error> {
    for log in Log::ALL {
        let of_log: Vec<&Entry> = entries.iter().filter(|e| e.log == log).collect();
        for slice in statements(&of_log) {
            append(log, site_id, slice).execute(&mut *connection).await?;
        }
    }
    Ok(())
}

fn append<'q>(log: Log, site_id: &'q SiteId, entries: &[&Entry]) -> Statement<'q> {
    let values = placeholders(entries.len(), 13);
    let mut statement = prepared(format!("INSERT INTO {} ({ENTRY_COLUMNS}) VALUES {values}", log.name()));
    for entry in entries {
        statement = statement
            .bind(site_id.as_str())
            .bind(entry.seq.0.cast_signed())
            .bind(entry.table.map(Table::name))
            .bind(entry.subject.clone())
            .bind(entry.revision.0.cast_signed())
            .bind(entry.index.state)
            .bind(entry.index.parent.clone())
            .bind(entry.index.order)
            .bind(entry.body.clone())
            .bind(entry.kind.clone())
            .bind(entry.actor.clone())
            .bind(entry.request_id.clone())
            .bind(entry.at_unix_ms);
    }
    statement
}

/// Where the chains of the audit stand.
pub(super) async fn chains(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<Heads, sqlx::Error> {
    let rows = prepared(audit::select_heads()).bind(site_id.as_str()).fetch_all(connection).await?;
    audit::heads(&rows)
}

/// Moves the heads of the chains that grew, and takes what was cut.
pub(super) async fn grow(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    group: &Group,
) -> Result<(), sqlx::Error> {
    for writer in &group.audited_writers {
        let head = group.chains.get(writer).cloned().unwrap_or_default();
        let upsert = sqlx::query(sql::MOVE_AUDIT_HEAD).bind(site_id.as_str()).bind(writer.as_str());
        upsert.bind(head.n.cast_signed()).bind(head.hash).execute(&mut *connection).await?;
    }
    for (table, up_to) in &group.cuts {
        let delete = prepared(sql::cut(*table)).bind(site_id.as_str()).bind(up_to.cast_signed());
        delete.execute(&mut *connection).await?;
    }
    Ok(())
}

/// Moves the head row.
pub(super) async fn head(connection: &mut SqliteConnection, site_id: &SiteId, head: Seq) -> Result<(), sqlx::Error> {
    sqlx::query(sql::MOVE_HEAD).bind(head.0.cast_signed()).bind(site_id.as_str()).execute(connection).await?;
    Ok(())
}

/// Where some rows of the file stand. Every key asked for is in the answer.
pub(super) async fn read_current_revisions(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    keys: Vec<Key>,
) -> Result<HashMap<Key, CurrentRevision>, sqlx::Error> {
    let mut ids: BTreeMap<Table, Vec<Arc<str>>> = BTreeMap::new();
    for key in &keys {
        ids.entry(key.table).or_default().push(key.id.clone());
    }
    let mut found: HashMap<Key, CurrentRevision> = keys.into_iter().map(|key| (key, None)).collect();
    for (table, ids) in ids {
        for slice in statements(&ids) {
            let list = placeholders(1, slice.len());
            let mut select =
                prepared(format!("SELECT id, revision FROM {} WHERE site_id = ? AND id IN {list}", table.name()))
                    .bind(site_id.as_str());
            for id in slice {
                select = select.bind(id.clone());
            }
            for row in select.fetch_all(&mut *connection).await? {
                let revision = Revision(row.try_get::<i64, _>(1)?.cast_unsigned());
                found.insert(Key::new(table, row.try_get::<&str, _>(0)?), Some(revision));
            }
        }
    }
    Ok(found)
}

/// Takes the entries of a log up to `up_to` out, and remembers that they are gone.
pub(super) async fn prune(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    log: Log,
    up_to: Seq,
) -> Result<(), sqlx::Error> {
    let up_to = up_to.0.cast_signed();
    prepared(sql::prune(log)).bind(site_id.as_str()).bind(up_to).execute(&mut *connection).await?;
    sqlx::query(sql::MARK_LOG).bind(site_id.as_str()).bind(log.name()).bind(up_to).execute(connection).await?;
    Ok(())
}
