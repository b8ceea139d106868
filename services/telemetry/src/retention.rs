//! Takes away what is about rings and robots that are gone: marks of rings that a robot has replaced, and rows of robots that were retired long ago.
//!
//! Invariant: the marks of the ring that a robot's newest session has stay, however old they are: they guard the inbox and say what of STATUS need
//! not come again. Called by the server now and then.

use midshift_core::Boxed;
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::rows::{Record, Row, Table, Writer};
use midshift_core::session::{LaneMark, Session};
use midshift_core::time::{Clock, Utc};
use midshift_store::{Cursor, Error, FrameLog, FrameMark, Query, Store, expired_rows, load};
use std::collections::{BTreeMap, BTreeSet};

/// Takes away what is past its time. Gives back how many rows went.
///
/// # Errors
/// If the store or the log of frames does not answer.
pub fn prune<'a>(store: &'a dyn Store, frames: &'a dyn FrameLog, clock: &dyn Clock) -> Boxed<'a, Result<u64, Error>> {
    let now = clock.now();
    Box::pin(async move {
        let rows = prune_marks(store, now.steady_wall()).await?
            + expired_rows::forget_robots(store, Writer::Telemetry, now.steady_utc()).await?;
        Ok(rows + prune_frame_marks(store, frames).await?)
    })
}

async fn prune_marks(store: &dyn Store, wall: Utc) -> Result<u64, Error> {
    let (mut after, mut gone) = (None, 0);
    let is_old = |row: &Row| wall.ms_since(Utc(row.index.order.unwrap_or_default())) > limits::GONE_KEPT.as_ms();
    loop {
        let query = Query { after, limit: limits::ITEM_ROWS_MAX, ..Query::all(Table::LaneMark) };
        let page = store.list(query).await?;
        let Some(last) = page.last() else { return Ok(gone) };
        let is_last = !is_old(last);
        after = Some(Cursor::of_row(last));
        let mut item = Item::new(Writer::Telemetry, "telemetry");
        for row in page.into_iter().take_while(is_old) {
            if is_replaced(store, &row).await? {
                item.delete(row.key, row.revision, "lane.forgotten");
            }
        }
        gone += expired_rows::commit(store, item).await?;
        if is_last {
            return Ok(gone);
        }
    }
}

/// Whether the robot has had another ring since, or has not been heard since its rows went.
async fn is_replaced(store: &dyn Store, row: &Row) -> Result<bool, Error> {
    let Ok(mark) = row.decode::<LaneMark>() else { return Ok(false) };
    let session = load::<Session>(store, mark.robot_id.as_str()).await?;
    Ok(session.is_none_or(|(session, _)| session.ring != mark.ring))
}

/// Takes away marks of STATUS once the mark of their ring's events is gone; a ring that never had one is looked at by its robot's session alone.
async fn prune_frame_marks(store: &dyn Store, frames: &dyn FrameLog) -> Result<u64, Error> {
    // Read first: the session of a ring that begins meanwhile is older than its mark.
    let marks = frames.marks().await?;
    let (mut newest, mut beside) = (BTreeMap::new(), BTreeSet::new());
    for row in store.snapshot(&[Table::Session, Table::LaneMark]).await?.rows {
        if row.key.table == Table::LaneMark {
            beside.insert(row.key.id);
        } else {
            // One of a newer version, which cannot be read, may have any ring.
            let ring = row.decode::<Session>().ok().map(|session| session.ring);
            newest.insert(row.key.id, ring);
        }
    }
    let is_newest = |mark: &FrameMark| {
        let ring = newest.get(mark.robot_id.as_str());
        ring.is_some_and(|ring| ring.as_ref().is_none_or(|ring| **ring == *mark.ring))
    };
    let is_beside = |mark: &FrameMark| {
        let id = LaneMark::fresh(mark.robot_id.clone(), &mark.ring).id();
        beside.contains(id.as_str())
    };
    let over: Vec<FrameMark> = marks.into_iter().filter(|mark| !is_newest(mark) && !is_beside(mark)).collect();
    let mut gone = 0;
    for slice in over.chunks(limits::ITEM_ROWS_MAX) {
        gone += frames.forget(slice.to_vec()).await?;
    }
    Ok(gone)
}
