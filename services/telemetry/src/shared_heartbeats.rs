//! Heartbeats where several processes share a store: kept together, a batch at a time, and echoed only after that.
//!
//! Invariant: an echo, by which a robot goes on, leaves only once its heartbeat is where every other process reads it, and everything that
//! had been decided by then has gone down before it. So nobody ever knows less of a robot than it relies on, and a gateway that cannot
//! reach the database extends no authority; when that lasts, its sessions end and its robots go to another.

use crate::projection::LinkProjection;
use midshift_core::heartbeat::NewestHeartbeat;
use midshift_core::ids::RobotId;
use midshift_store::{HeartbeatLog, LiveBoard, SavedHeartbeats, StoredHeartbeat};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

/// Least time from one batch to the next; what comes meanwhile is the next one.
const BATCH_EVERY: Duration = Duration::from_millis(50);
/// Heartbeats that may wait; of one more the robot's next one is waited for.
const WAITING_MAX: usize = 32_768;
/// A batch that is not kept within this is given up.
const KEEP_WITHIN: Duration = Duration::from_secs(2);
/// Decisions that have not come down within this keep their batch from being echoed.
const PICTURE_WITHIN: Duration = Duration::from_secs(2);
/// With nothing to keep, the database is asked this often whether it is there.
const PROBE_EVERY: Duration = Duration::from_secs(1);
/// Sessions end when the database has not been reached for so long: a sixth of the authority that robots have left then.
const CUT_OFF_AFTER: Duration = Duration::from_secs(5);

/// What became of a heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum News {
    /// It is kept: it may be echoed.
    Kept(u64),
    /// A newer session of its robot has been heard.
    Fenced,
}

/// A heartbeat on its way, and who waits for what becomes of it.
#[derive(Debug)]
struct Waiting {
    live: Arc<NewestHeartbeat>,
    session: mpsc::Sender<News>,
}

/// The way from sessions to the log of heartbeats.
pub struct Shared {
    log: Arc<dyn HeartbeatLog>,
    waiting: mpsc::Sender<Waiting>,
    queue: Mutex<Option<mpsc::Receiver<Waiting>>>,
    cut_off: watch::Sender<bool>,
}

impl Shared {
    /// Nothing is kept before [`keep_heartbeats`] runs.
    pub fn new(log: Arc<dyn HeartbeatLog>) -> Self {
        let (waiting, queue) = mpsc::channel(WAITING_MAX);
        Self { log, waiting, queue: Mutex::new(Some(queue)), cut_off: watch::Sender::new(false) }
    }
    /// Takes a heartbeat; `session` hears what becomes of it, or nothing.
    pub fn queue(&self, live: Arc<NewestHeartbeat>, session: &mpsc::Sender<News>) {
        if self.waiting.try_send(Waiting { live, session: session.clone() }).is_err() {
            metrics::counter!("midshift_telemetry_heartbeats_dropped_total").increment(1);
        }
    }
    /// Whether the database has not been reached for long.
    pub fn cut_off(&self) -> watch::Receiver<bool> {
        self.cut_off.subscribe()
    }
}

/// Keeps heartbeats until it is dropped.
pub async fn keep_heartbeats(shared: Option<&Shared>, board: &LiveBoard<NewestHeartbeat>, projection: &LinkProjection) {
    let queue = |shared: &Shared| shared.queue.lock().unwrap_or_else(PoisonError::into_inner).take();
    let Some((shared, mut queue)) = shared.and_then(|s| Some((s, queue(s)?))) else {
        return std::future::pending().await;
    };
    let mut reached = Instant::now();
    loop {
        let begun = Instant::now();
        let batch = gather(&mut queue).await;
        let saved = tokio::time::timeout(KEEP_WITHIN, write(shared.log.as_ref(), &batch)).await;
        match saved {
            Ok(Ok(saved)) => {
                reached = Instant::now();
                shared.cut_off.send_if_modified(|cut_off| std::mem::replace(cut_off, false));
                if let Some(saved) = saved {
                    publish_saved(board, projection, batch, &saved).await;
                }
            }
            failed => {
                let detail = failed.map_or_else(|_| "no answer in time".to_owned(), |e| format!("{:?}", e.err()));
                tracing::debug!(error = detail, "heartbeats could not be kept");
                let lost = reached.elapsed() >= CUT_OFF_AFTER;
                if lost && !shared.cut_off.send_replace(true) {
                    tracing::error!(
                        error = detail,
                        "cut off from the database: sessions end here, robots may go to another gateway"
                    );
                }
            }
        }
        metrics::gauge!("midshift_telemetry_cut_off").set(f64::from(u8::from(*shared.cut_off.borrow())));
        tokio::time::sleep_until(begun + BATCH_EVERY).await;
    }
}

/// The newest heartbeat of each robot that waits; none of any after a while.
async fn gather(queue: &mut mpsc::Receiver<Waiting>) -> BTreeMap<RobotId, Waiting> {
    let mut batch = BTreeMap::new();
    let mut add = |waiting: Waiting| drop(batch.insert(waiting.live.robot_id.clone(), waiting));
    if let Ok(Some(first)) = tokio::time::timeout(PROBE_EVERY, queue.recv()).await {
        add(first);
        while let Ok(more) = queue.try_recv() {
            add(more);
        }
    }
    batch
}

/// Keeps a batch; of an empty one only asks whether the log can be reached.
async fn write(
    log: &dyn HeartbeatLog,
    batch: &BTreeMap<RobotId, Waiting>,
) -> Result<Option<SavedHeartbeats>, midshift_store::Error> {
    if batch.is_empty() {
        return log.position().await.map(|_| None);
    }
    let begun = Instant::now();
    let saved =
        log.save_newest(batch.values().map(|waiting| StoredHeartbeat::from(waiting.live.as_ref())).collect()).await?;
    metrics::histogram!("midshift_telemetry_heartbeat_commit_seconds").record(begun.elapsed().as_secs_f64());
    Ok(Some(saved))
}

/// Puts what was kept on the board and tells its sessions, once what had been decided before has come down to them.
async fn publish_saved(
    board: &LiveBoard<NewestHeartbeat>,
    projection: &LinkProjection,
    batch: BTreeMap<RobotId, Waiting>,
    saved: &SavedHeartbeats,
) {
    let (fenced, heard): (Vec<_>, Vec<_>) = batch.into_values().partition(|w| saved.fenced.contains(&w.live.robot_id));
    for waiting in &heard {
        board.publish(&waiting.live.robot_id, waiting.live.clone());
    }
    for waiting in fenced {
        // A session that does not read has ended, or hears it with its next heartbeat.
        let _ = waiting.session.try_send(News::Fenced);
    }
    let absorbed = projection.absorbed(saved.head);
    if tokio::time::timeout(PICTURE_WITHIN, absorbed).await.is_err() {
        tracing::warn!("heartbeats are not echoed: what was decided meanwhile cannot be read");
        return;
    }
    for waiting in heard {
        let _ = waiting.session.try_send(News::Kept(waiting.live.report.hb));
    }
}
