//! Takes away rows that are kept for some days only: used request_ids, what people asked, and intakes of tasks that are gone.
//!
//! Invariant: only rows that nobody looks at any more. Fleet hears requests from the log, which is never cut before it has. A request_id
//! that is sent again after its row has gone is a new request.

use crate::TaskService;
use midshift_core::Boxed;
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::privacy;
use midshift_core::rows::{Key, Row, Table, Writer};
use midshift_core::task::TaskIntake;
use midshift_store::{Cursor, Error, Query, expired_rows};
use std::collections::BTreeSet;

/// Rows of one item, which others' commits pass between.
const SLICE: usize = 200;
/// What goes by the wall, after as long as [`privacy::retention_of`] says, and how the log calls it.
const KEPT: [(Table, &str); 2] = [(Table::RequestKey, "request.forgotten"), (Table::TaskRequest, "task.ask_forgotten")];

impl TaskService {
    /// Takes old rows away, in small slices, oldest first. Returns how many went.
    ///
    /// # Errors
    /// If the store cannot be read or written; what is left goes another time.
    pub fn prune(&self) -> Boxed<'_, Result<u64, Error>> {
        Box::pin(async {
            let (mut gone, now) = (0, self.inner.parts.clock.now().steady_wall());
            for (table, kind) in KEPT {
                if let Some(before) = privacy::retention_of(table).before(now) {
                    gone += expired_rows::take_away(self.store(), table, before.0, kind).await?;
                }
            }
            Ok(gone + self.prune_intakes().await?)
        })
    }

    /// What was asked for goes after its task: fleet takes the state of a task away when it ended long ago.
    async fn prune_intakes(&self) -> Result<u64, Error> {
        let Some(before) = privacy::retention_of(Table::TaskIntake).before(self.inner.parts.clock.now().steady_utc())
        else {
            return Ok(0);
        };
        let (mut after, mut gone) = (None, 0);
        while gone < limits::FORGOTTEN_PER_PASS as u64 {
            let page = self.store().list(Query { after, limit: SLICE, ..Query::all(Table::TaskIntake) }).await?;
            let Some(last) = page.last().map(Cursor::of_row) else { break };
            after = Some(last);
            let read = page.len();
            let old = |row: &Row| row.decode::<TaskIntake>().is_ok_and(|intake| intake.created < before);
            let rows: Vec<Row> = page.into_iter().take_while(old).collect();
            let is_last = rows.len() < read;
            let tasks = rows.iter().map(|row| Key::new(Table::TaskState, &row.key.id)).collect();
            // The task of one that stays shields none behind it.
            let stay: BTreeSet<_> = self.store().get(tasks).await?.into_iter().map(|state| state.key.id).collect();
            let mut item = Item::new(Writer::Task, "task");
            for row in rows.into_iter().filter(|row| !stay.contains(&row.key.id)) {
                item.delete(row.key, row.revision, "task.intake_forgotten");
            }
            gone += expired_rows::commit(self.store(), item).await?;
            if is_last {
                break;
            }
        }
        Ok(gone)
    }
}
