//! The writer's statements: arrays, so that any number of rows is one prepared statement.
//!
//! Invariant: as [`crate::sql`].

use crate::audit::{self, Heads};
use crate::group::{CurrentRevision, Group};
use crate::sql::{self, ENTRY_COLUMNS, ROW_COLUMNS, ROW_CONFLICT, ord};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Revision, Row, Seq, Table};
use sqlx::{AssertSqlSafe, PgConnection, Row as _};
use std::collections::{BTreeMap, HashMap};

/// Writes what a group leaves of its rows.
pub(super) async fn rows(
    connection: &mut PgConnection,
    site_id: &SiteId,
    rows: &BTreeMap<Key, Option<Row>>,
) -> Result<(), sqlx::Error> {
    let mut put: BTreeMap<Table, Vec<&Row>> = BTreeMap::new();
    let mut gone: BTreeMap<Table, Vec<&str>> = BTreeMap::new();
    for (key, row) in rows {
        match row {
            Some(row) => put.entry(key.table).or_default().push(row),
            None => gone.entry(key.table).or_default().push(&key.id),
        }
    }
    for (table, rows) in put {
        sqlx::query(AssertSqlSafe(format!(
            "INSERT INTO {} ({ROW_COLUMNS}) SELECT $1, row.* FROM \
             UNNEST($2::text[], $3::bigint[], $4::bigint[], $5::text[], $6::bigint[], $7::text[]) AS row {ROW_CONFLICT}",
            table.name(),
        )))
        .bind(site_id.as_str())
        .bind(rows.iter().map(|row| &*row.key.id).collect::<Vec<_>>())
        .bind(rows.iter().map(|row| row.revision.0.cast_signed()).collect::<Vec<_>>())
        .bind(rows.iter().map(|row| row.index.state).collect::<Vec<_>>())
        .bind(rows.iter().map(|row| row.index.parent.as_deref()).collect::<Vec<_>>())
        .bind(rows.iter().map(|row| ord(row.index.order)).collect::<Vec<_>>())
        .bind(rows.iter().map(|row| &*row.body).collect::<Vec<_>>())
        .execute(&mut *connection)
        .await?;
    }
    for (table, ids) in gone {
        sqlx::query(AssertSqlSafe(format!("DELETE FROM {} WHERE site_id = $1 AND id = ANY($2)", table.name())))
            .bind(site_id.as_str())
            .bind(ids)
            .execute(&mut *connection)
            .await?;
    }
    Ok(())
}

/// Appends a group's entries to their logs.
pub(super) async fn entries(
    connection: &mut PgConnection,
    site_id: &SiteId,
    entries: &[Entry],
) -> Result<(), sqlx::Error> {
    for log in Log::ALL {
        let of_log: Vec<&Entry> = entries.iter().filter(|e| e.log == log).collect();
        if of_log.is_empty() {
            continue;
        }
        sqlx::query(AssertSqlSafe(format!(
            "INSERT INTO {} ({ENTRY_COLUMNS}) SELECT $1, entry.* FROM \
             UNNEST($2::bigint[], $3::text[], $4::text[], $5::bigint[], $6::bigint[], $7::text[], $8::bigint[], \
             $9::text[], $10::text[], $11::text[], $12::text[], $13::bigint[]) AS entry",
            log.name(),
        )))
        .bind(site_id.as_str())
        .bind(of_log.iter().map(|e| e.seq.0.cast_signed()).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.table.map(Table::name)).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| &*e.subject).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.revision.0.cast_signed()).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.index.state).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.index.parent.as_deref()).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.index.order).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.body.as_deref()).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| &*e.kind).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| &*e.actor).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.request_id.as_deref()).collect::<Vec<_>>())
        .bind(of_log.iter().map(|e| e.at_unix_ms).collect::<Vec<_>>())
        .execute(&mut *connection)
        .await?;
    }
    Ok(())
}

/// Where the chains of the audit stand. Nobody moves them while the head row is locked.
pub(super) async fn chains(connection: &mut PgConnection, site_id: &SiteId) -> Result<Heads, sqlx::Error> {
    let rows = sqlx::query(AssertSqlSafe(audit::select_heads())).bind(site_id.as_str()).fetch_all(connection).await?;
    audit::heads(&rows)
}

