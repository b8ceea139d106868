//! Rows that go by age alone: those whose sort key is the moment that they were written.
//!
//! Invariant: oldest first, in small items that others' commits pass between; of two processes that do so at once one does it.

use crate::{CommitError, Error, Query, Store};
use midshift_core::rows::{Item, Table};
use std::sync::Arc;

/// Rows of one item.
const SLICE: usize = 200;

/// Takes rows of `table` away whose order is a moment before `before_unix_ms`. Returns how many went.
///
/// # Errors
/// If the store cannot be read or written; what is left goes another time.
pub async fn take_away(store: &dyn Store, table: Table, before_unix_ms: i64, kind: &'static str) -> Result<u64, Error> {
    let mut gone = 0;
    loop {
        let rows = store.list(Query { limit: SLICE, ..Query::all(table) }).await?;
        let mut item = Item::new(table.writer(), table.writer().as_str());
        for row in rows.into_iter().take_while(|row| row.index.order.is_some_and(|at| at < before_unix_ms)) {
            item.delete(row.key, row.revision, kind);
        }
        match commit(store, item).await? {
            0 => return Ok(gone),
            slice => gone += slice,
        }
    }
}

/// Commits an item that only deletes; returns how many rows went.
///
/// # Errors
/// If the store cannot be written.
pub async fn commit(store: &dyn Store, item: Item) -> Result<u64, Error> {
    let slice = item.rows.len() as u64;
    if slice == 0 {
        return Ok(0);
    }
    match store.commit(vec![item]).await.pop() {
        Some(Ok(_)) => Ok(slice),
        // Somebody else takes the same rows away.
        Some(Err(CommitError::Conflict { .. })) | None => Ok(0),
        Some(Err(error)) => Err(Error::Unavailable(Arc::new(error))),
    }
}
