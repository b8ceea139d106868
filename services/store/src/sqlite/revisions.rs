//! Where the rows stand that were written or asked for lately, so that most items are judged without reading the file.
//!
//! Invariant: what is known here is what the last commit left; after a commit of unknown outcome everything is forgotten.
//! Bounded by two generations: a key that is not asked for during a whole generation is dropped.

use crate::group::CurrentRevision;
use midshift_core::rows::Key;
use std::collections::HashMap;

/// Keys of one generation. 100,000 keys are about 15 MB.
const GENERATION_KEYS: usize = 100_000;

#[derive(Default)]
pub(super) struct Revisions {
    young: HashMap<Key, CurrentRevision>,
    old: HashMap<Key, CurrentRevision>,
}

impl Revisions {
    pub(super) fn get(&mut self, key: &Key) -> Option<CurrentRevision> {
        if let Some(revision) = self.young.get(key) {
            return Some(*revision);
        }
        let revision = *self.old.get(key)?;
        self.note(key.clone(), revision);
        Some(revision)
    }

    pub(super) fn note(&mut self, key: Key, revision: CurrentRevision) {
        if self.young.len() >= GENERATION_KEYS {
            self.old = std::mem::take(&mut self.young);
        }
        self.young.insert(key, revision);
    }

    pub(super) fn forget_all(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::rows::{Revision, Table};

    #[test]
    fn a_row_that_is_asked_for_stays_and_one_that_is_not_goes() {
        let key = |n: usize| Key::new(Table::Attempt, n.to_string());
        let mut revisions = Revisions::default();
        revisions.note(key(0), Some(Revision(7)));
        revisions.note(key(1), None);
        for n in 2..3 * GENERATION_KEYS {
            revisions.note(key(n), Some(Revision(1)));
            if n % (GENERATION_KEYS / 2) == 0 {
                assert_eq!(revisions.get(&key(0)), Some(Some(Revision(7))), "after {n}");
            }
        }
        assert_eq!(revisions.get(&key(1)), None);
        assert!(revisions.young.len() + revisions.old.len() <= 2 * GENERATION_KEYS);
    }

    #[test]
    fn a_write_replaces_what_an_older_generation_knows() {
        let key = Key::new(Table::Attempt, "a");
        let mut revisions = Revisions::default();
        revisions.old.insert(key.clone(), Some(Revision(1)));
        revisions.note(key.clone(), None);
        assert_eq!(revisions.get(&key), Some(None));
        revisions.forget_all();
        assert_eq!(revisions.get(&key), None);
    }
}
