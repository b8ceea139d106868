//! A store that can be told to fail: what fleet sees when the disk is full or the connection is gone.

use async_trait::async_trait;
use midshift_core::ids::SiteId;
use midshift_core::rows::{Item, Key, Log, Row, Seq, Table};
use midshift_store::{Applied, CommitError, Error, FeedPage, MemoryStore, Query, Retention, Snapshot, Store, StoreId};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use tokio::sync::watch;

pub struct Shaky {
    inner: Arc<MemoryStore>,
    failing: AtomicBool,
    failed: AtomicU64,
}

impl Shaky {
    pub fn over(inner: Arc<MemoryStore>) -> Arc<Self> {
        Arc::new(Self { inner, failing: AtomicBool::new(false), failed: AtomicU64::new(0) })
    }
    /// From now on every commit through this handle fails, or none does.
    pub fn fail(&self, failing: bool) {
        self.failing.store(failing, Ordering::Relaxed);
    }
    /// Commits that failed.
    pub fn failed(&self) -> u64 {
        self.failed.load(Ordering::Relaxed)
    }
}

#[async_trait]
impl Store for Shaky {
    fn id(&self) -> &StoreId {
        self.inner.id()
    }
    fn site_id(&self) -> &SiteId {
        self.inner.site_id()
    }
    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        if self.failing.load(Ordering::Relaxed) && !items.is_empty() {
            self.failed.fetch_add(1, Ordering::Relaxed);
            let cause = || Arc::new(std::io::Error::other("the disk is full"));
            return items.iter().map(|_| Err(CommitError::Unavailable(cause()))).collect();
        }
        self.inner.commit(items).await
    }
    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        self.inner.get(keys).await
    }
    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        self.inner.list(query).await
    }
    async fn snapshot(&self, tables: &[Table]) -> Result<Snapshot, Error> {
        self.inner.snapshot(tables).await
    }
    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.inner.feed(after, logs, limit).await
    }
    async fn feed_of(&self, log: Log, subjects: &[Arc<str>], after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.inner.feed_of(log, subjects, after, limit).await
    }
    fn wake(&self) -> watch::Receiver<Seq> {
        self.inner.wake()
    }
    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        self.inner.raise_head(at_least).await
    }
    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        self.inner.prune(keep).await
    }
}
