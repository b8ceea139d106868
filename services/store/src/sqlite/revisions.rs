//! Where the rows stand that were written or asked for lately, so that most items are judged without reading the file, and the indexes of
//! a table are touched only where a row moves in them.
//!
//! Invariant: what is known here is what the last commit left; after a commit of unknown outcome everything is forgotten.
//! Bounded by two generations: a key that is not asked for during a whole generation is dropped.

use crate::group::CurrentRevision;
use midshift_core::rows::{Index, Key, Revision, Row};
use std::collections::HashMap;

/// Keys of one generation. 50,000 keys are about 10 MB.
const GENERATION_KEYS: usize = 50_000;

/// Revision and index columns of a row, or the knowledge that there is no such row.
pub(super) type Standing = Option<(Revision, Index)>;

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

    /// Whether the row is known to stand where it stands in the indexes of its table.
    pub(super) fn has_index(&self, row: &Row) -> bool {
        let standing = self.young.get(&row.key).or_else(|| self.old.get(&row.key));
        standing.and_then(Option::as_ref).is_some_and(|(_, index)| *index == row.index)
    }

    pub(super) fn note(&mut self, key: Key, standing: Standing) {
        if self.young.len() >= GENERATION_KEYS {
            self.old = std::mem::take(&mut self.young);
        }
        self.young.insert(key, standing);
    }

    pub(super) fn forget_all(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::rows::Table;

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
    fn a_row_moves_unless_it_is_known_to_stand_where_it_stands() {
        let mut revisions = Revisions::default();
        let row = |state| Row {
            key: key(0),
            revision: Revision(2),
            index: Index { state: Some(state), ..Index::default() },
            body: "{}".into(),
        };
        assert!(!revisions.has_index(&row(1)), "it is not known");
        revisions.note(key(0), at(1, 1));
        assert!(revisions.has_index(&row(1)));
        assert!(!revisions.has_index(&row(2)), "it moved");
        revisions.note(key(0), None);
        assert!(!revisions.has_index(&row(1)), "it is new");
    }
}
