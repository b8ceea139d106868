//! The statements of the writer.
//!
//! Invariant: as [`super::batch`].

use super::batch::{Batch, columns};
use crate::audit::{self, Heads};
use crate::group::{CurrentRevision, Group, sort_by_log, sort_by_table};
use crate::sql::{self, ENTRY_COLUMNS, MOVE_AUDIT_HEAD, MOVED_AUDIT_HEAD, ROW_COLUMNS, ROW_CONFLICT, ord};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Revision, Row, Seq, Table};
use sqlx::{AssertSqlSafe, Error, Row as _, SqliteConnection};
use std::collections::{BTreeMap, HashMap};

/// `rows` tuples of `columns` placeholders.
pub(super) fn placeholders(rows: usize, columns: usize) -> String {
    let tuple = format!("({})", vec!["?"; columns].join(", "));
    vec![tuple; rows].join(", ")
}

/// All that a group leaves, up to its COMMIT.
pub(super) async fn write_group(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    group: &Group,
) -> Result<(), Error> {
    let mut batch = Batch::default();
    batch.push("BEGIN IMMEDIATE");
    add_rows(&mut batch, site_id, &group.rows)?;
    add_entries(&mut batch, site_id, &group.entries)?;
    add_audit(&mut batch, site_id, group)?;
    batch.push(sql::MOVE_HEAD).bind_number(group.head.0.cast_signed())?.bind(site_id.as_str())?;
    batch.run(connection).await
}

/// Writes rows alone.
pub(super) async fn write_rows(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    rows: &BTreeMap<Key, Option<Row>>,
) -> Result<(), Error> {
    let mut batch = Batch::default();
    add_rows(&mut batch, site_id, rows)?;
    batch.run(connection).await
}

fn add_rows(batch: &mut Batch, site_id: &SiteId, rows: &BTreeMap<Key, Option<Row>>) -> Result<(), Error> {
    let (put, gone) = sort_by_table(rows);
    for (table, rows) in put {
        let values = |row: &Row| {
            let index = &row.index;
            let parent = index.parent.clone();
            (row.key.id.clone(), row.revision.0.cast_signed(), index.state, parent, ord(index.order), row.body.clone())
        };
        // SQLite cannot tell ON CONFLICT from a join without a WHERE before it.
        let upsert = format!(
            "INSERT INTO {} ({ROW_COLUMNS}) SELECT ?, {} FROM json_each(?) WHERE true {ROW_CONFLICT}",
            table.name(),
            columns(6),
        );
        batch.push(&upsert).bind(site_id.as_str())?.bind_rows(rows.into_iter().map(values))?;
    }
    for (table, ids) in gone {
        let delete =
            format!("DELETE FROM {} WHERE site_id = ? AND id IN (SELECT value FROM json_each(?))", table.name());
        batch.push(&delete).bind(site_id.as_str())?.bind_rows(ids)?;
    }
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
        let append =
            format!("INSERT INTO {} ({ENTRY_COLUMNS}) SELECT ?, {} FROM json_each(?)", log.name(), columns(12),);
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
pub(super) async fn read_current_revisions(
    connection: &mut SqliteConnection,
    site_id: &SiteId,
    keys: Vec<Key>,
) -> Result<HashMap<Key, CurrentRevision>, Error> {
    let mut ids: BTreeMap<Table, Vec<&str>> = BTreeMap::new();
    for key in &keys {
        ids.entry(key.table).or_default().push(&key.id);
    }
    let mut batch = Batch::default();
    for (table, ids) in &ids {
        let name = table.name();
        let select = format!(
            "SELECT '{name}', id, revision FROM {name} WHERE site_id = ? AND id IN (SELECT value FROM json_each(?))"
        );
        batch.push(&select).bind(site_id.as_str())?.bind_rows(ids.iter())?;
    }
    let rows = batch.fetch(connection).await?;
    let mut found: HashMap<Key, CurrentRevision> = keys.iter().map(|key| (key.clone(), None)).collect();
    for row in rows {
        let name: &str = row.try_get(0)?;
        let Some(table) = ids.keys().find(|table| table.name() == name) else { continue };
        let revision = Revision(row.try_get::<i64, _>(2)?.cast_unsigned());
        found.insert(Key::new(*table, row.try_get::<&str, _>(1)?), Some(revision));
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
