//! The statements of the writer.
//!
//! Invariant: as [`super::batch`].

use super::batch::{Batch, EACH_ROW, columns};
use super::revisions::{Moved, Revisions, Standing};
use crate::audit::{self, Heads};
use crate::group::{Group, sort_by_log, sort_by_table};
use crate::sql::{self, ENTRY_COLUMNS, MOVE_AUDIT_HEAD, MOVED_AUDIT_HEAD, ROW_COLUMNS, ROW_CONFLICT, ord};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Row, Seq, Table};
use sqlx::{AssertSqlSafe, Error, Row as _, SqliteConnection};
use std::collections::{BTreeMap, HashMap};

/// What an upsert does with rows that are there. SQLite writes an index anew if one of its columns is named, whether or not it changes.
const fn on_conflict(moved: Moved) -> &'static str {
    match moved {
        Moved::Nowhere => "ON CONFLICT (site_id, id) DO UPDATE SET revision = excluded.revision, body = excluded.body",
        Moved::ByState => {
            "ON CONFLICT (site_id, id) DO UPDATE \
             SET revision = excluded.revision, state = excluded.state, body = excluded.body"
        }
        Moved::Anywhere => ROW_CONFLICT,
    }
}

/// `rows` tuples of `columns` placeholders.
pub(super) fn placeholders(rows: usize, columns: usize) -> String {
    let tuple = format!("({})", vec!["?"; columns].join(", "));
    vec![tuple; rows].join(", ")
}

/// The transaction of a group, up to its COMMIT. `before`: where its rows stand.
pub(super) fn write_group(site_id: &SiteId, group: &Group, before: &Revisions) -> Result<Batch, Error> {
    let mut batch = Batch::default();
    batch.push("BEGIN IMMEDIATE");
    add_rows(&mut batch, site_id, &group.rows, before)?;
    add_entries(&mut batch, site_id, &group.entries)?;
    add_audit(&mut batch, site_id, group)?;
    batch.push(sql::MOVE_HEAD).bind_number(group.head.0.cast_signed())?.bind(site_id.as_str())?;
    Ok(batch)
}

/// Writes rows alone.
pub(super) async fn write_rows(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    rows: &BTreeMap<Key, Option<Row>>,
) -> Result<(), Error> {
    let mut batch = Batch::default();
    add_rows(&mut batch, site_id, rows, &Revisions::default())?;
    batch.run(connection).await
}

fn add_rows(
    batch: &mut Batch,
    site_id: &SiteId,
    rows: &BTreeMap<Key, Option<Row>>,
    before: &Revisions,
) -> Result<(), Error> {
    let (put, gone) = sort_by_table(rows);
    for (table, rows) in put {
        let mut by_move: BTreeMap<Moved, Vec<&Row>> = BTreeMap::new();
        for row in rows {
            by_move.entry(before.moved(row)).or_default().push(row);
        }
        for (moved, rows) in by_move {
            add_upsert(batch, site_id, table, rows, on_conflict(moved))?;
        }
    }
    for (table, ids) in gone {
        let delete =
            format!("DELETE FROM {} WHERE site_id = ? AND id IN (SELECT value FROM json_each(?))", table.name());
        batch.push(&delete).bind(site_id.as_str())?.bind_rows(ids)?;
    }
    Ok(())
}

fn add_upsert(batch: &mut Batch, site_id: &SiteId, table: Table, rows: Vec<&Row>, conflict: &str) -> Result<(), Error> {
    let values = |row: &Row| {
        let index = &row.index;
        let parent = index.parent.clone();
        (row.key.id.clone(), row.revision.0.cast_signed(), index.state, parent, ord(index.order), row.body.clone())
    };
    // SQLite cannot tell ON CONFLICT from a join without a WHERE before it.
    let upsert = format!(
        "INSERT INTO {} ({ROW_COLUMNS}) SELECT ?, {} FROM {EACH_ROW} WHERE true {conflict}",
        table.name(),
        columns(6),
    );
    batch.push(&upsert).bind(site_id.as_str())?.bind_rows(rows.into_iter().map(values))?;
    Ok(())
}

