//! Which sessions are alive in this process, one in charge per robot. Succession ends the older one; a clone is only observed.
//!
//! Invariant: a session that did not prove its succession is never in charge while the older one is heard.

use midshift_core::ids::RobotId;
use midshift_core::time::LinkTime;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use tokio_util::sync::CancellationToken;

/// One session in charge.
#[derive(Clone, Debug)]
pub struct InCharge {
    /// Its epoch.
    pub session_epoch: u64,
    /// When its newest heartbeat was processed, milliseconds of link time.
    heard: Arc<AtomicU64>,
    /// Cancelled when a newer session proved its succession.
    pub fenced: CancellationToken,
    /// It was told to move over: its successor is expected.
    pub moving: Arc<std::sync::atomic::AtomicBool>,
}

impl InCharge {
    /// Begins at `now`.
    pub fn new(session_epoch: u64, now: LinkTime) -> Self {
        Self {
            session_epoch,
            heard: Arc::new(AtomicU64::new(now.0)),
            fenced: CancellationToken::new(),
            moving: Arc::default(),
        }
    }
    /// Notes a heartbeat.
    pub fn hear(&self, now: LinkTime) {
        self.heard.store(now.0, Relaxed);
    }
    /// Newest heartbeat.
    pub fn heard(&self) -> LinkTime {
        LinkTime(self.heard.load(Relaxed))
    }
}

/// Sessions in charge, by robot.
#[derive(Debug, Default)]
pub struct Registry {
    sessions: Mutex<BTreeMap<RobotId, InCharge>>,
}

impl Registry {
    fn sessions(&self) -> std::sync::MutexGuard<'_, BTreeMap<RobotId, InCharge>> {
        self.sessions.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// The session in charge of a robot.
    pub fn get(&self, robot_id: &RobotId) -> Option<InCharge> {
        self.sessions().get(robot_id).cloned()
    }
    /// Puts a session in charge and ends the older one, unless a newer is there already.
    pub fn take_charge(&self, robot_id: &RobotId, session: InCharge) -> bool {
        let mut sessions = self.sessions();
        if sessions.get(robot_id).is_some_and(|old| old.session_epoch > session.session_epoch) {
            return false;
        }
        if let Some(old) = sessions.insert(robot_id.clone(), session) {
            old.fenced.cancel();
        }
        metrics::gauge!("midshift_telemetry_sessions").set(sessions.len() as f64);
        true
    }
    /// Lets a session go, if it is still the one in charge.
    pub fn leave(&self, robot_id: &RobotId, session_epoch: u64) {
        let mut sessions = self.sessions();
        if sessions.get(robot_id).is_some_and(|s| s.session_epoch == session_epoch) {
            sessions.remove(robot_id);
        }
        metrics::gauge!("midshift_telemetry_sessions").set(sessions.len() as f64);
    }
}
