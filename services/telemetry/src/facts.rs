//! States facts about machines, for fleet to make incidents of them.

use crate::inner::Inner;
use midshift_core::fleet::NOT_UNDERSTOOD_SEEN;
use midshift_core::ids::RobotId;
use midshift_core::item::{Fact, Item};
use midshift_core::rows::{Log, Writer};
use std::sync::Arc;
use tokio::time::Instant;
use tracing::field::Empty;

/// Bytes that are told of what was wrong.
const WHY_BYTES_MAX: usize = 300;

/// Whether a fact about a machine is on record, for fleet to make an incident of it.
pub async fn state(inner: &Inner, robot_id: &RobotId, kind: &'static str, body: &serde_json::Value) -> bool {
    let mut item = Item::new(Writer::Telemetry, robot_id.as_str());
    item.facts.push(Fact {
        log: Log::Telemetry,
        subject: Arc::from(robot_id.as_str()),
        kind,
        body: Arc::from(body.to_string()),
    });
    match inner.parts.store.commit(vec![item]).await.pop() {
        Some(Ok(_)) => true,
        Some(Err(error)) => {
            tracing::warn!(peer = %robot_id, %error, "a machine could not be recorded yet");
            false
        }
        None => false,
    }
}

/// A robot was refused because of what it said.
pub fn count_misread(inner: &Arc<Inner>, robot_id: &RobotId, why: &str) {
    if !inner.misreads.count(robot_id, Instant::now()) {
        return;
    }
    let why = &why[..why.floor_char_boundary(WHY_BYTES_MAX)];
    tracing::warn!(peer = Empty, %robot_id, why, "a robot dials again and again and is refused each time");
    let body = serde_json::json!({ "robot_id": robot_id, "why": why });
    let (inner, robot_id) = (inner.clone(), robot_id.clone());
    // The stream of the robot may be gone before it is written.
    tokio::spawn(async move {
        state(&inner, &robot_id, NOT_UNDERSTOOD_SEEN, &body).await;
    });
}
