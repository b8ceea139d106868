//! The writer's statements: arrays, so that any number of rows is one prepared statement.
//!
//! Invariant: as [`crate::sql`].

use crate::audit::{self, Heads};
use crate::group::{CurrentRevision, Group, sort_by_log, sort_by_table};
use crate::sql::{self, ENTRY_COLUMNS, MOVE_AUDIT_HEAD, MOVED_AUDIT_HEAD, ROW_COLUMNS, ROW_CONFLICT, ord};
use midshift_core::ids::SiteId;
use midshift_core::rows::{Entry, Key, Log, Revision, Row, Seq, Table};
use sqlx::postgres::PgArguments;
use sqlx::{Arguments, AssertSqlSafe, Encode, Error, PgConnection, Postgres, Row as _, Type};
use std::collections::{BTreeMap, HashMap};

/// A statement of several parts, which all see what was there before it. Values are numbered through all of them; `$1` is the site.
struct Parts {
    sql: Vec<String>,
    values: PgArguments,
}

impl Parts {
    fn new(site_id: &SiteId) -> Result<Self, Error> {
        let mut parts = Self { sql: Vec::new(), values: PgArguments::default() };
        parts.bind(site_id.as_str())?;
        Ok(parts)
    }

    /// Adds a value, and says what stands for it.
    fn bind<'q, T: Encode<'q, Postgres> + Type<Postgres> + 'q>(&mut self, value: T) -> Result<String, Error> {
        let kind = T::type_info();
        self.values.add(value).map_err(Error::Encode)?;
        Ok(format!("${}::{kind}", self.values.len()))
    }

    fn add_rows(&mut self, rows: &BTreeMap<Key, Option<Row>>) -> Result<(), Error> {
        let (put, gone) = sort_by_table(rows);
        for (table, rows) in put {
            let columns = [
                self.bind(column(&rows, |row| &*row.key.id))?,
                self.bind(column(&rows, |row| row.revision.0.cast_signed()))?,
                self.bind(column(&rows, |row| row.index.state))?,
                self.bind(column(&rows, |row| row.index.parent.as_deref()))?,
                self.bind(column(&rows, |row| ord(row.index.order)))?,
                self.bind(column(&rows, |row| &*row.body))?,
            ];
            self.sql.push(format!(
                "INSERT INTO {} ({ROW_COLUMNS}) SELECT $1, row.* FROM UNNEST({}) AS row {ROW_CONFLICT}",
                table.name(),
                columns.join(", "),
            ));
        }
        for (table, ids) in gone {
            let ids = self.bind(ids)?;
            self.sql.push(format!("DELETE FROM {} WHERE site_id = $1 AND id = ANY({ids})", table.name()));
        }
        Ok(())
    }

    fn add_entries(&mut self, entries: &[Entry]) -> Result<(), Error> {
        for (log, entries) in sort_by_log(entries) {
            let columns = [
                self.bind(column(&entries, |entry| entry.seq.0.cast_signed()))?,
                self.bind(column(&entries, |entry| entry.table.map(Table::name)))?,
                self.bind(column(&entries, |entry| &*entry.subject))?,
                self.bind(column(&entries, |entry| entry.revision.0.cast_signed()))?,
                self.bind(column(&entries, |entry| entry.index.state))?,
                self.bind(column(&entries, |entry| entry.index.parent.as_deref()))?,
                self.bind(column(&entries, |entry| entry.index.order))?,
                self.bind(column(&entries, |entry| entry.body.as_deref()))?,
                self.bind(column(&entries, |entry| &*entry.kind))?,
                self.bind(column(&entries, |entry| &*entry.actor))?,
                self.bind(column(&entries, |entry| entry.request_id.as_deref()))?,
                self.bind(column(&entries, |entry| entry.at_unix_ms))?,
            ];
            self.sql.push(format!(
                "INSERT INTO {} ({ENTRY_COLUMNS}) SELECT $1, entry.* FROM UNNEST({}) AS entry",
                log.name(),
                columns.join(", "),
            ));
        }
        Ok(())
    }

    /// Moves the heads of the chains that grew, and takes what was cut.
    fn add_audit(&mut self, group: &Group) -> Result<(), Error> {
        for writer in &group.audited_writers {
            let head = group.chains.get(writer).cloned().unwrap_or_default();
            let values = [self.bind(writer.as_str())?, self.bind(head.n.cast_signed())?, self.bind(head.hash)?];
            self.sql.push(format!("{MOVE_AUDIT_HEAD} ($1, {}) {MOVED_AUDIT_HEAD}", values.join(", ")));
        }
        for (table, up_to) in &group.cuts {
            let up_to = self.bind(up_to.cast_signed())?;
            self.sql.push(format!("DELETE FROM {} WHERE site_id = $1 AND ord <= {up_to}", table.name()));
        }
        Ok(())
    }

    /// Runs all of it.
    async fn run(self, connection: &mut PgConnection) -> Result<(), Error> {
        let Some((last, first)) = self.sql.split_last() else { return Ok(()) };
        let named = first.iter().enumerate().map(|(number, sql)| format!("part_{number} AS ({sql})"));
        let named = named.collect::<Vec<_>>().join(", ");
        let sql = if named.is_empty() { last.clone() } else { format!("WITH {named} {last}") };
        sqlx::query_with(AssertSqlSafe(sql), self.values).execute(connection).await.map(drop)
    }
}

