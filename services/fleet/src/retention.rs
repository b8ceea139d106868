//! Takes away what is past its time: tasks that ended long ago with their attempts, errands, used request_ids, counters of software that a
//! robot runs no more, and rows of robots that were retired long ago.
//!
//! Invariants:
//! 1. Only what has ended goes, no task before its attempts, and nothing that a live task or a robot's mutex names.
//! 2. A row that stays shields none behind it.
//!
//! Called by the server now and then.

use midshift_core::Boxed;
use midshift_core::fleet::projection;
use midshift_core::fleet::rows::RobotCounter;
use midshift_core::ids::{AttemptId, Subject};
use midshift_core::item::Item;
use midshift_core::limits;
use midshift_core::privacy;
use midshift_core::rows::{Key, Row, RowSelection, Table, Writer};
use midshift_core::task::{Attempt, AttemptPhase, Phase, TaskIntake, TaskState};
use midshift_core::time::{Clock, Utc};
use midshift_store::{Cursor, Error, Query, Store, expired_rows, load};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Attempts of one task that are asked for by id; of a task with more they go first, some each time.
const ATTEMPTS_AT_ONCE: u64 = limits::ITEM_ROWS_MAX as u64 - 1;
/// Tasks whose attempts are read in one call.
const TASKS_AT_ONCE: usize = 200;

/// Takes away what is past its time. Gives back how many rows went.
///
/// # Errors
/// If the store does not answer.
pub fn prune<'a>(store: &'a dyn Store, clock: &dyn Clock) -> Boxed<'a, Result<u64, Error>> {
    let now = clock.now();
    Box::pin(async move {
        let utc = now.steady_utc();
        let tasks = prune_tasks(store, utc).await?;
        let errands = prune_errands(store, utc).await?;
        let counters = prune_counters(store, utc).await?;
        let robots = expired_rows::forget_robots(store, Writer::Fleet, utc).await?;
        Ok(tasks + errands + counters + robots + prune_commands(store, now.steady_wall()).await?)
    })
}

/// A used request_id goes with the commands after it; where there are none, here.
async fn prune_commands(store: &dyn Store, wall: Utc) -> Result<u64, Error> {
    match privacy::retention_of(Table::CommandKey).before(wall) {
        Some(before) => expired_rows::take_away(store, Table::CommandKey, before.0, "command.forgotten").await,
        None => Ok(0),
    }
}

/// What a live task waits for, and what holds a robot.
async fn named(store: &dyn Store) -> Result<BTreeSet<Key>, Error> {
    let live = Phase::ALL.into_iter().filter(|p| !p.is_terminal()).map(Phase::number);
    let parts = [RowSelection::InStates(Table::TaskState, live.collect()), RowSelection::Whole(Table::RobotAuthority)];
    Ok(store.read(&parts, projection::named).await?.rows.into_iter().map(|row| row.key).collect())
}

async fn prune_tasks(store: &dyn Store, now: Utc) -> Result<u64, Error> {
    let Some(before) = privacy::retention_of(Table::TaskState).before(now) else { return Ok(0) };
    let terminal: Vec<i64> = Phase::ALL.into_iter().filter(|p| p.is_terminal()).map(Phase::number).collect();
    let (mut after, mut needed, mut gone, mut tasks) = (None, None, 0, 0);
    while tasks < limits::FORGOTTEN_PER_PASS {
        let query = Query { after, ..Query::all(Table::TaskState).in_states(terminal.iter().copied()) };
        let page = store.list(query).await?;
        let Some(last) = page.last() else { break };
        after = Some(Cursor::of_row(last));
        // What was admitted since cannot have ended before.
        let is_last = load::<TaskIntake>(store, &last.key.id).await?.is_some_and(|(i, _)| i.created > before);
        let mut old: Vec<(TaskState, Row)> =
            page.into_iter().filter_map(|row| Some((row.decode().ok()?, row))).collect();
        old.retain(|(state, _)| state.changed <= before);
        if !old.is_empty() && needed.is_none() {
            needed = Some(named(store).await?);
        }
        old.retain(|(_, row)| needed.as_ref().is_some_and(|needed| !needed.contains(&row.key)));
        tasks += old.len();
        for some in old.chunks(TASKS_AT_ONCE) {
            gone += forget_tasks(store, some).await?;
        }
        if is_last {
            break;
        }
    }
    Ok(gone)
}

