//! Takes away what is about rings and robots that are gone: marks of rings that a robot has replaced, and rows of robots that were retired long ago.
//!
//! Invariant: the mark of the ring that a robot's newest session has stays, however old it is: it guards the inbox. Called by the binary now
//! and then.

use midshift_core::limits;
use midshift_core::rows::{Item, Row, Table, Writer};
use midshift_core::time::{Clock, Utc};
use midshift_core::work::{LaneMark, Session};
use midshift_store::{Cursor, Error, Query, Store, aged, load};

/// Takes away what is past its time. Gives back how many rows went.
///
/// # Errors
/// If the store does not answer.
pub async fn prune(store: &dyn Store, clock: &dyn Clock) -> Result<u64, Error> {
    let now = clock.now();
    Ok(prune_marks(store, now.steady_wall()).await?
        + aged::forget_robots(store, Writer::Telemetry, now.steady_utc()).await?)
}

async fn prune_marks(store: &dyn Store, wall: Utc) -> Result<u64, Error> {
    let (mut after, mut gone) = (None, 0);
    let is_old = |row: &Row| wall.ms_since(Utc(row.index.order.unwrap_or_default())) > limits::GONE_KEPT.as_ms();
    loop {
        let query = Query { after, limit: limits::ITEM_ROWS_MAX, ..Query::all(Table::LaneMark) };
        let page = store.list(query).await?;
        let Some(last) = page.last() else { return Ok(gone) };
        let is_last = !is_old(last);
        after = Some(Cursor::of(last));
        let mut item = Item::new(Writer::Telemetry, "telemetry");
        for row in page.into_iter().take_while(is_old) {
            if is_replaced(store, &row).await? {
                item.delete(row.key, row.revision, "lane.forgotten");
            }
        }
        gone += aged::commit(store, item).await?;
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
