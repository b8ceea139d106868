//! Where the rows stand that were written or asked for lately, so that most items are judged without reading the file.
//!
//! Invariant: what is known here is what the last commit left; after a commit of unknown outcome everything is forgotten.
//! Bounded by two generations: a key that is not asked for during a whole generation is dropped.

use midshift_core::rows::{Key, Revision};
use std::collections::HashMap;

/// Keys of one generation. 100,000 keys are about 15 MB.
const GENERATION_KEYS: usize = 100_000;

/// A revision, or the knowledge that there is no such row.
pub(super) type Standing = Option<Revision>;

#[derive(Default)]
pub(super) struct Revisions {
    young: HashMap<Key, Standing>,
    old: HashMap<Key, Standing>,
}

impl Revisions {
    pub(super) fn get(&mut self, key: &Key) -> Option<Standing> {
        if let Some(standing) = self.young.get(key) {
            return Some(*standing);
        }
        let standing = *self.old.get(key)?;
        self.put(key.clone(), standing);
        Some(standing)
    }

    pub(super) fn put(&mut self, key: Key, standing: Standing) {
        if self.young.len() >= GENERATION_KEYS {
            self.old = std::mem::take(&mut self.young);
        }
        self.young.insert(key, standing);
    }

    pub(super) fn forget_all(&mut self) {
        *self = Self::default();
    }
}
