//! Gathers the rows of one reading, and asks what they name until they name nothing new.
//!
//! Invariant: no key is read twice, however often it is named. Called by each engine, within the one moment that it reads.

use crate::Snapshot;
use midshift_core::rows::{Key, Naming, Row, Seq, Table};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What was read so far.
pub(crate) struct Gathered {
    named: Naming,
    rows: Vec<Row>,
    /// Keys of these rows, and keys that were named and are not there.
    known: BTreeSet<Key>,
    /// Rows before this one were asked what they name.
    asked: usize,
}

impl Gathered {
    pub(crate) fn new(named: Naming) -> Self {
        Self { named, rows: Vec::new(), known: BTreeSet::new(), asked: 0 }
    }

    pub(crate) fn take(&mut self, rows: impl IntoIterator<Item = Row>) {
        for row in rows {
            if self.known.insert(row.key.clone()) {
                self.rows.push(row);
            }
        }
    }

    /// What rows named that were read since the last call, and that nobody has read; empty: there is no more.
    pub(crate) fn missing(&mut self) -> BTreeMap<Table, Vec<Arc<str>>> {
        let mut missing: BTreeMap<Table, BTreeSet<Arc<str>>> = BTreeMap::new();
        for key in (self.named)(&self.rows[self.asked..]) {
            if !self.known.contains(&key) {
                missing.entry(key.table).or_default().insert(key.id);
            }
        }
        self.asked = self.rows.len();
        missing.into_iter().map(|(table, ids)| (table, ids.into_iter().collect())).collect()
    }

    /// All of it, by key.
    pub(crate) fn at(mut self, seq: Seq) -> Snapshot {
        self.rows.sort_unstable_by(|a, b| a.key.cmp(&b.key));
        Snapshot { seq, rows: self.rows }
    }
}
