//! Rows that go by age: those whose sort key is the moment that they were written, and those of robots that were retired long ago.
//!
//! Invariant: oldest first, in small items that others' commits pass between; of two processes that do so at once one does it.

use crate::{CommitError, Error, Query, Store};
use midshift_core::Boxed;
use midshift_core::fleet::rows::{RobotAuthority, RobotControl, RobotHolder};
use midshift_core::item::{Expect, Item, Write};
use midshift_core::limits;
use midshift_core::presence::Presence;
use midshift_core::presence::PresenceRow;
use midshift_core::rows::{Key, Row, Table, Writer};
use midshift_core::time::Utc;
use std::sync::Arc;

/// Rows of one item.
const SLICE: usize = 200;

/// Takes rows of `table` away whose order is a moment before `before_unix_ms`. Returns how many went.
///
/// # Errors
/// If the store cannot be read or written; what is left goes another time.
pub fn take_away<'a>(
    store: &'a dyn Store,
    table: Table,
    before_unix_ms: i64,
    kind: &'static str,
) -> Boxed<'a, Result<u64, Error>> {
    Box::pin(async move {
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
    })
}

/// Takes away what `writer` keeps of robots that were retired more than [`limits::GONE_KEPT`] ago, that nobody hears and that nothing holds.
/// Returns how many rows went.
///
/// # Errors
/// If the store cannot be read or written; what is left goes another time.
pub fn forget_robots(store: &dyn Store, writer: Writer, now: Utc) -> Boxed<'_, Result<u64, Error>> {
    Box::pin(async move {
        let mut gone = 0;
        for row in store.snapshot(&[Table::RobotControl]).await?.rows {
            if row.decode::<RobotControl>().is_ok_and(|control| is_gone(&control, now)) {
                gone += forget_robot(store, writer, row).await?;
            }
        }
        Ok(gone)
    })
}

/// Whether the robot was retired so long ago that its rows go.
pub fn is_gone(control: &RobotControl, now: Utc) -> bool {
    control.retired.as_ref().is_some_and(|retired| now.ms_since(retired.since) > limits::GONE_KEPT.as_ms())
}

async fn forget_robot(store: &dyn Store, writer: Writer, control: Row) -> Result<u64, Error> {
    let robot_id = control.key.id.clone();
    let keys = Table::OF_A_ROBOT.iter().map(|table| Key { table: *table, id: robot_id.clone() });
    let mut rows = store.get(keys.collect()).await?;
    if rows.iter().any(is_in_use) {
        return Ok(0);
    }
    for table in Table::OWNED_BY_A_ROBOT.iter().filter(|table| table.writer() == writer) {
        rows.extend(store.list(Query { limit: SLICE, ..Query::all(*table).of_parent(&robot_id) }).await?);
    }
    let mut item = Item::new(writer, writer.as_str());
    // Still retired when it is written.
    item.keep_row(control.key, Expect::At(control.revision));
    for row in rows.into_iter().filter(|row| row.key.table.writer() == writer).take(SLICE) {
        item.delete(row.key, row.revision, "robot.forgotten");
    }
    if item.rows.len() == 1 { Ok(0) } else { commit(store, item).await }
}

fn is_in_use(row: &Row) -> bool {
    match row.key.table {
        Table::Presence => row.decode::<PresenceRow>().map_or(true, |known| known.presence != Presence::Offline),
        Table::RobotAuthority => row.decode::<RobotAuthority>().map_or(true, |known| known.holder != RobotHolder::None),
        _ => false,
    }
}

/// Commits an item that takes rows away; returns how many went.
///
/// # Errors
/// If the store cannot be written.
pub async fn commit(store: &dyn Store, item: Item) -> Result<u64, Error> {
    if item.rows.is_empty() {
        return Ok(0);
    }
    commit_all(store, vec![item]).await
}

/// Commits items that take rows away, each for itself; returns how many went.
///
/// # Errors
/// If the store cannot be written.
pub async fn commit_all(store: &dyn Store, items: Vec<Item>) -> Result<u64, Error> {
    let deletes = |item: &Item| item.rows.iter().filter(|row| row.write == Write::Delete).count() as u64;
    let rows: Vec<u64> = items.iter().map(deletes).collect();
    let mut gone = 0;
    for (result, rows) in store.commit(items).await.into_iter().zip(rows) {
        match result {
            Ok(_) => gone += rows,
            // Somebody else takes the same rows away.
            Err(CommitError::Conflict { .. }) => {}
            Err(error) => return Err(Error::Unavailable(Arc::new(error))),
        }
    }
    Ok(gone)
}
