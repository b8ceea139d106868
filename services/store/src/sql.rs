//! SQL that both engines speak, and how their rows are read: texts, column lists, decoding.
//!
//! Invariant: only table and column names from closed lists are ever spliced into text; every value is bound. Binds are numbered
//! (`$1`), which both engines take.

use crate::{Cursor, Query};
use midshift_core::rows::{Entry, Index, Key, Log, Revision, Row, Seq, Table};
use sqlx::{ColumnIndex, Decode, Type};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Columns of a row, as written.
pub(crate) const ROW_COLUMNS: &str = "site_id, id, revision, state, parent, ord, body";
/// Columns of a row, as [`row`] reads them.
pub(crate) const ROW_READ: &str = "id, revision, state, parent, ord, body";
/// Columns of an entry, as written.
pub(crate) const ENTRY_COLUMNS: &str =
    "site_id, seq, tbl, subject, revision, state, parent, ord, body, kind, actor, request_id, at_unix_ms";
/// Columns of an entry, as [`entry`] reads them.
pub(crate) const ENTRY_READ: &str =
    "seq, tbl, subject, revision, state, parent, ord, body, kind, actor, request_id, at_unix_ms";
/// What an upsert of rows does with those that are there.
pub(crate) const ROW_CONFLICT: &str = "ON CONFLICT (site_id, id) DO UPDATE SET revision = excluded.revision, \
     state = excluded.state, parent = excluded.parent, ord = excluded.ord, body = excluded.body";

pub(crate) const HEAD: &str = "SELECT seq FROM store_head WHERE site_id = $1";
pub(crate) const MOVE_HEAD: &str = "UPDATE store_head SET seq = $1 WHERE site_id = $2";
pub(crate) const IDENTITY: &str = "SELECT site_id, store_id FROM store_head";
/// Identity and newest number.
pub(crate) const STORE: &str = "SELECT site_id, store_id, seq FROM store_head";
pub(crate) const IDENTIFY: &str = "INSERT INTO store_head (site_id, store_id, seq) VALUES ($1, $2, $3)";
/// Makes a restored store another one than it is a copy of.
pub(crate) const RENEW: &str = "UPDATE store_head SET store_id = $1";
pub(crate) const LOG_MARKS: &str = "SELECT log, pruned_seq FROM log_mark WHERE site_id = $1";
pub(crate) const MARK_LOG: &str = "INSERT INTO log_mark (site_id, log, pruned_seq) VALUES ($1, $2, $3) \
     ON CONFLICT (site_id, log) DO UPDATE SET pruned_seq = excluded.pruned_seq";
/// Where each chain of the audit stands, as it was noted with its newest row.
pub(crate) const AUDIT_HEADS: &str = "SELECT chain, n, hash, NULL AS body FROM audit_head WHERE site_id = $1";
/// What stands before the values of a chain, and behind them.
pub(crate) const MOVE_AUDIT_HEAD: &str = "INSERT INTO audit_head (site_id, chain, n, hash) VALUES";
pub(crate) const MOVED_AUDIT_HEAD: &str =
    "ON CONFLICT (site_id, chain) DO UPDATE SET n = excluded.n, hash = excluded.hash";
pub(crate) const FRAME_SIZES: &str =
    "SELECT position, size, at_unix_ms FROM frame_log WHERE site_id = $1 AND position > $2 ORDER BY position LIMIT $3";
pub(crate) const FRAME_BODIES: &str = "SELECT position, at_unix_ms, body FROM frame_log \
     WHERE site_id = $1 AND position > $2 AND position <= $3 ORDER BY position";
/// The oldest rows that were not made coarser yet, at most `$3`; `$2` is the newest that was.
pub(crate) const FRAMES_NEXT: &str = "SELECT position, at_unix_ms, body FROM frame_log \
     WHERE site_id = $1 AND position > $2 ORDER BY position LIMIT $3";
pub(crate) const FRAME_REPLACE: &str = "UPDATE frame_log SET size = $3, body = $4 WHERE site_id = $1 AND position = $2";
/// Up to where rows were made coarser.
pub(crate) const COARSE_HEAD: &str = "SELECT COALESCE(MAX(position), 0) FROM frame_coarse WHERE site_id = $1";
pub(crate) const MOVE_COARSE_HEAD: &str = "INSERT INTO frame_coarse (site_id, position) VALUES ($1, $2) \
     ON CONFLICT (site_id) DO UPDATE SET position = excluded.position";
/// The oldest row, and the oldest that was not made coarser yet.
pub(crate) const FRAMES_OLDEST: &str = "SELECT \
     (SELECT at_unix_ms FROM frame_log WHERE site_id = $1 ORDER BY position LIMIT 1), \
     (SELECT at_unix_ms FROM frame_log WHERE site_id = $1 AND position > $2 ORDER BY position LIMIT 1)";