fn add_entries(batch: &mut Batch, site_id: &SiteId, entries: &[Entry]) -> Result<(), Error> {
    for (log, entries) in sort_by_log(entries) {
        let values = |entry: &Entry| {
            (
                entry.seq.0.cast_signed(),
                entry.table.map(Table::name),
                entry.subject.clone(),
                entry.revision.0.cast_signed(),
                entry.index.state,
                entry.index.parent.clone(),
                entry.index.order,
                entry.body.clone(),
                entry.kind.clone(),
                entry.actor.clone(),
                entry.request_id.clone(),
                entry.at_unix_ms,
            )
        };
        let append = format!("INSERT INTO {} ({ENTRY_COLUMNS}) SELECT ?, {} FROM {EACH_ROW}", log.name(), columns(12),);
        batch.push(&append).bind(site_id.as_str())?.bind_rows(entries.into_iter().map(values))?;
    }
    Ok(())
}

/// Moves the heads of the chains that grew, and takes what was cut.
fn add_audit(batch: &mut Batch, site_id: &SiteId, group: &Group) -> Result<(), Error> {
    for writer in &group.audited_writers {
        let head = group.chains.get(writer).cloned().unwrap_or_default();
        batch
            .push(&format!("{MOVE_AUDIT_HEAD} (?, ?, ?, ?) {MOVED_AUDIT_HEAD}"))
            .bind(site_id.as_str())?
            .bind(writer.as_str())?;
        batch.bind_number(head.n.cast_signed())?.bind(&head.hash)?;
    }
    for (table, up_to) in &group.cuts {
        batch.push(&sql::cut(*table)).bind(site_id.as_str())?.bind_number(up_to.cast_signed())?;
    }
    Ok(())
}

/// Where the chains of the audit stand.
pub(super) async fn chains(connection: &mut SqliteConnection, site_id: &SiteId) -> Result<Heads, Error> {
    let select = sqlx::query(AssertSqlSafe(audit::select_heads())).bind(site_id.as_str());
    audit::heads(&select.fetch_all(connection).await?)
}

/// Where some rows of the file stand. Every key asked for is in the answer.
pub(super) async fn read_standings(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    keys: Vec<Key>,
) -> Result<HashMap<Key, Standing>, Error> {
    let mut ids: BTreeMap<Table, Vec<&str>> = BTreeMap::new();
    for key in &keys {
        ids.entry(key.table).or_default().push(&key.id);
    }
    // The table's name stands where the body would.
    let select = |table: &Table| {
        let name = table.name();
        format!(
            "SELECT id, revision, state, parent, ord, '{name}' FROM {name} \
             WHERE site_id = ? AND id IN (SELECT value FROM json_each(?))"
        )
    };
    let mut batch = Batch::default();
    batch.push(&ids.keys().map(select).collect::<Vec<_>>().join(" UNION ALL "));
    for ids in ids.values() {
        batch.bind(site_id.as_str())?.bind_rows(ids.iter())?;
    }
    let rows = batch.fetch(connection).await?;
    let mut found: HashMap<Key, Standing> = keys.iter().map(|key| (key.clone(), None)).collect();
    for row in rows {
        let name: &str = row.try_get(5)?;
        let Some(table) = ids.keys().find(|table| table.name() == name) else { continue };
        let row = sql::row(*table, &row)?;
        found.insert(row.key, Some((row.revision, row.index)));
    }
    Ok(found)
}

/// Takes the entries of a log up to `up_to` out, and remembers that they are gone.
pub(super) async fn prune(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    log: Log,
    up_to: Seq,
) -> Result<(), Error> {
    let up_to = up_to.0.cast_signed();
    let mut batch = Batch::default();
    batch.push("BEGIN IMMEDIATE");
    batch.push(&sql::prune(log)).bind(site_id.as_str())?.bind_number(up_to)?;
    batch.push(sql::MARK_LOG).bind(site_id.as_str())?.bind(log.name())?.bind_number(up_to)?;
    batch.push("COMMIT");
    batch.run(connection).await
}
