//! `midshift task watch|wait`: tasks as they change.

use super::shown::{reason, state, waypoints};
use crate::client::{self, Call, Exit};
use crate::out::{Format, Out};
use midshift_proto::task::v1::{self, watch_tasks_response::Item};
use std::cell::RefCell;
use std::ops::ControlFlow;
use std::time::Duration;

/// Follows changes of tasks until nobody reads them.
pub async fn watch(call: &Call, task_ids: Vec<String>, cursor: String, out: &Out) -> Result<(), Exit> {
    let filter = v1::TaskFilter { task_ids, ..v1::TaskFilter::default() };
    // A stream that was cut goes on behind what it said last.
    let said = RefCell::new(cursor.clone());
    let open = async || {
        let request = v1::WatchTasksRequest { filter: Some(filter.clone()), cursor: said.borrow().clone() };
        Ok(call.task().await?.watch_tasks(request).await?.into_inner())
    };
    let take = |message: Option<v1::WatchTasksResponse>| {
        if let Some(message) = message {
            show_change(&message, out)?;
            said.replace(message.cursor);
        }
        Ok(ControlFlow::Continue(()))
    };
    loop {
        match client::follow(out, &open, take).await {
            // A place that the caller named is the caller's to mend.
            Err(exit) if exit.is_of_a_lost_place() && *said.borrow() != cursor => {
                out.inform("the server does not know any more where this watch was: what is known now follows, and changes may be missing");
                said.take();
            }
            end => return end,
        }
    }
}

fn show_change(message: &v1::WatchTasksResponse, out: &Out) -> Result<(), Exit> {
    if matches!(out.format, Format::Json | Format::Jsonl) {
        return Ok(out.json(message)?);
    }
    let task = match &message.item {
        Some(Item::Existing(task)) => Some(task),
        Some(Item::Change(change)) => change.task.as_ref(),
        Some(Item::Bookmark(_)) | None => None,
    };
    if let Some(task) = task {
        let (state, way, reason) = (state(task), waypoints(task), reason(task));
        out.line(&format!("{}  {state:<14}  {:<8}  {way}  {reason}", task.task_id, task.robot_id));
    }
    Ok(())
}

/// Follows a task to its end; exit code by how it ended; `told` is what was last said of it.
pub async fn until_over(call: &Call, task_id: &str, told: String, timeout: Duration, out: &Out) -> Result<(), Exit> {
    let end = tokio::time::timeout(timeout, followed(call, task_id, told, out)).await;
    let task = end.map_err(|_| {
        Exit::new(10, format!("{task_id} is not over after {timeout:?}\n  try: midshift task explain {task_id}"))
    })??;
    let took = match (&task.create_time, &task.end_time) {
        (Some(from), Some(to)) => (to.seconds - from.seconds) as f64 + f64::from(to.nanos - from.nanos) / 1e9,
        _ => 0.0,
    };
    let path_m = task.stats.as_ref().map_or(0.0, |s| s.path_mm as f64 / 1000.0);
    out.one(&task, &task.task_id, || format!("  {took:.1} s, {path_m:.1} m, attempt {}", task.epoch))?;
    match task.state() {
        v1::TaskState::Succeeded => Ok(()),
        v1::TaskState::NeedsOperator => Err(Exit::new(
            1,
            format!("{task_id} needs an operator: {}\n  try: midshift task get {task_id}", reason(&task)),
        )),
        _ => Err(Exit::new(1, format!("{task_id} ended {}: {}", state(&task), reason(&task)))),
    }
}

/// Reports the state of a task if it has changed, and returns that state.
pub fn report_state(task_id: &str, told: &str, task: &v1::Task, out: &Out) -> String {
    let now = format!("{} {}", state(task), task.robot_id).trim().to_owned();
    if now != told && out.format == Format::Table {
        let begin = if told.is_empty() { task_id } else { "  >" };
        out.inform(&format!("{begin} {now}"));
    }
    now
}

async fn followed(call: &Call, task_id: &str, mut told: String, out: &Out) -> Result<v1::Task, Exit> {
    let open = async || {
        let filter = v1::TaskFilter { task_ids: vec![task_id.to_owned()], ..v1::TaskFilter::default() };
        let request = v1::WatchTasksRequest { filter: Some(filter), cursor: String::new() };
        Ok(call.task().await?.watch_tasks(request).await?.into_inner())
    };
    let mut is_known = false;
    let take = |message: Option<v1::WatchTasksResponse>| {
        let task = match message.and_then(|m| m.item) {
            Some(Item::Existing(task)) => task,
            Some(Item::Change(change)) => change.task.unwrap_or_default(),
            Some(Item::Bookmark(_)) if !is_known => {
                return Err(Exit::new(4, format!("the server knows no task {task_id}\n  try: midshift task ls")));
            }
            Some(Item::Bookmark(_)) => return Ok(ControlFlow::Continue(())),
            None => {
                is_known = false;
                return Ok(ControlFlow::Continue(()));
            }
        };
        is_known = true;
        told = report_state(task_id, &told, &task, out);
        use v1::TaskState::{Canceled, Expired, Failed, NeedsOperator, Succeeded};
        let is_over = matches!(task.state(), Succeeded | Failed | Canceled | Expired | NeedsOperator);
        Ok(if is_over { ControlFlow::Break(task) } else { ControlFlow::Continue(()) })
    };
    client::follow(out, open, take).await
}