/// Moves the heads of the chains that grew, and takes what was cut.
pub(super) async fn grow(connection: &mut PgConnection, site_id: &SiteId, group: &Group) -> Result<(), sqlx::Error> {
    for writer in &group.audited_writers {
        let head = group.chains.get(writer).cloned().unwrap_or_default();
        let upsert = sqlx::query(sql::MOVE_AUDIT_HEAD).bind(site_id.as_str()).bind(writer.as_str());
        upsert.bind(head.n.cast_signed()).bind(head.hash).execute(&mut *connection).await?;
    }
    for (table, up_to) in &group.cuts {
        let delete = sqlx::query(AssertSqlSafe(sql::cut(*table))).bind(site_id.as_str()).bind(up_to.cast_signed());
        delete.execute(&mut *connection).await?;
    }
    Ok(())
}

/// Locks the site's head row until the end of the transaction, and reads the newest number given.
pub(super) async fn lock_head(connection: &mut PgConnection, site_id: &SiteId) -> Result<Seq, sqlx::Error> {
    let row = sqlx::query("SELECT seq FROM store_head WHERE site_id = $1 FOR UPDATE").bind(site_id.as_str());
    sql::seq(&row.fetch_one(connection).await?, 0)
}

/// Moves the head row.
pub(super) async fn head(connection: &mut PgConnection, site_id: &SiteId, head: Seq) -> Result<(), sqlx::Error> {
    let update = sqlx::query(sql::MOVE_HEAD).bind(head.0.cast_signed()).bind(site_id.as_str());
    update.execute(connection).await.map(drop)
}

/// Where some rows stand. Every key asked for is in the answer.
pub(super) async fn read_current_revisions<'k>(
    connection: &mut PgConnection,
    site_id: &SiteId,
    keys: impl Iterator<Item = &'k Key>,
) -> Result<HashMap<Key, CurrentRevision>, sqlx::Error> {
    let mut found: HashMap<Key, CurrentRevision> = keys.map(|key| (key.clone(), None)).collect();
    let mut ids: BTreeMap<Table, Vec<String>> = BTreeMap::new();
    // An item with such an id is refused when it is judged.
    for key in found.keys().filter(|key| is_text(&key.id)) {
        ids.entry(key.table).or_default().push(key.id.to_string());
    }
    for (table, ids) in ids {
        let select = sqlx::query(AssertSqlSafe(format!(
            "SELECT id, revision FROM {} WHERE site_id = $1 AND id = ANY($2)",
            table.name()
        )));
        for row in select.bind(site_id.as_str()).bind(ids).fetch_all(&mut *connection).await? {
            let revision = Revision(row.try_get::<i64, _>(1)?.cast_unsigned());
            found.insert(Key::new(table, row.try_get::<&str, _>(0)?), Some(revision));
        }
    }
    Ok(found)
}

/// Whether PostgreSQL can be asked about it: no row has a NUL in its id.
pub(super) fn is_text(text: &str) -> bool {
    !text.as_bytes().contains(&0)
}

/// Takes the entries of a log up to `up_to` out, and remembers that they are gone.
pub(super) async fn prune(
    connection: &mut PgConnection,
    site_id: &SiteId,
    log: Log,
    up_to: Seq,
) -> Result<(), sqlx::Error> {
    let up_to = up_to.0.cast_signed();
    let delete = sqlx::query(AssertSqlSafe(sql::prune(log))).bind(site_id.as_str()).bind(up_to);
    delete.execute(&mut *connection).await?;
    let mark = sqlx::query(
        "INSERT INTO log_mark (site_id, log, pruned_seq) VALUES ($1, $2, $3) \
         ON CONFLICT (site_id, log) DO UPDATE SET pruned_seq = GREATEST(log_mark.pruned_seq, excluded.pruned_seq)",
    );
    mark.bind(site_id.as_str()).bind(log.name()).bind(up_to).execute(connection).await.map(drop)
}
