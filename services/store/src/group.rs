//! What one transaction will write: the outcome of a group of items, still in memory.
//!
//! Invariant: pure. Items are judged in order, each against what the ones before it in the group leave; a row that several items
//! write is written once, as the last one leaves it.

use crate::audit::{Growth, Heads};
use crate::check::{After, decide};
use crate::{Applied, CommitError};
use midshift_core::item::Item;
use midshift_core::rows::{Entry, Key, Revision, Row, Seq, Table, Writer};
use std::collections::{BTreeMap, BTreeSet, HashMap};

/// A revision, or the knowledge that there is no such row.
pub(crate) type Standing = Option<Revision>;

pub(crate) struct Group {
    /// Where the rows stood before the group.
    pub(crate) base: HashMap<Key, Standing>,
    /// What each written row becomes; none: it goes. Sorted, so that one table's rows are together.
    pub(crate) rows: BTreeMap<Key, Option<Row>>,
    /// All entries in order.
    pub(crate) entries: Vec<Entry>,
    /// Newest number after the group.
    pub(crate) head: Seq,
    /// Where the chains of the audit stand after the group.
    pub(crate) chains: Heads,
    /// What comes to them.
    growth: Growth,
    /// Chains that grew in it.
    pub(crate) grown: BTreeSet<Writer>,
    /// Chains that were cut in it, and up to which number.
    pub(crate) cuts: BTreeMap<Table, u64>,
}

impl Group {
    pub(crate) fn new(head: Seq, base: HashMap<Key, Standing>, chains: Heads) -> Self {
        let (rows, entries) = (BTreeMap::new(), Vec::new());
        let (growth, grown, cuts) = (Growth::default(), BTreeSet::new(), BTreeMap::new());
        Self { base, rows, entries, head, chains, growth, grown, cuts }
    }

    /// After the last item: the rows of the audit.
    pub(crate) fn seal(&mut self) {
        let growth = std::mem::take(&mut self.growth).grow(&mut self.chains);
        self.rows.extend(growth.rows.into_iter().map(|row| (row.key.clone(), Some(row))));
        (self.grown, self.cuts) = (growth.writers, growth.cuts);
    }

    /// Whether there is anything to write. Asked when it is sealed.
    pub(crate) fn writes(&self) -> bool {
        !self.entries.is_empty() || !self.grown.is_empty()
    }

    pub(crate) fn add(&mut self, item: Item, at_unix_ms: i64) -> Result<Applied, CommitError> {
        let decided = decide(item, self.head, at_unix_ms, |key| self.standing(key))?;
        for after in decided.rows {
            match after {
                After::Row(row) => self.rows.insert(row.key.clone(), Some(row)),
                After::Gone(key) => self.rows.insert(key, None),
            };
        }
        self.entries.extend(decided.entries);
        self.head = decided.applied.seq;
        if let Some(draft) = decided.audited {
            self.growth.add(draft);
        }
        Ok(decided.applied)
    }

    fn standing(&self, key: &Key) -> Standing {
        match self.rows.get(key) {
            Some(row) => row.as_ref().map(|row| row.revision),
            None => self.base.get(key).copied().flatten(),
        }
    }
}
