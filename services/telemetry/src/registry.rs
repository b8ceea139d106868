//! Which sessions are alive in this process: one in charge per robot, and those that are only observed. Succession ends the older one; a
//! clone is only observed.
//!
//! Invariant: a session that did not prove its succession is never in charge while the older one is heard.

use midshift_core::identity::SessionSecret;
use midshift_core::ids::RobotId;
use midshift_core::reason::Refusal;
use midshift_core::time::{LinkTime, Utc};
use midshift_proto::session::{LaneAck, LaneBatch};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;

/// Batches that may wait for the task of one session, beside the one that it has.
const REPLAYS_WAITING_MAX: usize = 1;

/// One batch for a session in charge.
#[derive(Debug)]
pub struct Replay {
    /// Samples and gaps of one lane.
    pub batch: LaneBatch,
    /// Who waits for what becomes of it; dropped if the session ends before.
    pub answer: oneshot::Sender<Result<LaneAck, Refusal>>,
}

/// One session in charge.
#[derive(Clone, Debug)]
pub struct InCharge {
    /// Its epoch.
    pub session_epoch: u64,
    /// The secret of its Welcome: with the epoch, what proves that a replay is for it.
    pub secret: SessionSecret,
    /// To its task.
    pub replays: mpsc::Sender<Replay>,
    /// When its newest heartbeat was processed, milliseconds of link time.
    heard: Arc<AtomicU64>,
    /// Cancelled when a newer session proved its succession.
    pub fenced: CancellationToken,
    /// It was told to move over: its successor is expected.
    pub moving: Arc<std::sync::atomic::AtomicBool>,
}

impl InCharge {
    /// Begins at `now`; and where its task finds replays.
    pub fn new(session_epoch: u64, secret: SessionSecret, now: LinkTime) -> (Self, mpsc::Receiver<Replay>) {
        let (replays, waiting) = mpsc::channel(REPLAYS_WAITING_MAX);
        let this = Self {
            session_epoch,
            secret,
            replays,
            heard: Arc::new(AtomicU64::new(now.0)),
            fenced: CancellationToken::new(),
            moving: Arc::default(),
        };
        (this, waiting)
    }
    /// Notes a heartbeat.
    pub fn note_heard(&self, now: LinkTime) {
        self.heard.store(now.0, Relaxed);
    }
    /// Newest heartbeat.
    pub fn heard(&self) -> LinkTime {
        LinkTime(self.heard.load(Relaxed))
    }
}

/// Sessions by robot.
#[derive(Debug, Default)]
pub struct Registry {
    sessions: Mutex<BTreeMap<RobotId, InCharge>>,
    /// Since when each of the observed ones is attached.
    observed: Mutex<BTreeMap<RobotId, Vec<Utc>>>,
    /// Which session of each robot ended here last.
    left: Mutex<BTreeMap<RobotId, u64>>,
    /// How many are in charge.
    count: watch::Sender<usize>,
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
        self.counted(sessions.len());
        true
    }
    /// Ends the session of a robot that is older than the newest that was begun anywhere.
    pub fn fence(&self, robot_id: &RobotId, newest_epoch: u64) {
        if let Some(old) = self.sessions().get(robot_id).filter(|s| s.session_epoch < newest_epoch) {
            old.fenced.cancel();
        }
        let mut left = self.left();
        if left.get(robot_id).is_some_and(|epoch| *epoch < newest_epoch) {
            left.remove(robot_id);
        }
    }
    /// Whether the robot's newest session is, or was, here.
    pub fn is_home(&self, robot_id: &RobotId) -> bool {
        self.sessions().contains_key(robot_id) || self.left().contains_key(robot_id)
    }
    fn left(&self) -> std::sync::MutexGuard<'_, BTreeMap<RobotId, u64>> {
        self.left.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Whether this session was in charge here, and is no more.
    pub fn has_left(&self, robot_id: &RobotId, session_epoch: u64) -> bool {
        self.left().get(robot_id) == Some(&session_epoch)
    }
    fn observed(&self) -> std::sync::MutexGuard<'_, BTreeMap<RobotId, Vec<Utc>>> {
        self.observed.lock().unwrap_or_else(PoisonError::into_inner)
    }
    /// Notes a session that is only observed.
    pub fn observe(&self, robot_id: &RobotId, since: Utc) {
        self.observed().entry(robot_id.clone()).or_default().push(since);
    }
    /// Lets a session go that was observed since then.
    pub fn lose_sight(&self, robot_id: &RobotId, since: Utc) {
        let mut observed = self.observed();
        let Some(sessions) = observed.get_mut(robot_id) else { return };
        if let Some(at) = sessions.iter().position(|s| *s == since) {
            sessions.swap_remove(at);
        }
        if sessions.is_empty() {
            observed.remove(robot_id);
        }
    }
    /// Since when another machine of this name is attached and observed.
    pub fn observed_since(&self, robot_id: &RobotId) -> Option<Utc> {
        self.observed().get(robot_id)?.iter().min().copied()
    }
    /// Lets a session go, if it is still the one in charge.
    pub fn leave(&self, robot_id: &RobotId, session_epoch: u64) {
        let mut sessions = self.sessions();
        if sessions.get(robot_id).is_some_and(|s| s.session_epoch == session_epoch) {
            sessions.remove(robot_id);
            self.left().insert(robot_id.clone(), session_epoch);
        }
        self.counted(sessions.len());
    }
    fn counted(&self, sessions: usize) {
        metrics::gauge!("midshift_telemetry_sessions").set(sessions as f64);
        self.count.send_replace(sessions);
    }
    /// Sessions in charge.
    pub fn in_charge(&self) -> usize {
        *self.count.borrow()
    }
    /// Waits until no session is in charge here.
    pub async fn empty(&self) {
        // The sender lives as long as the registry.
        let _ = self.count.subscribe().wait_for(|count| *count == 0).await;
    }
}
