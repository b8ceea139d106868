//! Observes a second machine that attaches under the name of an attached robot without proof of succession.
//!
//! 1. If the older session falls silent, the second machine is the robot, started anew. It comes back and takes charge.
//! 2. If the older session is heard on, two machines are alive, and people are told.
//! 3. A second machine with another ring lacks the memory of the first. It takes charge only when the authority of the
//!    first has ended: until then the first may still work, behind a gap in the network.
//!
//! Invariant: a robot that restarted or moved is never reported. A copied key or secret never distinguishes them.

use crate::facts::state;
use crate::inner::Inner;
use midshift_core::fleet::CLONE_SEEN;
use midshift_core::identity::Caller;
use midshift_core::ids::RobotId;
use midshift_core::limits;
use midshift_core::reason::Code;
use midshift_core::time::LinkTime;
use midshift_proto::session::Hello;
use std::sync::Arc;
use std::time::Duration;
use tracing::field::Empty;

/// Such a machine.
pub struct SuspectedClone {
    robot_id: RobotId,
    boot_id: String,
    /// Serial number of the certificate that it showed.
    certificate: Option<Arc<str>>,
    since: LinkTime,
    /// Its ring is not that of the older session.
    has_other_ring: bool,
}

impl SuspectedClone {
    /// Whoever said this Hello, now.
    pub fn new(inner: &Inner, hello: &Hello, by: &Caller, has_other_ring: bool) -> Self {
        let (robot_id, boot_id) = (hello.robot_id.clone(), hello.boot_id.clone());
        tracing::info!(peer = Empty, %robot_id, boot_id, "second session without proof of succession, observed until the older one is silent");
        let certificate = by.certificate().cloned();
        Self { robot_id, boot_id, certificate, since: inner.parts.clock.now().link, has_other_ring }
    }

    /// Waits until the session in charge is gone or silent; then this robot may come back and take charge. Tells people once if both are alive.
    pub async fn until_alone(self, inner: Arc<Inner>) {
        let mut is_told = false;
        loop {
            tokio::time::sleep(Duration::from_millis(limits::HEARTBEAT.as_ms())).await;
            let Some(heard) = self.older_heard(&inner) else { return };
            if !is_told && heard.since(self.since) >= limits::CLONE_SURE_AFTER {
                is_told = self.record_clone(&inner).await;
            }
        }
    }

    /// When the older session was heard last; none: it is gone, here or at another gateway, or has been silent for long.
    fn older_heard(&self, inner: &Inner) -> Option<LinkTime> {
        if let Some(older) = inner.registry.get(&self.robot_id) {
            if inner.parts.clock.now().link.since(older.heard()) <= limits::SUSPECT_AFTER {
                return Some(older.heard());
            }
            older.fenced.cancel();
            inner.registry.leave(&self.robot_id, older.session_epoch);
        }
        heard_elsewhere(inner, &self.robot_id).or_else(|| in_gap(inner, &self.robot_id).filter(|_| self.has_other_ring))
    }

    /// Whether it is on record, for fleet to make an incident of it.
    async fn record_clone(&self, inner: &Inner) -> bool {
        let Self { robot_id, boot_id, certificate, .. } = self;
        let certificate = certificate.as_deref();
        tracing::warn!(peer = Empty, %robot_id, boot_id, certificate, "two machines with the name of one robot are alive: the second is observed only");
        let body = serde_json::json!({
            "robot_id": robot_id, "boot_id": boot_id, "certificate": certificate, "code": Code::CloneSeen.as_str(),
        });
        let is_told = state(inner, robot_id, CLONE_SEEN, &body).await;
        if is_told {
            metrics::counter!("midshift_telemetry_clones_total").increment(1);
        }
        is_told
    }
}

/// When another gateway heard the robot, if that was a moment ago.
pub fn heard_elsewhere(inner: &Inner, robot_id: &RobotId) -> Option<LinkTime> {
    let live = inner.parts.board.get(robot_id).filter(|_| inner.shared.is_some())?;
    let silent = inner.parts.clock.now().link.since(live.processed_at);
    let is_heard = silent <= limits::SUSPECT_AFTER && !inner.registry.has_left(robot_id, live.report.session_epoch);
    is_heard.then_some(live.processed_at)
}

/// When the robot was heard last, if whoever it was may still have authority.
pub fn in_gap(inner: &Inner, robot_id: &RobotId) -> Option<LinkTime> {
    let live = inner.parts.board.get(robot_id)?;
    (inner.parts.clock.now().link.since(live.processed_at) <= limits::LEASE).then_some(live.processed_at)
}