pub(crate) const FRAME_INSERT: &str =
    "INSERT INTO frame_log (site_id, position, at_unix_ms, size, body) VALUES ($1, $2, $3, $4, $5)";
pub(crate) const FRAME_MARKS: &str = "SELECT robot_id, ring, seq FROM frame_mark WHERE site_id = $1";
/// One mark, if it is still `$4`.
pub(crate) const FRAME_MARK_FORGET: &str =
    "DELETE FROM frame_mark WHERE site_id = $1 AND robot_id = $2 AND ring = $3 AND seq = $4";
pub(crate) const GAPS: &str = "SELECT robot_id, ring, lane, from_seq, to_seq, reason, at_unix_ms FROM gap \
     WHERE site_id = $1 ORDER BY position DESC LIMIT $2";
pub(crate) const GAPS_OF_ROBOT: &str = "SELECT robot_id, ring, lane, from_seq, to_seq, reason, at_unix_ms FROM gap \
     WHERE site_id = $1 AND robot_id = $3 ORDER BY position DESC LIMIT $2";
pub(crate) const GAPS_PRUNE: &str = "DELETE FROM gap WHERE site_id = $1 AND position <= $2";

/// All rows of a table.
pub(crate) fn whole(table: Table) -> String {
    format!("SELECT {ROW_READ} FROM {} WHERE site_id = $1 ORDER BY id", table.name())
}

/// Rows of a table in state `$2`. In the order of the index of states, which is why no engine reads the table for it.
pub(crate) fn in_state(table: Table) -> String {
    format!("SELECT {ROW_READ} FROM {} WHERE site_id = $1 AND state = $2 ORDER BY ord, id", table.name())
}

/// Rows of a table whose parent is `$2`.
pub(crate) fn of_parent(table: Table) -> String {
    format!("SELECT {ROW_READ} FROM {} WHERE site_id = $1 AND parent = $2 ORDER BY ord, id", table.name())
}

/// The ids of keys by table, without what no engine can hold.
pub(crate) fn ids_by_table<'k>(keys: impl IntoIterator<Item = &'k Key>) -> BTreeMap<Table, BTreeSet<&'k str>> {
    let mut ids: BTreeMap<Table, BTreeSet<&str>> = BTreeMap::new();
    for key in keys.into_iter().filter(|key| is_text(&key.id)) {
        ids.entry(key.table).or_default().insert(&key.id);
    }
    ids
}

/// Rows of several tables by their ids, in one statement and so of one moment; the name of its table is behind each. Binds in order: site, then
/// the ids of each table, which `are` compares with bind `n`.
pub(crate) fn by_ids(tables: impl IntoIterator<Item = Table>, are: impl Fn(usize) -> String) -> String {
    let select = |(bound, table): (usize, Table)| {
        let name = table.name();
        format!("SELECT {ROW_READ}, '{name}' AS tbl FROM {name} WHERE site_id = $1 AND id {}", are(bound))
    };
    (2..).zip(tables).map(select).collect::<Vec<_>>().join(" UNION ALL ")
}

/// The rows of `keys` that were found, in the order of `keys`.
pub(crate) fn in_order(keys: &[Key], rows: Vec<Row>) -> Vec<Row> {
    let found: BTreeMap<Key, Row> = rows.into_iter().map(|row| (row.key.clone(), row)).collect();
    keys.iter().filter_map(|key| found.get(key).cloned()).collect()
}

/// Whether every engine can be asked about it: no row has a NUL in its id.
pub(crate) fn is_text(text: &str) -> bool {
    !text.as_bytes().contains(&0)
}

/// What is asked of an entry beside its subject: in words, so that the index of such entries alone is used.
pub(crate) fn of_table(table: Option<Table>) -> String {
    table.map_or_else(String::new, |table| format!(" AND tbl = '{}'", table.name()))
}

/// How many entries a log holds.
pub(crate) fn count(log: Log) -> String {
    format!("SELECT COUNT(*) FROM {} WHERE site_id = $1", log.name())
}

/// Number and time of a log's oldest entries, at most `$2`.
pub(crate) fn oldest(log: Log) -> String {
    format!("SELECT seq, at_unix_ms FROM {} WHERE site_id = $1 ORDER BY seq LIMIT $2", log.name())
}

/// Takes a log's entries up to `$2` out.
pub(crate) fn prune(log: Log) -> String {
    format!("DELETE FROM {} WHERE site_id = $1 AND seq <= $2", log.name())
}

/// Takes a chain's rows up to number `$2` out.
pub(crate) fn cut(table: Table) -> String {
    format!("DELETE FROM {} WHERE site_id = $1 AND ord <= $2", table.name())
}

