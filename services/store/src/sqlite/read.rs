//! Reads of `control.db`, beside the writer and never in its way.
//!
//! Invariant: what must hold together (rows and their number, entries and the head) is read in one transaction. Only names from
//! closed lists are spliced into text.

use super::write_sql::placeholders;
use crate::audit::{self, Heads};
use crate::gather::Gathered;
use crate::queue::unavailable;
use crate::sql::{self, ENTRY_READ, entry, row};
use crate::store::{Wanted, page_of};
use crate::{Cursor, Error, FEED_PAGE_MAX, FeedPage, GET_KEYS_MAX, Query, Snapshot};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Naming, Row, RowSelection, Seq, Table};
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{AssertSqlSafe, Row as _, Sqlite, SqliteConnection, SqlitePool};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Ids of one statement.
const IDS_PER_STATEMENT: usize = 500;
/// Up to so many subjects are sought one by one through the index of subjects; for more it is cheaper to walk the log.
const SUBJECTS_SOUGHT: usize = 64;

type Statement<'q> = sqlx::query::Query<'q, Sqlite, SqliteArguments>;

fn prepared<'q>(sql: String) -> Statement<'q> {
    sqlx::query(AssertSqlSafe(sql))
}

pub(super) async fn get(readers: &SqlitePool, site_id: &SiteId, keys: &[Key]) -> Result<Vec<Row>, sqlx::Error> {
    Ok(sql::in_order(keys, rows_by_ids(readers, site_id, keys).await?))
}

async fn rows_by_ids<'c>(
    executor: impl sqlx::Executor<'c, Database = Sqlite>,
    site_id: &SiteId,
    keys: impl IntoIterator<Item = &Key>,
) -> Result<Vec<Row>, sqlx::Error> {
    let ids = sql::ids_by_table(keys);
    if ids.is_empty() {
        return Ok(Vec::new());
    }
    let text = sql::by_ids(ids.keys().copied(), |bound| format!("IN (SELECT value FROM json_each(${bound}))"));
    let mut select = prepared(text).bind(site_id.as_str());
    for ids in ids.into_values() {
        select = select.bind(serde_json::to_string(&ids).map_err(|error| sqlx::Error::Encode(error.into()))?);
    }
    select.fetch_all(executor).await?.iter().map(sql::row_of_any).collect()
}

/// Each state is read from its own stretch of the index and the stretches are merged: with a list of states SQLite would walk the
/// whole table in order of `ord` and throw most of it away.
pub(super) async fn list(readers: &SqlitePool, site_id: &SiteId, query: &Query) -> Result<Vec<Row>, sqlx::Error> {
    let states: BTreeSet<i64> = query.states.iter().copied().collect();
    let mut transaction = readers.begin().await?;
    if states.is_empty() {
        return list_one(&mut transaction, site_id, query, None).await;
    }
    let mut rows = Vec::new();
    for state in states {
        rows.extend(list_one(&mut transaction, site_id, query, Some(state)).await?);
    }
    Ok(sql::merged(query, rows))
}

async fn list_one(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    query: &Query,
    state: Option<i64>,
) -> Result<Vec<Row>, sqlx::Error> {
    let mut select = prepared(sql::list(query, state)).bind(site_id.as_str());
    if let Some(parent) = &query.parent {
        select = select.bind(parent.clone());
    }
    if let Some(state) = state {
        select = select.bind(state);
    }
    if let Some(prefix) = &query.id_prefix {
        select = select.bind(prefix.clone());
    }
    if let Some(behind) = query.behind_prefix() {
        select = select.bind(behind);
    }
    if let Some(Cursor { order, id }) = &query.after {
        select = if query.id_prefix.is_none() { select.bind(*order) } else { select }.bind(id.clone());
    }
    let rows = select.bind(query.rows_max() as i64).fetch_all(connection).await?;
    rows.iter().map(|found| row(query.table, found)).collect()
}

pub(super) async fn read(
    readers: &SqlitePool,
    site_id: &SiteId,
    parts: &[RowSelection],
    named: Naming,
) -> Result<Snapshot, sqlx::Error> {
    let mut transaction = readers.begin().await?;
    let seq = super::writer::head(&mut transaction, site_id).await?;
    let mut gathered = Gathered::new(parts, named);
    for part in parts {
        let (table, selects) = match part {
            RowSelection::Whole(table) => (*table, vec![prepared(sql::whole(*table)).bind(site_id.as_str())]),
            RowSelection::InStates(table, states) => {
                let one = |state: &i64| prepared(sql::in_state(*table)).bind(site_id.as_str()).bind(*state);
                (*table, states.iter().map(one).collect())
            }
            RowSelection::Rows(_) | RowSelection::OfParents { .. } => continue,
        };
        for select in selects {
            gathered.add(rows_of(table, &select.fetch_all(&mut *transaction).await?)?);
        }
    }
    loop {
        let parents = gathered.parents();
        let is_whole = parents.is_empty();
        for (table, parent) in parents {
            let select = prepared(sql::of_parent(table)).bind(site_id.as_str()).bind(parent);
            gathered.add(rows_of(table, &select.fetch_all(&mut *transaction).await?)?);
        }
        let missing = gathered.missing();
        if missing.is_empty() && is_whole {
            return Ok(gathered.at(seq));
        }
        for some in missing.chunks(GET_KEYS_MAX) {
            gathered.add(rows_by_ids(&mut *transaction, site_id, some).await?);
        }
    }
}