/// One column of some rows.
fn column<'r, R, T>(rows: &[&'r R], value: impl Fn(&'r R) -> T) -> Vec<T> {
    rows.iter().map(|row| value(row)).collect()
}

/// Writes what a group leaves.
pub(super) async fn write_group(connection: &mut PgConnection, site_id: &SiteId, group: &Group) -> Result<(), Error> {
    let mut parts = Parts::new(site_id)?;
    parts.add_rows(&group.rows)?;
    parts.add_entries(&group.entries)?;
    parts.add_audit(group)?;
    let head = parts.bind(group.head.0.cast_signed())?;
    parts.sql.push(format!("UPDATE store_head SET seq = {head} WHERE site_id = $1"));
    parts.run(connection).await
}

/// Writes rows alone.
pub(super) async fn write_rows(
    connection: &mut PgConnection,
    site_id: &SiteId,
    rows: &BTreeMap<Key, Option<Row>>,
) -> Result<(), Error> {
    let mut parts = Parts::new(site_id)?;
    parts.add_rows(rows)?;
    parts.run(connection).await
}

/// Where the chains of the audit stand. Nobody moves them while the head row is locked.
pub(super) async fn chains(connection: &mut PgConnection, site_id: &SiteId) -> Result<Heads, Error> {
    let rows = sqlx::query(AssertSqlSafe(audit::select_heads())).bind(site_id.as_str()).fetch_all(connection).await?;
    audit::heads(&rows)
}

/// Begins a transaction, locks the site's head row until its end, and reads the newest number given.
pub(super) async fn begin(connection: &mut PgConnection, site_id: &SiteId) -> Result<Seq, Error> {
    // In one trip, which has no binds: a site's id has no character that ends a text.
    let lock = format!("BEGIN; SELECT seq FROM store_head WHERE site_id = '{site_id}' FOR UPDATE");
    sql::seq(&sqlx::raw_sql(AssertSqlSafe(lock)).fetch_one(connection).await?, 0)
}

/// Moves the head row.
pub(super) async fn head(connection: &mut PgConnection, site_id: &SiteId, head: Seq) -> Result<(), Error> {
    let update = sqlx::query(sql::MOVE_HEAD).bind(head.0.cast_signed()).bind(site_id.as_str());
    update.execute(connection).await.map(drop)
}

/// Where some rows stand. Every key asked for is in the answer.
pub(super) async fn read_current_revisions<'k>(
    connection: &mut PgConnection,
    site_id: &SiteId,
    keys: impl Iterator<Item = &'k Key>,
) -> Result<HashMap<Key, CurrentRevision>, Error> {
    let mut found: HashMap<Key, CurrentRevision> = keys.map(|key| (key.clone(), None)).collect();
    let mut ids: BTreeMap<Table, Vec<String>> = BTreeMap::new();
    // An item with such an id is refused when it is judged.
    for key in found.keys().filter(|key| sql::is_text(&key.id)) {
        ids.entry(key.table).or_default().push(key.id.to_string());
    }
    let mut parts = Parts::new(site_id)?;
    for (table, ids) in &ids {
        let (name, ids) = (table.name(), parts.bind(ids)?);
        parts.sql.push(format!("SELECT '{name}', id, revision FROM {name} WHERE site_id = $1 AND id = ANY({ids})"));
    }
    if ids.is_empty() {
        return Ok(found);
    }
    let select = sqlx::query_with(AssertSqlSafe(parts.sql.join(" UNION ALL ")), parts.values);
    for row in select.fetch_all(connection).await? {
        let name: &str = row.try_get(0)?;
        let Some(table) = ids.keys().find(|table| table.name() == name) else { continue };
        let revision = Revision(row.try_get::<i64, _>(2)?.cast_unsigned());
        found.insert(Key::new(*table, row.try_get::<&str, _>(1)?), Some(revision));
    }
    Ok(found)
}

/// Takes the entries of a log up to `up_to` out, and remembers that they are gone.
pub(super) async fn prune(connection: &mut PgConnection, site_id: &SiteId, log: Log, up_to: Seq) -> Result<(), Error> {
    let up_to = up_to.0.cast_signed();
    let delete = sqlx::query(AssertSqlSafe(sql::prune(log))).bind(site_id.as_str()).bind(up_to);
    delete.execute(&mut *connection).await?;
    let mark = sqlx::query(
        "INSERT INTO log_mark (site_id, log, pruned_seq) VALUES ($1, $2, $3) \
         ON CONFLICT (site_id, log) DO UPDATE SET pruned_seq = GREATEST(log_mark.pruned_seq, excluded.pruned_seq)",
    );
    mark.bind(site_id.as_str()).bind(log.name()).bind(up_to).execute(connection).await.map(drop)
}
