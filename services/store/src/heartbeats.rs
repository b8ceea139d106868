//! Stores the newest heartbeat of each robot for several processes: gateways save it, and every process reads what is new.
//!
//! Invariant: what [`HeartbeatLog::save_newest`] has answered is what every later reader sees, and an item with
//! [`midshift_core::item::Silent`] is applied only if nothing of its robot was kept after the position that it names. So whoever
//! gives a robot's work to another knows everything that the robot relies on. Bodies are not decoded here.
//!
//! A process that opens its store alone needs none of this: its [`crate::LiveBoard`] is the whole truth.

use crate::{Error, LiveBoard, Store};
use async_trait::async_trait;
use midshift_core::Boxed;
use midshift_core::heartbeat::{NewestHeartbeat, SharedHeartbeat};
use midshift_core::ids::RobotId;
use midshift_core::rows::Seq;
use midshift_core::time::Clock;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

/// How often others' heartbeats are looked for: a tenth of the period in which robots send them.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// The newest heartbeat of one robot, as it is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredHeartbeat {
    /// The robot that sent it.
    pub robot_id: RobotId,
    /// Session that it came in.
    pub session_epoch: u64,
    /// Its number in that session.
    pub hb: u64,
    /// What it says, and what its gateway knows about it.
    pub body: Arc<str>,
}

/// The answer of [`HeartbeatLog::save_newest`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SavedHeartbeats {
    /// Newest number of the store's feed at that moment: what was decided before is up to here.
    pub head: Seq,
    /// Robots of which a newer session has been heard already; theirs was not kept.
    pub fenced: Vec<RobotId>,
}

/// The log of newest heartbeats.
#[async_trait]
pub trait HeartbeatLog: Send + Sync + 'static {
    /// Saves heartbeats of different robots, each unless a newer session of its robot was heard; durable on return.
    async fn save_newest(&self, heard: Vec<StoredHeartbeat>) -> Result<SavedHeartbeats, Error>;
    /// The newest position; 0: nothing was ever kept.
    async fn position(&self) -> Result<u64, Error>;
    /// Robots heard after a position, each with its newest, and the position read up to.
    async fn read(&self, after: u64) -> Result<(Vec<StoredHeartbeat>, u64), Error>;
}

impl From<&NewestHeartbeat> for StoredHeartbeat {
    fn from(live: &NewestHeartbeat) -> Self {
        let (session_epoch, hb) = (live.report.session_epoch, live.report.hb);
        Self { robot_id: live.robot_id.clone(), session_epoch, hb, body: SharedHeartbeat::from(live).text() }
    }
}

/// Brings what gateways hear onto the board of this process, until it is dropped. A heartbeat counts as processed when it is read, which is
/// never before its gateway had it. What was heard before this began is passed over: whoever is there is heard again within a second.
pub fn follow_heartbeats(
    log: Arc<dyn HeartbeatLog>,
    board: Arc<LiveBoard<NewestHeartbeat>>,
    clock: Arc<dyn Clock>,
) -> Boxed<'static, ()> {
    Box::pin(async move {
        let mut position = None;
        loop {
            match read_newest(log.as_ref(), position, &board, clock.as_ref()).await {
                Ok(read) => {
                    position = Some(read);
                    board.set_read_up_to(read);
                }
                Err(error) => tracing::debug!(%error, "others' heartbeats cannot be read, trying again"),
            }
            tokio::time::sleep(LOOK_EVERY).await;
        }
    })
}

async fn read_newest(
    log: &dyn HeartbeatLog,
    after: Option<u64>,
    board: &LiveBoard<NewestHeartbeat>,
    clock: &dyn Clock,
) -> Result<u64, Error> {
    let Some(after) = after else { return log.position().await };
    let (heard, position) = log.read(after).await?;
    let now = clock.now();
    for one in heard {
        match SharedHeartbeat::parse(&one.body) {
            Ok(shared) => {
                let before = board.get(&one.robot_id);
                if let Some(live) = shared.into_newest(&one.robot_id, before.as_deref(), now) {
                    board.publish(&one.robot_id, Arc::new(live));
                }
            }
            Err(error) => {
                tracing::error!(robot_id = %one.robot_id, %error, "a heartbeat of another gateway cannot be read")
            }
        }
    }
    Ok(position)
}

/// A [`HeartbeatLog`] in memory, for several services over one store in one process.
pub struct MemoryHeartbeats {
    store: Arc<dyn Store>,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    position: u64,
    newest: BTreeMap<RobotId, (u64, StoredHeartbeat)>,
}

impl MemoryHeartbeats {
    /// An empty log beside `store`.
    pub fn new(store: Arc<dyn Store>) -> Self {
        Self { store, state: Mutex::default() }
    }
}

#[async_trait]
impl HeartbeatLog for MemoryHeartbeats {
    async fn save_newest(&self, heard: Vec<StoredHeartbeat>) -> Result<SavedHeartbeats, Error> {
        let mut fenced = Vec::new();
        {
            let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
            state.position += 1;
            let position = state.position;
            for one in heard {
                if state.newest.get(&one.robot_id).is_some_and(|(_, old)| old.session_epoch > one.session_epoch) {
                    fenced.push(one.robot_id);
                } else {
                    state.newest.insert(one.robot_id.clone(), (position, one));
                }
            }
        }
        Ok(SavedHeartbeats { head: *self.store.wake().borrow(), fenced })
    }

    async fn position(&self) -> Result<u64, Error> {
        Ok(self.state.lock().unwrap_or_else(PoisonError::into_inner).position)
    }

    async fn read(&self, after: u64) -> Result<(Vec<StoredHeartbeat>, u64), Error> {
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let newer = state.newest.values().filter(|(position, _)| *position > after);
        Ok((newer.map(|(_, heard)| heard.clone()).collect(), state.position.max(after)))
    }
}