fn rows_of(table: Table, rows: &[SqliteRow]) -> Result<Vec<Row>, sqlx::Error> {
    rows.iter().map(|one| row(table, one)).collect()
}

pub(super) async fn feed(
    readers: &SqlitePool,
    site_id: &SiteId,
    wanted: &Wanted,
    after: Seq,
    limit: usize,
) -> Result<FeedPage, Error> {
    let limit = limit.clamp(1, FEED_PAGE_MAX);
    let mut transaction = readers.begin().await.map_err(unavailable)?;
    let head = super::writer::head(&mut transaction, site_id).await.map_err(unavailable)?;
    let oldest = oldest_cursor(&mut transaction, site_id, &wanted.logs).await.map_err(unavailable)?;
    if after < oldest || after > head {
        return Err(Error::CursorExpired { asked: after, oldest });
    }
    let mut entries = Vec::new();
    for log in &wanted.logs {
        let of_log = match &wanted.about {
            None => log_page(&mut transaction, site_id, *log, None, &[], after, limit).await,
            Some((table, of)) => {
                let of: Vec<&Arc<str>> = of.iter().collect();
                subject_pages(&mut transaction, site_id, *log, *table, &of, after, limit).await
            }
        };
        entries.extend(of_log.map_err(unavailable)?);
    }
    entries.sort_unstable_by_key(|e: &Entry| e.seq);
    Ok(page_of(entries, limit, head))
}

async fn oldest_cursor(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    logs: &BTreeSet<Log>,
) -> Result<Seq, sqlx::Error> {
    let marks = sqlx::query(sql::LOG_MARKS);
    let mut oldest = Seq(0);
    for mark in marks.bind(site_id.as_str()).fetch_all(connection).await? {
        let name: &str = mark.try_get(0)?;
        if logs.iter().any(|log| log.name() == name) {
            oldest = oldest.max(Seq(mark.try_get::<i64, _>(1)?.cast_unsigned()));
        }
    }
    Ok(oldest)
}

/// The first `limit` entries about any of `subjects`: the first of each slice of subjects hold the first of all.
async fn subject_pages(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    log: Log,
    table: Option<Table>,
    subjects: &[&Arc<str>],
    after: Seq,
    limit: usize,
) -> Result<Vec<Entry>, sqlx::Error> {
    let mut entries = Vec::new();
    let per_statement = if subjects.len() <= SUBJECTS_SOUGHT { 1 } else { IDS_PER_STATEMENT };
    for slice in subjects.chunks(per_statement) {
        entries.extend(log_page(connection, site_id, log, table, slice, after, limit).await?);
    }
    Ok(entries)
}

async fn log_page(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    log: Log,
    table: Option<Table>,
    subjects: &[&Arc<str>],
    after: Seq,
    limit: usize,
) -> Result<Vec<Entry>, sqlx::Error> {
    let about = if subjects.is_empty() {
        String::new()
    } else {
        format!(" AND subject IN {}{}", placeholders(1, subjects.len()), sql::of_table(table))
    };
    let mut select = prepared(format!(
        "SELECT {ENTRY_READ} FROM {} WHERE site_id = ? AND seq > ?{about} ORDER BY seq LIMIT ?",
        log.name()
    ))
    .bind(site_id.as_str())
    .bind(after.0.cast_signed());
    for subject in subjects {
        select = select.bind(Arc::clone(subject));
    }
    let rows = select.bind(limit as i64).fetch_all(connection).await?;
    rows.iter().map(|row| entry(log, row)).collect()
}

/// Where the chains of the audit stand, as it was noted.
pub(super) async fn audit_heads(readers: &SqlitePool, site_id: &SiteId) -> Result<Heads, sqlx::Error> {
    let rows = sqlx::query(sql::AUDIT_HEADS).bind(site_id.as_str()).fetch_all(readers).await?;
    audit::heads(&rows)
}

/// How many entries a log holds.
pub(super) async fn count(readers: &SqlitePool, site_id: &SiteId, log: Log) -> Result<u64, sqlx::Error> {
    let select = prepared(sql::count(log));
    Ok(select.bind(site_id.as_str()).fetch_one(readers).await?.try_get::<i64, _>(0)?.cast_unsigned())
}

/// Number and commit time of the oldest entries of a log.
pub(super) async fn oldest(
    readers: &SqlitePool,
    site_id: &SiteId,
    log: Log,
    limit: usize,
) -> Result<Vec<(Seq, i64)>, sqlx::Error> {
    let select = prepared(sql::oldest(log));
    let rows = select.bind(site_id.as_str()).bind(limit as i64).fetch_all(readers).await?;
    rows.iter().map(|row| Ok((sql::seq(row, 0)?, row.try_get(1)?))).collect()
}