/// One item a task, in which its attempts come first.
async fn forget_tasks(store: &dyn Store, tasks: &[(TaskState, Row)]) -> Result<u64, Error> {
    let mut keys = Vec::new();
    for (state, _) in tasks.iter().filter(|(state, _)| state.epoch <= ATTEMPTS_AT_ONCE) {
        let attempt = |epoch| AttemptId { subject: Subject::Task(state.task_id.clone()), epoch };
        keys.extend((1..=state.epoch).map(|epoch| Key::new(Table::Attempt, attempt(epoch).to_string())));
    }
    let mut attempts = Vec::new();
    for some in keys.chunks(midshift_store::GET_KEYS_MAX) {
        attempts.extend(store.get(some.to_vec()).await?);
    }
    let mut attempts = attempts.into_iter().peekable();
    let mut items = Vec::new();
    for (state, row) in tasks {
        let mut rows = Vec::new();
        if state.epoch > ATTEMPTS_AT_ONCE {
            let of_task = Query::all(Table::Attempt).of_parent(state.task_id.as_str());
            rows = store.list(Query { limit: limits::ITEM_ROWS_MAX, ..of_task }).await?;
        }
        // As they were asked for.
        let is_own = |attempt: &Row| attempt.index.parent.as_deref() == Some(state.task_id.as_str());
        rows.extend(std::iter::from_fn(|| attempts.next_if(is_own)));
        if rows.len() < limits::ITEM_ROWS_MAX {
            rows.push(row.clone());
        }
        items.push(gone(rows, "task.forgotten"));
    }
    expired_rows::commit_all(store, items).await
}

/// Errands are ordered by when they were offered, behind all attempts of tasks.
async fn prune_errands(store: &dyn Store, now: Utc) -> Result<u64, Error> {
    let Some(before) = privacy::retention_of(Table::Attempt).before(now) else { return Ok(0) };
    let terminal: Vec<i64> =
        AttemptPhase::ALL.into_iter().filter(|p| p.is_terminal()).map(AttemptPhase::number).collect();
    let mut after = Cursor { order: Attempt::ERRANDS_BEHIND, id: Arc::from("") };
    let (mut needed, mut forgotten) = (None, 0);
    loop {
        let query =
            Query { after: Some(after.clone()), ..Query::all(Table::Attempt).in_states(terminal.iter().copied()) };
        let page = store.list(Query { limit: limits::ITEM_ROWS_MAX, ..query }).await?;
        let Some(last) = page.last().map(Cursor::of_row) else { return Ok(forgotten) };
        let is_last = last.order > before.0;
        after = last;
        let mut old = page;
        old.retain(|row| row.decode::<Attempt>().is_ok_and(|a| a.ended.unwrap_or(a.offered) <= before));
        if !old.is_empty() && needed.is_none() {
            needed = Some(named(store).await?);
        }
        old.retain(|row| needed.as_ref().is_some_and(|needed| !needed.contains(&row.key)));
        forgotten += expired_rows::commit(store, gone(old, "errand.forgotten")).await?;
        if is_last {
            return Ok(forgotten);
        }
    }
}

/// Of each robot the counter stays that was written last: it tells of the software that it runs.
async fn prune_counters(store: &dyn Store, now: Utc) -> Result<u64, Error> {
    let mut after = None;
    let mut old = Vec::new();
    loop {
        let page = store.list(Query { after, ..Query::all(Table::RobotCounter) }).await?;
        let Some(last) = page.last().map(Cursor::of_row) else { break };
        let is_old = |row: &Row| now.ms_since(Utc(row.index.order.unwrap_or_default())) > limits::GONE_KEPT.as_ms();
        let is_last = page.last().is_some_and(|row| !is_old(row));
        after = Some(last);
        for row in page.into_iter().take_while(is_old) {
            if !is_newest(store, &row).await? {
                old.push(row);
            }
        }
        if is_last || old.len() >= limits::FORGOTTEN_PER_PASS {
            break;
        }
    }
    let items = old.chunks(limits::ITEM_ROWS_MAX).map(|rows| gone(rows.to_vec(), "counter.forgotten"));
    expired_rows::commit_all(store, items.collect()).await
}

async fn is_newest(store: &dyn Store, row: &Row) -> Result<bool, Error> {
    let Ok(counter) = row.decode::<RobotCounter>() else { return Ok(true) };
    let of_robot = Query::all(Table::RobotCounter).of_parent(counter.robot_id.as_str());
    let newest = store.list(Query { newest_first: true, limit: 1, ..of_robot }).await?;
    Ok(newest.first().is_none_or(|newest| newest.key == row.key))
}

/// An item that deletes these rows.
fn gone(rows: Vec<Row>, kind: &'static str) -> Item {
    let mut item = Item::new(Writer::Fleet, "fleet");
    for row in rows {
        item.delete(row.key, row.revision, kind);
    }
    item
}
