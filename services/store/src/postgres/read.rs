//! Reads beside the writer: each answer is of one moment.
//!
//! Invariant: what must hold together (rows and their number, entries and the head) is read in one transaction that sees one
//! snapshot. Because whoever commits has the head row for itself, a snapshot that shows a number shows everything before it.

use crate::audit::{self, Heads};
use crate::gather::Gathered;
use crate::queue::unavailable;
use crate::sql::{self, ENTRY_READ, entry, is_text, row};
use crate::store::{Wanted, page_of};
use crate::{Cursor, Error, FEED_PAGE_MAX, FeedPage, GET_KEYS_MAX, Query, Snapshot};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Naming, Row, RowSelection, Seq, Table};
use sqlx::postgres::PgRow;
use sqlx::{AssertSqlSafe, PgConnection, PgPool, Postgres, Row as _, Transaction};
use std::collections::BTreeSet;

/// One snapshot for all statements, whatever the database's own default is.
pub(super) const BEGIN: &str = "BEGIN ISOLATION LEVEL REPEATABLE READ READ ONLY";

pub(super) async fn begin(readers: &PgPool) -> Result<Transaction<'static, Postgres>, sqlx::Error> {
    readers.begin_with(BEGIN).await
}

pub(super) async fn get(readers: &PgPool, site_id: &SiteId, keys: &[Key]) -> Result<Vec<Row>, sqlx::Error> {
    Ok(sql::in_order(keys, rows_by_ids(readers, site_id, keys).await?))
}

async fn rows_by_ids<'c>(
    executor: impl sqlx::Executor<'c, Database = Postgres>,
    site_id: &SiteId,
    keys: impl IntoIterator<Item = &Key>,
) -> Result<Vec<Row>, sqlx::Error> {
    let ids = sql::ids_by_table(keys);
    if ids.is_empty() {
        return Ok(Vec::new());
    }
    let text = sql::by_ids(ids.keys().copied(), |bound| format!("= ANY(${bound})"));
    let mut select = sqlx::query(AssertSqlSafe(text)).bind(site_id.as_str());
    for ids in ids.into_values() {
        select = select.bind(ids.into_iter().collect::<Vec<_>>());
    }
    select.fetch_all(executor).await?.iter().map(sql::row_of_any).collect()
}

/// Each state is read from its own stretch of the index and the stretches are merged, as with SQLite.
pub(super) async fn list(readers: &PgPool, site_id: &SiteId, query: &Query) -> Result<Vec<Row>, sqlx::Error> {
    if query.parent.iter().chain(&query.id_prefix).any(|text| !is_text(text)) {
        return Ok(Vec::new());
    }
    let states: BTreeSet<i64> = query.states.iter().copied().collect();
    let mut transaction = begin(readers).await?;
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
    connection: &mut PgConnection,
    site_id: &SiteId,
    query: &Query,
    state: Option<i64>,
) -> Result<Vec<Row>, sqlx::Error> {
    let mut select = sqlx::query(AssertSqlSafe(sql::list(query, state))).bind(site_id.as_str());
    if let Some(parent) = &query.parent {
        select = select.bind(&**parent);
    }
    if let Some(state) = state {
        select = select.bind(state);
    }
    if let Some(prefix) = &query.id_prefix {
        select = select.bind(&**prefix);
    }
    if let Some(behind) = query.behind_prefix() {
        select = select.bind(behind);
    }
    if let Some(Cursor { order, id }) = &query.after {
        select = if query.id_prefix.is_none() { select.bind(*order) } else { select };
        // A cursor that somebody made up may have a NUL in it: what stands before that is where the list goes on.
        select = select.bind(id.split('\0').next());
    }
    let rows = select.bind(query.rows_max() as i64).fetch_all(connection).await?;
    rows.iter().map(|found| row(query.table, found)).collect()
}

