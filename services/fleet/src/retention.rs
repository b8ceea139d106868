//! Takes away what is past its time: tasks that ended long ago with their attempts, all but the newest errands of a robot, and used request_ids.
//!
//! Invariant: only ended tasks go, none before its attempts. Called by the binary now and then.

use midshift_core::fleet::rows::RobotControl;
use midshift_core::ids::{AttemptId, Subject};
use midshift_core::limits;
use midshift_core::privacy;
use midshift_core::rows::{Item, Key, Row, Table, Writer};
use midshift_core::task::{Phase, TaskState};
use midshift_core::time::Clock;
use midshift_store::{CommitError, Error, Query, Store, aged};
use std::sync::Arc;

/// Tasks taken away in one call.
const TASKS_AT_ONCE: usize = 200;
/// Newest errands kept of each robot.
const ERRANDS_KEPT: u64 = 100;
/// Older errands looked at in one call.
const ERRANDS_LOOKED_AT: u64 = 200;

/// Takes ended tasks and old errands away. Gives back how many rows went.
///
/// # Errors
/// If the store does not answer.
pub async fn prune(store: &dyn Store, clock: &dyn Clock) -> Result<u64, Error> {
    Ok(prune_tasks(store, clock).await? + prune_errands(store).await? + prune_commands(store, clock).await?)
}

/// A used request_id goes with the commands after it; where there are none, here.
async fn prune_commands(store: &dyn Store, clock: &dyn Clock) -> Result<u64, Error> {
    match privacy::of(Table::CommandKey).before(clock.now().wall) {
        Some(before) => aged::take_away(store, Table::CommandKey, before.0, "command.forgotten").await,
        None => Ok(0),
    }
}

async fn prune_tasks(store: &dyn Store, clock: &dyn Clock) -> Result<u64, Error> {
    let terminal = Phase::ALL.into_iter().filter(|p| p.is_terminal()).map(Phase::number);
    let oldest_first = store.list(Query::all(Table::TaskState).in_states(terminal)).await?;
    let Some(before) = privacy::of(Table::TaskState).before(clock.now().utc) else { return Ok(0) };
    let mut items = Vec::new();
    for row in oldest_first {
        let Ok(state) = row.decode::<TaskState>() else { continue };
        if state.changed > before {
            continue;
        }
        let mut rows = store.list(Query::all(Table::Attempt).of_parent(state.task_id.as_str())).await?;
        rows.push(row);
        items.extend(rows.chunks(limits::ITEM_ROWS_MAX).map(|rows| gone(rows, "task.forgotten")));
        if items.len() >= TASKS_AT_ONCE {
            break;
        }
    }
    commit(store, items).await
}

async fn prune_errands(store: &dyn Store) -> Result<u64, Error> {
    let mut items = Vec::new();
    for row in store.snapshot(&[Table::RobotControl]).await?.rows {
        let Ok(control) = row.decode::<RobotControl>() else { continue };
        let newest = control.errands.saturating_sub(ERRANDS_KEPT);
        let old = newest.saturating_sub(ERRANDS_LOOKED_AT)..newest;
        let key = |number: u64| {
            let subject = Subject::Errand { robot_id: control.robot_id.clone(), number };
            Key::new(Table::Attempt, AttemptId { subject, epoch: 1 }.to_string())
        };
        let keys: Vec<Key> = old.map(key).collect();
        if keys.is_empty() {
            continue;
        }
        let rows = store.get(keys).await?;
        if !rows.is_empty() {
            items.push(gone(&rows, "errand.forgotten"));
        }
    }
    commit(store, items).await
}

/// An item that deletes these rows.
fn gone(rows: &[Row], kind: &'static str) -> Item {
    let mut item = Item::new(Writer::Fleet, "fleet");
    for row in rows {
        item.delete(row.key.clone(), row.revision, kind);
    }
    item
}

async fn commit(store: &dyn Store, items: Vec<Item>) -> Result<u64, Error> {
    let rows: Vec<u64> = items.iter().map(|item| item.rows.len() as u64).collect();
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