/// One page of a table, of one state or of any. Binds in order: site, then what is asked of parent, `state`, the prefix and what is
/// behind it, the cursor (order, id; with a prefix its id alone), and the limit.
pub(crate) fn list(query: &Query, state: Option<i64>) -> String {
    let mut sql = format!("SELECT {ROW_READ} FROM {} WHERE site_id = $1", query.table.name());
    let mut bound = 1;
    let mut next = || {
        bound += 1;
        bound
    };
    if query.parent.is_some() {
        sql += &format!(" AND parent = ${}", next());
    }
    if state.is_some() {
        sql += &format!(" AND state = ${}", next());
    }
    let is_by_id = query.id_prefix.is_some();
    if is_by_id {
        sql += &format!(" AND id >= ${}", next());
    }
    if query.behind_prefix().is_some() {
        sql += &format!(" AND id < ${}", next());
    }
    if query.after.is_some() {
        let side = if query.newest_first { '<' } else { '>' };
        sql += &match is_by_id {
            true => format!(" AND id {side} ${}", next()),
            false => format!(" AND (ord, id) {side} (${}, ${})", next(), next()),
        };
    }
    sql += match (is_by_id, query.newest_first) {
        (true, true) => " ORDER BY id DESC",
        (true, false) => " ORDER BY id",
        (false, true) => " ORDER BY ord DESC, id DESC",
        (false, false) => " ORDER BY ord, id",
    };
    sql + &format!(" LIMIT ${}", next())
}

/// Pages of several states, merged into the page of all of them.
pub(crate) fn merged(query: &Query, mut rows: Vec<Row>) -> Vec<Row> {
    match query.id_prefix {
        Some(_) => rows.sort_by(|a, b| a.key.id.cmp(&b.key.id)),
        None => rows.sort_by_cached_key(Cursor::of_row),
    }
    if query.newest_first {
        rows.reverse();
    }
    rows.truncate(query.rows_max());
    rows
}

/// The column form of a sort key: a row without one sorts before all others, on every engine.
pub(crate) fn ord(order: Option<i64>) -> i64 {
    order.unwrap_or(i64::MIN)
}

/// One row of `table` from [`ROW_READ`].
pub(crate) fn row<'r, R>(table: Table, row: &'r R) -> Result<Row, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r str: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    let order: i64 = row.try_get(4)?;
    Ok(Row {
        key: Key::new(table, row.try_get::<&str, _>(0)?),
        revision: Revision(row.try_get::<i64, _>(1)?.cast_unsigned()),
        index: Index {
            state: row.try_get(2)?,
            parent: row.try_get::<Option<&str>, _>(3)?.map(Arc::from),
            order: (order != ord(None)).then_some(order),
        },
        body: Arc::from(row.try_get::<&str, _>(5)?),
    })
}

/// One row of what [`by_ids`] asks.
pub(crate) fn row_of_any<'r, R>(found: &'r R) -> Result<Row, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r str: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    let name: &str = found.try_get(6)?;
    let table = table_named(name).ok_or_else(|| sqlx::Error::ColumnNotFound(name.to_owned()))?;
    row(table, found)
}

fn table_named(name: &str) -> Option<Table> {
    Table::ALL.iter().copied().find(|table| table.name() == name)
}

/// What an entry is called whose table this version does not know: nobody asks for that.
const OF_NEWER_VERSION: &str = "of_newer_version";

/// One entry of `log` from [`ENTRY_READ`]. Of a row whose table only a newer version has, the number and the subject are
/// kept: it has no table, no body, and no kind that anybody asks for.
pub(crate) fn entry<'r, R>(log: Log, row: &'r R) -> Result<Entry, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r str: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    let text = |column: usize| Ok::<_, sqlx::Error>(row.try_get::<Option<&str>, _>(column)?.map(Arc::from));
    let name = row.try_get::<Option<&str>, _>(1)?;
    let table = name.and_then(table_named);
    let is_newer = name.is_some() && table.is_none();
    Ok(Entry {
        seq: seq(row, 0)?,
        log,
        table,
        subject: Arc::from(row.try_get::<&str, _>(2)?),
        revision: Revision(row.try_get::<i64, _>(3)?.cast_unsigned()),
        index: Index { state: row.try_get(4)?, parent: text(5)?, order: row.try_get(6)? },
        body: text(7)?.filter(|_| !is_newer),
        kind: Arc::from(if is_newer { OF_NEWER_VERSION } else { row.try_get::<&str, _>(8)? }),
        actor: Arc::from(row.try_get::<&str, _>(9)?),
        request_id: text(10)?,
        at_unix_ms: row.try_get(11)?,
    })
}

/// A number of the feed in one column.
pub(crate) fn seq<'r, R>(row: &'r R, column: usize) -> Result<Seq, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    Ok(Seq(row.try_get::<i64, _>(column)?.cast_unsigned()))
}
