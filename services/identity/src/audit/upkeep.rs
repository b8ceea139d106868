//! What the chains need that nobody decides: an hourly row that quotes the heads of the others, and the end of what is old.
//!
//! Invariant: whatever is quoted was committed before the quote. Called by the server, for the services that its process has.

use midshift_core::Boxed;
use midshift_core::audit::{Head, Kind, Note, open};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::privacy;
use midshift_core::rows::{Row, Table, Writer};
use midshift_core::time::Clock;
use midshift_store::{CommitError, Error, Query, Store};
use std::sync::Arc;

/// Slices of old rows that go in one call: what is left goes with the next.
const SLICES_MAX: usize = 20;

/// Quotes the other chains in this one if the last quote is an hour old, and cuts off what is older than [`limits::AUDIT_DAYS`] days.
///
/// # Errors
/// If the store cannot be read or written; what is left is done another time.
pub fn maintain_chain<'a>(store: &'a dyn Store, clock: &'a dyn Clock, writer: Writer) -> Boxed<'a, Result<(), Error>> {
    Box::pin(maintain(store, clock, writer))
}

async fn maintain(store: &dyn Store, clock: &dyn Clock, writer: Writer) -> Result<(), Error> {
    let Some(table) = Table::audit_of(writer) else { return Ok(()) };
    let now = clock.now().wall.0;
    let newest = Query { newest_first: true, limit: 1, ..Query::all(table).in_states([Kind::Anchor.number()]) };
    let last = store.list(newest).await?.pop().and_then(|row| at(&row));
    // Also where the clock was set back.
    if last.is_none_or(|last| now.abs_diff(last) >= limits::AUDIT_ANCHOR_EVERY_MS) {
        write(store, writer, Note::anchor()).await?;
    }
    let Some(before) = privacy::retention_of(table).before(clock.now().steady_wall()) else { return Ok(()) };
    for _ in 0..SLICES_MAX {
        let oldest = store.list(Query::all(table)).await?;
        let old = oldest.iter().take_while(|row| at(row).is_some_and(|at| at < before.0)).count();
        // The last of them stays until the row behind it is old too: till then other chains may have quoted it, and a quote that is younger than the cut
        // allows shows a chain whose beginning was taken away.
        let Some(up_to) = old.checked_sub(2).and_then(|last| oldest.get(last)).and_then(head) else { break };
        write(store, writer, Note::cut(up_to)).await?;
    }
    Ok(())
}

fn at(row: &Row) -> Option<i64> {
    midshift_core::audit::AuditRow::read(&row.body).map(|row| row.at_unix_ms)
}

fn head(row: &Row) -> Option<Head> {
    let n = row.index.order?.cast_unsigned();
    Some(Head { n, hash: open(&row.body)?.hash.to_owned() })
}

async fn write(store: &dyn Store, writer: Writer, note: Note) -> Result<(), Error> {
    let mut item = Item::new(writer, writer.as_str());
    item.audit(note);
    match store.commit(vec![item]).await.pop() {
        Some(Err(error @ (CommitError::Unavailable(_) | CommitError::Unknown(_)))) => {
            Err(Error::Unavailable(Arc::new(error)))
        }
        Some(Err(error)) => {
            tracing::error!(%error, "a row of the audit was composed wrongly");
            Ok(())
        }
        _ => Ok(()),
    }
}
