//! The store as fleet's planner sees it in a shift: everything goes through to the model, and what is planned is noted.
//!
//! Noted are a hash of every item, how long each plan took by the wall, and what became of each task. Only fleet has
//! this handle; the other services have the store itself. Invariant: it changes nothing, and
//! delays nothing but the planner, by the virtual time that each of its turns is to take and the pause between two.

use super::clock::VirtualClock;
use super::task_records::TaskRecords;
use async_trait::async_trait;
use midshift_core::audit::Head;
use midshift_core::ids::SiteId;
use midshift_core::item::{Item, Write};
use midshift_core::rows::{Key, Log, Naming, Row, RowSelection, Seq, Table, Writer};
use midshift_core::task::TaskState;
use midshift_store::{
    Applied, CommitError, Error, FeedPage, MemoryStore, Query, Retention, Snapshot, Store, StoreId, Subjects,
};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// FNV-1a, 64 bits.
const HASH_BEGIN: u64 = 0xcbf2_9ce4_8422_2325;
const HASH_PRIME: u64 = 0x0100_0000_01b3;

/// What was noted of plans.
#[derive(Clone, Debug)]
pub struct PlansNoted {
    /// Of every row that plans wrote, in order.
    pub hash: u64,
    /// Items that plans were made of.
    pub items: u64,
    /// Items that the store did not take.
    pub items_lost: u64,
    /// From the read of the feed to the commit, of each plan that decided something, milliseconds by the wall.
    pub plan_ms: Vec<f64>,
}

struct Noted {
    plans: PlansNoted,
    /// When the feed was read last, by the wall; none: a plan was committed since.
    read_at: Option<Instant>,
}

/// The store behind its notes.
pub struct PlanLog {
    store: Arc<MemoryStore>,
    clock: Arc<VirtualClock>,
    records: Arc<TaskRecords>,
    /// Virtual time that each turn of the planner takes.
    turn: Duration,
    /// Says that something was written.
    wake: watch::Receiver<Seq>,
    noted: Mutex<Noted>,
}

/// How often the planner has its turn, in virtual time. It has one in each of its sweeps, whatever stands here.
#[derive(Clone, Copy, Debug, Default)]
pub struct PlannerPace {
    /// Each turn takes so long, and the planner rests as long after it, so that news gather.
    pub turn: Duration,
    /// It is told at most once in so long that something was written; zero: at once. At most a sweep matters.
    pub pause: Duration,
}

/// Passes wakes on, with a pause after each.
fn pass_on_wakes(mut from: watch::Receiver<Seq>, pause: Duration) -> watch::Receiver<Seq> {
    let (sender, wake) = watch::channel(*from.borrow());
    tokio::spawn(async move {
        while from.changed().await.is_ok() {
            let seq = *from.borrow_and_update();
            if sender.send(seq).is_err() {
                return;
            }
            tokio::time::sleep(pause).await;
        }
    });
    wake
}

impl PlanLog {
    /// Nothing is noted yet.
    pub fn new(
        store: Arc<MemoryStore>,
        clock: Arc<VirtualClock>,
        records: Arc<TaskRecords>,
        PlannerPace { turn, pause }: PlannerPace,
    ) -> Self {
        let wake = if pause.is_zero() { store.wake() } else { pass_on_wakes(store.wake(), pause) };
        let plans = PlansNoted { hash: HASH_BEGIN, items: 0, items_lost: 0, plan_ms: Vec::new() };
        Self { store, clock, records, turn, wake, noted: Mutex::new(Noted { plans, read_at: None }) }
    }

    /// What was noted so far.
    pub fn plans(&self) -> PlansNoted {
        self.lock().plans.clone()
    }

    fn lock(&self) -> MutexGuard<'_, Noted> {
        self.noted.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn note_plan(&self, items: &[Item]) {
        let mut noted = self.lock();
        if let Some(read_at) = noted.read_at.take() {
            noted.plans.plan_ms.push(read_at.elapsed().as_secs_f64() * 1e3);
        }
        for item in items {
            noted.plans.items += 1;
            for row in &item.rows {
                let body = match &row.write {
                    Write::Put { body, .. } => body.as_bytes(),
                    Write::Delete => b"deleted",
                    Write::Keep => b"kept",
                };
                // The name of a person's request is drawn by the service, not from the seed.
                let id = if row.key.table == Table::TaskRequest { &[] } else { row.key.id.as_bytes() };
                let parts = [row.key.table.name().as_bytes(), id, row.kind.as_bytes(), body];
                noted.plans.hash = parts.into_iter().fold(noted.plans.hash, hash_bytes);
            }
        }
    }
}

fn hash_bytes(hash: u64, bytes: &[u8]) -> u64 {
    let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(HASH_PRIME);
    step(bytes.iter().fold(hash, step), &0xff)
}

#[expect(clippy::disallowed_methods, reason = "how long a plan takes is real time")]
fn wall() -> Instant {
    Instant::now()
}

/// Where tasks are after this item.
fn task_states(item: &Item) -> impl Iterator<Item = TaskState> {
    let rows = item.rows.iter().filter(|row| row.key.table == Table::TaskState);
    rows.filter_map(|row| match &row.write {
        Write::Put { body, .. } => serde_json::from_str(body).ok(),
        Write::Delete | Write::Keep => None,
    })
}

#[async_trait]
impl Store for PlanLog {
    fn id(&self) -> &StoreId {
        self.store.id()
    }
    fn site_id(&self) -> &SiteId {
        self.store.site_id()
    }
    fn is_shared(&self) -> bool {
        self.store.is_shared()
    }
    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        self.note_plan(&items);
        let states: Vec<Vec<TaskState>> = items.iter().map(|item| task_states(item).collect()).collect();
        let results = self.store.commit(items).await;
        let now_ms = self.clock.elapsed_ms();
        for (result, states) in results.iter().zip(states) {
            match result {
                Ok(_) => states.iter().for_each(|state| self.records.note_state(state, now_ms)),
                Err(_) => self.lock().plans.items_lost += 1,
            }
        }
        results
    }
    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        self.store.get(keys).await
    }
    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        self.store.list(query).await
    }
    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        self.store.read(parts, named).await
    }
    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        if !self.turn.is_zero() {
            tokio::time::sleep(self.turn).await;
        }
        self.lock().read_at = Some(wall());
        self.store.feed(after, logs, limit).await
    }
    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.store.feed_of(subjects, after, limit).await
    }
    fn wake(&self) -> watch::Receiver<Seq> {
        self.wake.clone()
    }
    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        self.store.raise_head(at_least).await
    }
    async fn audit_heads(&self) -> Result<BTreeMap<Writer, Head>, Error> {
        self.store.audit_heads().await
    }
    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        self.store.prune(keep).await
    }
}