pub(super) async fn read(
    readers: &PgPool,
    site_id: &SiteId,
    parts: &[RowSelection],
    named: Naming,
) -> Result<Snapshot, sqlx::Error> {
    let mut transaction = begin(readers).await?;
    let seq = head(&mut *transaction, site_id).await?;
    let mut gathered = Gathered::new(parts, named);
    for part in parts {
        let (table, selects) = match part {
            RowSelection::Whole(table) => {
                (*table, vec![sqlx::query(AssertSqlSafe(sql::whole(*table))).bind(site_id.as_str())])
            }
            RowSelection::InStates(table, states) => {
                let select = || sqlx::query(AssertSqlSafe(sql::in_state(*table))).bind(site_id.as_str());
                (*table, states.iter().map(|state| select().bind(*state)).collect())
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
            let select = sqlx::query(AssertSqlSafe(sql::of_parent(table))).bind(site_id.as_str()).bind(&*parent);
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

fn rows_of(table: Table, rows: &[PgRow]) -> Result<Vec<Row>, sqlx::Error> {
    rows.iter().map(|one| row(table, one)).collect()
}

/// The newest number that is committed.
pub(super) async fn head<'c>(
    executor: impl sqlx::Executor<'c, Database = Postgres>,
    site_id: &SiteId,
) -> Result<Seq, sqlx::Error> {
    sql::seq(&sqlx::query(sql::HEAD).bind(site_id.as_str()).fetch_one(executor).await?, 0)
}

pub(super) async fn feed(
    readers: &PgPool,
    site_id: &SiteId,
    wanted: &Wanted,
    after: Seq,
    limit: usize,
) -> Result<FeedPage, Error> {
    let limit = limit.clamp(1, FEED_PAGE_MAX);
    let mut transaction = begin(readers).await.map_err(unavailable)?;
    let head = head(&mut *transaction, site_id).await.map_err(unavailable)?;
    if after == head {
        // Nothing is after the head, whatever has been pruned before it.
        return Ok(page_of(Vec::new(), limit, head));
    }
    let oldest = oldest_cursor(&mut transaction, site_id, &wanted.logs).await.map_err(unavailable)?;
    if after < oldest || after > head {
        return Err(Error::CursorExpired { asked: after, oldest });
    }
    let about = wanted.about.as_ref().map(|(table, ids)| {
        let ids: Vec<&str> = ids.iter().map(|id| &**id).filter(|id| is_text(id)).collect();
        (*table, ids)
    });
    let mut entries = Vec::new();
    for log in &wanted.logs {
        let page = log_page(&mut transaction, site_id, *log, about.as_ref(), after, limit).await;
        entries.extend(page.map_err(unavailable)?);
    }
    entries.sort_unstable_by_key(|e: &Entry| e.seq);
    Ok(page_of(entries, limit, head))
}

async fn oldest_cursor(
    connection: &mut PgConnection,
    site_id: &SiteId,
    logs: &BTreeSet<Log>,
) -> Result<Seq, sqlx::Error> {
    let mut oldest = Seq(0);
    for mark in sqlx::query(sql::LOG_MARKS).bind(site_id.as_str()).fetch_all(connection).await? {
        let name: &str = mark.try_get(0)?;
        if logs.iter().any(|log| log.name() == name) {
            oldest = oldest.max(sql::seq(&mark, 1)?);
        }
    }
    Ok(oldest)
}

async fn log_page(
    connection: &mut PgConnection,
    site_id: &SiteId,
    log: Log,
    about: Option<&(Option<Table>, Vec<&str>)>,
    after: Seq,
    limit: usize,
) -> Result<Vec<Entry>, sqlx::Error> {
    let asked = about.map_or_else(String::new, |(table, _)| format!(" AND subject = ANY($4){}", sql::of_table(*table)));
    let sql =
        format!("SELECT {ENTRY_READ} FROM {} WHERE site_id = $1 AND seq > $2{asked} ORDER BY seq LIMIT $3", log.name());
    let mut select =
        sqlx::query(AssertSqlSafe(sql)).bind(site_id.as_str()).bind(after.0.cast_signed()).bind(limit as i64);
    if let Some((_, ids)) = about {
        select = select.bind(ids);
    }
    let rows = select.fetch_all(connection).await?;
    rows.iter().map(|row| entry(log, row)).collect()
}

/// Where the chains of the audit stand, as it was noted.
pub(super) async fn audit_heads(readers: &PgPool, site_id: &SiteId) -> Result<Heads, sqlx::Error> {
    let rows = sqlx::query(sql::AUDIT_HEADS).bind(site_id.as_str()).fetch_all(readers).await?;
    audit::heads(&rows)
}

/// How many entries a log holds.
pub(super) async fn count(readers: &PgPool, site_id: &SiteId, log: Log) -> Result<u64, sqlx::Error> {
    let select = sqlx::query(AssertSqlSafe(sql::count(log))).bind(site_id.as_str());
    Ok(select.fetch_one(readers).await?.try_get::<i64, _>(0)?.cast_unsigned())
}

/// Number and commit time of the oldest entries of a log.
pub(super) async fn oldest(
    readers: &PgPool,
    site_id: &SiteId,
    log: Log,
    limit: usize,
) -> Result<Vec<(Seq, i64)>, sqlx::Error> {
    let select = sqlx::query(AssertSqlSafe(sql::oldest(log))).bind(site_id.as_str()).bind(limit as i64);
    let rows = select.fetch_all(readers).await?;
    rows.iter().map(|row| Ok((sql::seq(row, 0)?, row.try_get(1)?))).collect()
}
