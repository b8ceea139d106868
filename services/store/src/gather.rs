//! Gathers the rows of one reading, and asks what they name and what belongs to them until they name nothing new.
//!
//! Invariant: no key is read twice, however often it is named. Called by each engine, within the one moment that it reads.

use crate::Snapshot;
use midshift_core::rows::{Key, Naming, Row, RowSelection, Seq, Table};
use std::collections::BTreeSet;
use std::sync::Arc;

/// What was read so far.
pub(crate) struct Gathered {
    named: Naming,
    rows: Vec<Row>,
    /// Keys of these rows, and keys that were named and are not there.
    known: BTreeSet<Key>,
    /// Rows before this one were asked what they name.
    asked: usize,
    /// Keys that the reading itself asks for, until they were.
    wanted: Vec<Key>,
    /// Tables whose rows are read with their parents, and where those are.
    of_parents: Vec<(Table, Table)>,
    /// Rows before this one were looked at as parents.
    parented: usize,
}

impl Gathered {
    /// Takes of `parts` what is asked by key or by parent.
    pub(crate) fn new(parts: &[RowSelection], named: Naming) -> Self {
        let (mut wanted, mut of_parents) = (Vec::new(), Vec::new());
        for part in parts {
            match part {
                RowSelection::Rows(keys) => wanted.extend(keys.iter().cloned()),
                RowSelection::OfParents { table, parents } => of_parents.push((*table, *parents)),
                RowSelection::Whole(_) | RowSelection::InStates(..) => {}
            }
        }
        Self { named, rows: Vec::new(), known: BTreeSet::new(), asked: 0, wanted, of_parents, parented: 0 }
    }

    pub(crate) fn add(&mut self, rows: impl IntoIterator<Item = Row>) {
        for row in rows {
            if self.known.insert(row.key.clone()) {
                self.rows.push(row);
            }
        }
    }

    /// What rows named that were read since the last call, and that nobody has read; empty: there is no more.
    pub(crate) fn missing(&mut self) -> Vec<Key> {
        let wanted = std::mem::take(&mut self.wanted);
        let named = wanted.into_iter().chain((self.named)(&self.rows[self.asked..]));
        let missing = named.filter(|key| !self.known.contains(key)).collect();
        self.asked = self.rows.len();
        missing
    }

    /// Tables and parents of which rows are to be read, for rows that were read since the last call.
    pub(crate) fn parents(&mut self) -> Vec<(Table, Arc<str>)> {
        let mut found = Vec::new();
        for row in &self.rows[self.parented..] {
            let tables = self.of_parents.iter().filter(|(_, parents)| *parents == row.key.table);
            found.extend(tables.map(|(table, _)| (*table, row.key.id.clone())));
        }
        self.parented = self.rows.len();
        found
    }

    /// All of it, by key.
    pub(crate) fn at(mut self, seq: Seq) -> Snapshot {
        self.rows.sort_unstable_by(|a, b| a.key.cmp(&b.key));
        Snapshot { seq, rows: self.rows }
    }
}
