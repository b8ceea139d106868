//! A store that counts what it hands out: what a call costs is how much it reads, whatever the machine.
//!
//! Uses nothing but `core`, `store` and tonic's `async_trait`, so that any crate's tests can include this file.

use midshift_core::audit::Head;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Key, Log, Naming, Row, RowSelection, Seq, Writer};
use midshift_store::{Applied, CommitError, Error, FeedPage, Query, Retention, Snapshot, Store, StoreId, Subjects};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use tokio::sync::watch;

/// A way to a store.
pub struct Counted {
    store: Arc<dyn Store>,
    /// Rows and entries that were handed out.
    read: AtomicUsize,
}

impl Counted {
    /// A way to `store` by which nothing was read yet.
    pub fn over(store: Arc<dyn Store>) -> Arc<Self> {
        Arc::new(Self { store, read: AtomicUsize::new(0) })
    }
    /// Rows and entries that were read this way since this was asked last.
    pub fn take_count(&self) -> usize {
        self.read.swap(0, Relaxed)
    }
    fn count<T>(&self, result: Result<T, Error>, size: impl Fn(&T) -> usize) -> Result<T, Error> {
        self.read.fetch_add(result.as_ref().map_or(0, size), Relaxed);
        result
    }
}

#[tonic::async_trait]
impl Store for Counted {
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
        self.store.commit(items).await
    }
    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        self.count(self.store.get(keys).await, Vec::len)
    }
    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        self.count(self.store.list(query).await, Vec::len)
    }
    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        self.count(self.store.read(parts, named).await, |snapshot| snapshot.rows.len())
    }
    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.count(self.store.feed(after, logs, limit).await, |page| page.entries.len())
    }
    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.count(self.store.feed_of(subjects, after, limit).await, |page| page.entries.len())
    }
    fn wake(&self) -> watch::Receiver<Seq> {
        self.store.wake()
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
