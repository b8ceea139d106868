//! Where the rows stand that were written or asked for lately, so that most items are judged without reading the file, and the indexes of
//! a table are touched only where a row moves in them.
//!
//! Invariant: what is known here is what the last commit left; after a commit of unknown outcome everything is forgotten.
//! Bounded by two generations: a key that is not asked for during a whole generation is dropped. Of a task that is over little stays: what is
//! gone and what is written once is asked of the file, if anybody asks.

use crate::group::CurrentRevision;
use midshift_core::rows::{Index, Key, Revision, Row, Table};
use std::collections::HashMap;

/// Keys of one generation. 50,000 keys are about 10 MB.
const GENERATION_KEYS: usize = 50_000;

/// Revision and index columns of a row, or the knowledge that there is no such row.
pub(super) type Standing = Option<(Revision, Index)>;

/// Where a write moves a row in the indexes of its table.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(super) enum Moved {
    /// It stands where it stood.
    Nowhere,
    /// In those that begin with its state.
    ByState,
    /// It is new, or nobody remembers where it stood.
    Anywhere,
}

#[derive(Default)]
pub(super) struct Revisions {
    young: HashMap<Key, Standing>,
    old: HashMap<Key, Standing>,
}

impl Revisions {
    pub(super) fn get(&mut self, key: &Key) -> Option<CurrentRevision> {
        if let Some(standing) = self.young.get(key) {
            return Some(standing.as_ref().map(|(revision, _)| *revision));
        }
        let standing = self.old.get(key)?.clone();
        let revision = standing.as_ref().map(|(revision, _)| *revision);
        self.note(key.clone(), standing);
        Some(revision)
    }

    /// What becomes of a row in the indexes of its table.
    pub(super) fn moved(&self, row: &Row) -> Moved {
        let standing = self.young.get(&row.key).or_else(|| self.old.get(&row.key));
        match standing.and_then(Option::as_ref) {
            Some((_, index)) if *index == row.index => Moved::Nowhere,
            Some((_, Index { parent, order, .. })) if (parent, order) == (&row.index.parent, &row.index.order) => {
                Moved::ByState
            }
            _ => Moved::Anywhere,
        }
    }

    pub(super) fn note(&mut self, key: Key, standing: Standing) {
        if self.young.len() >= GENERATION_KEYS {
            self.old = std::mem::take(&mut self.young);
        }
        self.young.insert(key, standing);
    }

    /// What a commit left of a row; none: it is gone.
    pub(super) fn settle(&mut self, key: Key, row: Option<Row>) {
        match row.filter(|_| !is_written_once(key.table)) {
            Some(row) => self.note(key, Some((row.revision, row.index))),
            None => {
                self.young.remove(&key);
                self.old.remove(&key);
            }
        }
    }

    pub(super) fn forget_all(&mut self) {
        *self = Self::default();
    }
}

/// Whether no later item is about a row of it, until it goes.
fn is_written_once(table: Table) -> bool {
    matches!(table, Table::TaskIntake | Table::RequestKey | Table::CommandKey | Table::OtaCommandKey)
        || table.is_audit()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key(n: usize) -> Key {
        Key::new(Table::Attempt, n.to_string())
    }

    fn at(revision: u64, state: i64) -> Standing {
        Some((Revision(revision), Index { state: Some(state), ..Index::default() }))
    }

    #[test]
    fn a_row_that_is_asked_for_stays_and_one_that_is_not_goes() {
        let mut revisions = Revisions::default();
        revisions.note(key(0), at(7, 1));
        revisions.note(key(1), None);
        for n in 2..3 * GENERATION_KEYS {
            revisions.note(key(n), at(1, 1));
            if n % (GENERATION_KEYS / 2) == 0 {
                assert_eq!(revisions.get(&key(0)), Some(Some(Revision(7))), "after {n}");
            }
        }
        assert_eq!(revisions.get(&key(1)), None);
        assert!(revisions.young.len() + revisions.old.len() <= 2 * GENERATION_KEYS);
    }

    #[test]
    fn a_write_replaces_what_an_older_generation_knows() {
        let mut revisions = Revisions::default();
        revisions.old.insert(key(0), at(1, 1));
        revisions.note(key(0), None);
        assert_eq!(revisions.get(&key(0)), Some(None));
        revisions.forget_all();
        assert_eq!(revisions.get(&key(0)), None);
    }

    #[test]
    fn what_is_gone_and_what_is_written_once_is_asked_of_the_file() {
        let mut revisions = Revisions::default();
        let row = |table| Row {
            key: Key::new(table, "1"),
            revision: Revision(1),
            index: Index::default(),
            body: "{}".into(),
        };
        for table in [Table::TaskIntake, Table::RequestKey, Table::TaskAudit, Table::Timer] {
            let row = row(table);
            // As each commit begins: whether there is such a row.
            revisions.note(row.key.clone(), None);
            revisions.settle(row.key.clone(), Some(row));
        }
        let timer = Key::new(Table::Timer, "1");
        assert_eq!(revisions.get(&timer), Some(Some(Revision(1))));
        revisions.old.insert(timer.clone(), at(1, 1));
        revisions.settle(timer.clone(), None);
        assert_eq!(revisions.get(&timer), None);
        assert!(revisions.young.is_empty() && revisions.old.is_empty());
    }

    #[test]
    fn a_row_moves_where_it_is_not_known_to_stand() {
        let mut revisions = Revisions::default();
        let row = |state: i64, parent: Option<&str>| Row {
            key: key(0),
            revision: Revision(2),
            index: Index { state: Some(state), parent: parent.map(Into::into), order: None },
            body: "{}".into(),
        };
        assert_eq!(revisions.moved(&row(1, None)), Moved::Anywhere, "it is not known");
        revisions.note(key(0), at(1, 1));
        assert_eq!(revisions.moved(&row(1, None)), Moved::Nowhere);
        assert_eq!(revisions.moved(&row(2, None)), Moved::ByState);
        assert_eq!(revisions.moved(&row(1, Some("p"))), Moved::Anywhere);
        revisions.note(key(0), None);
        assert_eq!(revisions.moved(&row(1, None)), Moved::Anywhere, "it is new");
    }
}
