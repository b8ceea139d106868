//! Takes away rows that are kept for some days only: used request_ids, what people asked, and intakes of tasks that are gone.
//!
//! Invariant: only rows that nobody looks at any more. Fleet hears requests from the log, which is never cut before it has. A request_id
//! that is sent again after its row has gone is a new request.

use crate::TaskService;
use midshift_core::limits;
use midshift_core::rows::{Item, Key, Row, Table, Writer};
use midshift_core::task::TaskIntake;
use midshift_store::{CommitError, Error, Query};
use std::sync::Arc;

/// Rows of one item, which others' commits pass between.
const SLICE: usize = 200;
const DAY_MS: i64 = 86_400_000;
/// What goes after how many days of the wall, and how the log calls it.
const KEPT: [(Table, u64, &str); 2] = [
    (Table::RequestKey, limits::REMEMBER_DAYS, "request.forgotten"),
    (Table::TaskRequest, limits::ASKED_DAYS, "task.ask_forgotten"),
];

impl TaskService {
    /// Takes old rows away, in small slices, oldest first. Returns how many went.
    ///
    /// # Errors
    /// If the store cannot be read or written; what is left goes another time.
    pub async fn prune(&self) -> Result<u64, Error> {
        let mut gone = 0;
        for (table, days, kind) in KEPT {
            let before = self.inner.parts.clock.now().wall.0 - days as i64 * DAY_MS;
            while let slice @ 1.. = self.prune_slice(table, before, kind).await? {
                gone += slice;
            }
        }
        Ok(gone + self.prune_intakes().await?)
    }

    /// What was asked for goes after its task: fleet takes the state of a task away when it ended long ago.
    async fn prune_intakes(&self) -> Result<u64, Error> {
        let before = self.inner.parts.clock.now().utc.0 - limits::ASKED_DAYS as i64 * DAY_MS;
        let rows = self.store().list(Query { limit: SLICE, ..Query::all(Table::TaskIntake) }).await?;
        let old = |row: &Row| row.decode::<TaskIntake>().is_ok_and(|intake| intake.created.0 < before);
        let rows: Vec<Row> = rows.into_iter().take_while(old).collect();
        let states = self.store().get(rows.iter().map(|row| Key::new(Table::TaskState, &row.key.id)).collect()).await?;
        let stays = |row: &Row| states.iter().any(|state| state.key.id == row.key.id);
        let mut item = Item::new(Writer::Task, "task");
        for row in rows.into_iter().filter(|row| !stays(row)) {
            item.delete(row.key, row.revision, "task.intake_forgotten");
        }
        self.take_away(item).await
    }

    /// One slice of rows whose order is a moment before `before`, unix ms.
    async fn prune_slice(&self, table: Table, before: i64, kind: &'static str) -> Result<u64, Error> {
        let rows = self.store().list(Query { limit: SLICE, ..Query::all(table) }).await?;
        let mut item = Item::new(Writer::Task, "task");
        for row in rows.into_iter().take_while(|row| row.index.order.is_some_and(|at| at < before)) {
            item.delete(row.key, row.revision, kind);
        }
        self.take_away(item).await
    }

    async fn take_away(&self, item: Item) -> Result<u64, Error> {
        let slice = item.rows.len() as u64;
        if slice == 0 {
            return Ok(0);
        }
        match self.commit(vec![item]).await.pop() {
            Some(Ok(_)) => Ok(slice),
            // Somebody else takes the same rows away.
            Some(Err(CommitError::Conflict { .. })) => Ok(0),
            Some(Err(error)) => Err(Error::Unavailable(Arc::new(error))),
            None => Ok(0),
        }
    }
}
