//! Requests to submit tasks: of a transport, and of a list in a file.

use anyhow::Context;
use midshift_core::site::{Site, grid, task_list};
use midshift_core::task::forms::Transport;
use midshift_proto::task::v1::{self, SubmitTaskRequest, submit_task_request::Body};
use std::path::Path;

/// A transport as the flat form.
pub fn request(t: &Transport) -> SubmitTaskRequest {
    let small = |v: Option<i64>| v.and_then(|v| i32::try_from(v).ok());
    let flat = v1::FlatTask {
        task_type: t.kind.clone(),
        priority: small(t.priority),
        robot_id: t.robot_id.clone(),
        from_waypoint: t.from_waypoint.clone(),
        to_waypoint: t.to_waypoint.clone(),
        item_sku: t.item_sku.clone(),
        timeout_seconds: small(t.timeout_ms.map(|ms| ms / 1000)),
        max_retry_times: small(t.max_retry_times),
        retry_interval_seconds: small(t.retry_interval_ms.map(|ms| ms / 1000)),
        schedule_to_start_seconds: small(t.schedule_to_start_ms.map(|ms| ms / 1000)),
        same_robot_as: t.same_robot_as.clone(),
        coalesce_key: t.coalesce_key.clone(),
        ..v1::FlatTask::default()
    };
    SubmitTaskRequest { body: Some(Body::Flat(flat)), ..SubmitTaskRequest::default() }
}

/// Reads a task list by its ending: `.tasks` (grid), `.csv`, or JSON lines.
pub fn read_list(path: &Path, site: &Site) -> anyhow::Result<Vec<SubmitTaskRequest>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    let listed = match path.extension().and_then(|e| e.to_str()) {
        Some("tasks") => return Ok(grid::parse_tasks(site, &text)?.iter().map(grid_request).collect()),
        Some("csv") => task_list::parse_csv(&text)?,
        _ => task_list::parse_jsonl(&text)?,
    };
    listed
        .into_iter()
        .map(|task| json_request(task.task).with_context(|| format!("{}:{}", path.display(), task.line)))
        .collect()
}

/// One JSON object of a list: which form it is, is told by its fields.
fn json_request(task: serde_json::Value) -> anyhow::Result<SubmitTaskRequest> {
    let body = if task.get("content").is_some() {
        Body::Nested(midshift_proto::json::from_json(task)?)
    } else if task.get("steps").is_some() {
        Body::Spec(midshift_proto::json::from_json(task)?)
    } else if task.get("fields").is_some() {
        Body::Typed(midshift_proto::json::from_json(task)?)
    } else {
        Body::Flat(midshift_proto::json::from_json(task)?)
    };
    Ok(SubmitTaskRequest { body: Some(body), ..SubmitTaskRequest::default() })
}

fn grid_request(task: &grid::GridTask) -> SubmitTaskRequest {
    let names: Vec<String> = task.cells.iter().map(ToString::to_string).collect();
    let base =
        Transport { priority: Some(7), timeout_ms: Some(1_800_000), max_retry_times: Some(3), ..Transport::default() };
    match (task.work, names.as_slice()) {
        (grid::GridWork::Transport, [from, to]) => request(&Transport {
            kind: "transport".to_owned(),
            from_waypoint: from.clone(),
            to_waypoint: to.clone(),
            item_sku: format!("row-{}", task.line),
            ..base
        }),
        _ => {
            let goto = |waypoint: &String| v1::Step {
                kind: Some(v1::step::Kind::Goto(v1::Goto { waypoint: waypoint.clone() })),
                ..v1::Step::default()
            };
            let spec = v1::TaskSpec {
                r#type: "patrol".to_owned(),
                priority: Some(7),
                steps: names.iter().map(goto).collect(),
                timeout: Some(prost_types::Duration { seconds: 1_800, nanos: 0 }),
                ..v1::TaskSpec::default()
            };
            SubmitTaskRequest { body: Some(Body::Spec(spec)), ..SubmitTaskRequest::default() }
        }
    }
}
