//! Rows of a restored store that are put right before anybody opens it.
//!
//! Invariant: a store that was restored has an id of its own, so that everybody reads its rows anew: no log has these changes, and no condition is judged.

use midshift_core::item::{Expect, Item, Write};
use midshift_core::rows::{Key, Revision, Row};
use std::collections::BTreeMap;

/// What an item leaves of its rows; none: the row goes.
pub(crate) fn amended(item: &Item) -> BTreeMap<Key, Option<Row>> {
    let rows = item.rows.iter().filter_map(|change| {
        let row = match &change.write {
            Write::Keep => return None,
            Write::Delete => None,
            Write::Put { index, body } => {
                let revision = match change.expect {
                    Expect::Absent => Revision(1),
                    Expect::At(known) => known.next(),
                };
                Some(Row { key: change.key.clone(), revision, index: index.clone(), body: body.clone() })
            }
        };
        Some((change.key.clone(), row))
    });
    rows.collect()
}
