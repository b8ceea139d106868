//! What one transaction will write: the outcome of a group of items, still in memory.
//!
//! Invariant: pure. Items are judged in order, each against what the ones before it in the group leave; a row that several items
//! write is written once, as the last one leaves it.

use crate::audit::{AuditDrafts, Heads};
use crate::check::{After, decide};
use crate::{Applied, CommitError};
use midshift_core::item::Item;
use midshift_core::rows::{Entry, Key, Log, Revision, Row, Seq, Table, Writer};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// Rows by table: what becomes of each that stays, and the ids of those that go.
pub(crate) type ByTable<'r> = (BTreeMap<Table, Vec<&'r Row>>, BTreeMap<Table, Vec<&'r str>>);

/// Puts rows into the tables that they belong to.
pub(crate) fn sort_by_table(rows: &BTreeMap<Key, Option<Row>>) -> ByTable<'_> {
    let (mut put, mut gone) = ByTable::default();
    for (key, row) in rows {
        match row {
            Some(row) => put.entry(key.table).or_default().push(row),
            None => gone.entry(key.table).or_default().push(&*key.id),
        }
    }
    (put, gone)
}

/// Puts entries into their logs, in their order.
pub(crate) fn sort_by_log(entries: &[Entry]) -> BTreeMap<Log, Vec<&Entry>> {
    let mut logs: BTreeMap<Log, Vec<&Entry>> = BTreeMap::new();
    for entry in entries {
        logs.entry(entry.log).or_default().push(entry);
    }
    logs
}

/// A revision, or the knowledge that there is no such row.
pub(crate) type CurrentRevision = Option<Revision>;

pub(crate) struct Group {
    /// Where the rows stood before the group.
    pub(crate) base: HashMap<Key, CurrentRevision>,
    /// What each written row becomes; none: it goes. Sorted, so that one table's rows are together.
    pub(crate) rows: BTreeMap<Key, Option<Row>>,
    /// All entries in order.
    pub(crate) entries: Vec<Entry>,
    /// Newest number after the group.
    pub(crate) head: Seq,
    /// Where the chains of the audit stand after the group.
    pub(crate) chains: Heads,
    /// What comes to them.
    audit_drafts: AuditDrafts,
    /// Chains that grew in it.
    pub(crate) audited_writers: BTreeSet<Writer>,
    /// Chains that were cut in it, and up to which number.
    pub(crate) cuts: BTreeMap<Table, u64>,
}

impl Group {
    pub(crate) fn new(head: Seq, base: HashMap<Key, CurrentRevision>, chains: Heads) -> Self {
        let (rows, entries) = (BTreeMap::new(), Vec::new());
        let (audit_drafts, audited_writers, cuts) = (AuditDrafts::default(), BTreeSet::new(), BTreeMap::new());
        Self { base, rows, entries, head, chains, audit_drafts, audited_writers, cuts }
    }

    /// After the last item: the rows of the audit.
    pub(crate) fn seal(&mut self) {
        let appended = std::mem::take(&mut self.audit_drafts).append_to(&mut self.chains);
        self.rows.extend(appended.rows.into_iter().map(|row| (row.key.clone(), Some(row))));
        (self.audited_writers, self.cuts) = (appended.writers, appended.cuts);
    }

    /// Whether there is anything to write. Asked when it is sealed.
    pub(crate) fn writes(&self) -> bool {
        !self.entries.is_empty() || !self.audited_writers.is_empty()
    }

    pub(crate) fn add(&mut self, item: Item, at_unix_ms: i64) -> Result<Applied, CommitError> {
        let decided = decide(item, self.head, at_unix_ms, |key| self.current_revision(key))?;
        for after in decided.rows {
            match after {
                After::Row(row) => self.rows.insert(row.key.clone(), Some(row)),
                After::Gone(key) => self.rows.insert(key, None),
            };
        }
        self.entries.extend(decided.entries);
        self.head = decided.applied.seq;
        if let Some(draft) = decided.audited {
            self.audit_drafts.push(draft);
        }
        Ok(decided.applied)
    }

    fn current_revision(&self, key: &Key) -> CurrentRevision {
        match self.rows.get(key) {
            Some(row) => row.as_ref().map(|row| row.revision),
            None => self.base.get(key).copied().flatten(),
        }
    }
}
