//! The chains of the audit inside a commit: where each stands, and the rows that a group puts behind it.
//!
//! Invariant: a chain grows under the lock that numbers are given under, in the transaction of the items that it tells of, so that its order
//! is their order whatever process they come from. What goes of it is a beginning, and only with the row that says so.

use crate::sql;
use midshift_core::audit::{self, Draft, Head};
use midshift_core::rows::{Row, Table, Writer};
use sqlx::{ColumnIndex, Decode, Type};
use std::collections::{BTreeMap, BTreeSet};

/// Where each chain stands. A chain without rows is not among them.
pub(crate) type Heads = BTreeMap<Writer, Head>;

/// What the items of one transaction leave in the audit, in their order.
#[derive(Default)]
pub(crate) struct AuditDrafts(Vec<Draft>);

/// Rows behind their chains, and what goes of those.
#[derive(Default)]
pub(crate) struct AuditRows {
    pub(crate) rows: Vec<Row>,
    pub(crate) writers: BTreeSet<Writer>,
    /// Rows of a table up to a number go.
    pub(crate) cuts: BTreeMap<Table, u64>,
}

impl AuditDrafts {
    /// What stands beside the note before it may share its row.
    pub(crate) fn push(&mut self, draft: Draft) {
        let own = match self.0.last_mut() {
            Some(last) if last.writer == draft.writer => last.join(draft),
            _ => Some(draft),
        };
        self.0.extend(own);
    }
    /// Whether there is nothing.
    pub(crate) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
    /// Puts all of it behind the chains.
    pub(crate) fn append_to(self, heads: &mut Heads) -> AuditRows {
        let mut appended = AuditRows::default();
        for Draft { writer, note, by } in self.0 {
            // A writer without a chain was refused before.
            let Some(row) = audit::append(heads, writer, &note, &by) else { continue };
            appended.cuts.extend(note.cut.map(|head| (row.key.table, head.n)));
            appended.writers.insert(writer);
            appended.rows.push(row);
        }
        appended
    }
}

/// Where the chains stand, as the database tells it: what was noted of each, and its last row. The later one counts, so that what is written is
/// behind everything that is there or was there.
pub(crate) fn heads<'r, R>(rows: &'r [R]) -> Result<Heads, sqlx::Error>
where
    R: sqlx::Row,
    usize: ColumnIndex<R>,
    &'r str: Decode<'r, R::Database> + Type<R::Database>,
    i64: Decode<'r, R::Database> + Type<R::Database>,
{
    let mut heads = Heads::new();
    for row in rows {
        let name: &str = row.try_get(0)?;
        let Some((writer, _)) = Table::audits().iter().find(|(writer, _)| writer.as_str() == name) else { continue };
        let n = row.try_get::<i64, _>(1)?.cast_unsigned();
        let noted: Option<&str> = row.try_get(2)?;
        let body: Option<&str> = row.try_get(3)?;
        let hash = noted.or_else(|| body.and_then(audit::open).map(|row| row.hash)).unwrap_or(audit::NOTHING);
        let later = heads.get(writer).is_none_or(|known| known.n < n || (known.n == n && noted.is_some()));
        if later {
            heads.insert(*writer, Head { n, hash: hash.to_owned() });
        }
    }
    Ok(heads)
}

/// The noted heads alone, and beside them the last row of each chain.
pub(crate) fn select_heads() -> String {
    Table::audits().iter().fold(sql::AUDIT_HEADS.to_owned(), |text, (writer, table)| {
        let (name, table) = (writer.as_str(), table.name());
        let last = format!("SELECT ord, body FROM {table} WHERE site_id = $1 ORDER BY ord DESC, id DESC LIMIT 1");
        text + &format!(" UNION ALL SELECT '{name}', ord, NULL, body FROM ({last}) AS {name}_last")
    })
}
