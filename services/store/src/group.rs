//! What one transaction will write: the outcome of a group of items, still in memory.
//!
//! Invariant: pure. Items are judged in order, each against what the ones before it in the group leave; a row that several items
//! write is written once, as the last one leaves it.

use crate::check::{After, decide};
use crate::{Applied, CommitError};
use midshift_core::rows::{Entry, Item, Key, Revision, Row, Seq};
use std::collections::{BTreeMap, HashMap};

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
}

impl Group {
    pub(crate) fn new(head: Seq, base: HashMap<Key, Standing>) -> Self {
        Self { base, rows: BTreeMap::new(), entries: Vec::new(), head }
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
        Ok(decided.applied)
    }

    fn standing(&self, key: &Key) -> Standing {
        match self.rows.get(key) {
            Some(row) => row.as_ref().map(|row| row.revision),
            None => self.base.get(key).copied().flatten(),
        }
    }
}
