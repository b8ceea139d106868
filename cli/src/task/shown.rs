//! A task in words: its state, its way, its columns.

use crate::out::{Out, plain};
use crate::pages::Listed;
use midshift_proto::task::v1;

impl Listed for v1::Task {
    const HEADER: &'static [&'static str] = &["TASK", "STATE", "PRIO", "ROBOT", "WAY", "WHY"];
    fn name(&self) -> String {
        self.task_id.clone()
    }
    fn row(&self) -> Vec<String> {
        let id = self.task_id.clone();
        vec![id, state(self), priority(self), self.robot_id.clone(), waypoints(self), reason(self)]
    }
}

/// The word of its state.
pub fn state(task: &v1::Task) -> String {
    task.state().as_str_name().trim_start_matches("TASK_STATE_").to_owned()
}

/// The code of why it is so; empty: it has none.
pub fn reason(task: &v1::Task) -> String {
    task.reason.as_ref().map(|r| r.code.clone()).unwrap_or_default()
}

/// Where its steps lead.
pub fn waypoints(task: &v1::Task) -> String {
    let goals = task.spec.iter().flat_map(|s| &s.steps).filter_map(|s| match &s.kind {
        Some(v1::step::Kind::Goto(goto)) => Some(goto.waypoint.as_str()),
        _ => None,
    });
    goals.collect::<Vec<_>>().join(" > ")
}

/// Its priority, 0 most urgent.
pub fn priority(task: &v1::Task) -> String {
    task.spec.as_ref().and_then(|s| s.priority).map_or_else(|| "5".to_owned(), |p| p.to_string())
}

/// Prints one task.
pub fn show(task: &v1::Task, out: &Out) -> anyhow::Result<()> {
    out.one(task, &task.task_id, || {
        let why = task.reason.as_ref().map(|r| format!("\n  {}: {}", r.code, plain(&r.message))).unwrap_or_default();
        format!("{}  {}  {}  {}{why}", task.task_id, state(task), task.robot_id, waypoints(task))
    })
}
