//! What one transaction will write: the outcome of a group of items, still in memory.
//!
//! Invariant: pure. Items are judged in order, each against what the ones before it in the group leave; a row that several items
//! write is written once, as the last one leaves it.

use super::revisions::Standing;
use crate::check::{After, decide};
use crate::{Applied, CommitError};
use midshift_core::rows::{Entry, Item, Key, Row, Seq};
use std::collections::{BTreeMap, HashMap};

pub(super) struct Group {
    /// Where the rows stood before the group.
    pub(super) base: HashMap<Key, Standing>,
    /// What each written row becomes; none: it goes. Sorted, so that one table's rows are together.
    pub(super) rows: BTreeMap<Key, Option<Row>>,
    /// All entries in order.
    pub(super) entries: Vec<Entry>,
    /// Newest number after the group.
    pub(super) head: Seq,
}

impl Group {
    pub(super) fn new(head: Seq, base: HashMap<Key, Standing>) -> Self {
        Self { base, rows: BTreeMap::new(), entries: Vec::new(), head }
    }

    pub(super) fn add(&mut self, item: Item, at_unix_ms: i64) -> Result<Applied, CommitError> {
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
