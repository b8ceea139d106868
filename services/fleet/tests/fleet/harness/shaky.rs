//! A store that can be told to fail: what fleet sees when the disk is full or the connection is gone. It can also be told to be naive:
//! then the last writer wins.

use async_trait::async_trait;
use midshift_core::audit::Head;
use midshift_core::ids::SiteId;
use midshift_core::item::{Expect, Item};
use midshift_core::rows::{Key, Log, Naming, Row, RowSelection, Seq, Table, Writer};
use midshift_store::{Applied, CommitError, Error, FeedPage, Query, Retention, Snapshot, Store, StoreId, Subjects};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::watch;

/// Items written over another's before the store is itself again.
const OVERWRITTEN_MAX: u64 = 40;

pub struct Shaky {
    inner: Arc<dyn Store>,
    failing: AtomicBool,
    failed: AtomicU64,
    blind: AtomicBool,
    overwritten: AtomicU64,
    conflicts: AtomicU64,
    /// Items that the store never takes.
    refused: AtomicU64,
    /// Whoever uses this handle stands still.
    frozen: watch::Sender<bool>,
    freezes: AtomicBool,
    outrun: Mutex<Option<Table>>,
    /// Items that touch this table are too large.
    narrow: Mutex<Option<Table>>,
    /// A reading of the projection takes so long.
    reads_for: Mutex<Duration>,
    /// A reading of the feed takes so long.
    feeds_for: Mutex<Duration>,
    /// The feed ends here.
    feeds_up_to: Mutex<Option<Seq>>,
    /// Rows and entries that were read through this handle.
    rows_read: AtomicU64,
    /// Whole projections that were read through this handle.
    projections_read: AtomicU64,
}

impl Shaky {
    pub fn over(inner: Arc<dyn Store>) -> Arc<Self> {
        Arc::new(Self {
            conflicts: AtomicU64::new(0),
            refused: AtomicU64::new(0),
            frozen: watch::Sender::new(false),
            freezes: AtomicBool::new(false),
            outrun: Mutex::new(None),
            narrow: Mutex::new(None),
            reads_for: Mutex::new(Duration::ZERO),
            feeds_for: Mutex::new(Duration::ZERO),
            feeds_up_to: Mutex::new(None),
            rows_read: AtomicU64::new(0),
            projections_read: AtomicU64::new(0),
            inner,
            failing: AtomicBool::new(false),
            failed: AtomicU64::new(0),
            blind: AtomicBool::new(false),
            overwritten: AtomicU64::new(0),
        })
    }
    /// From now on every commit through this handle fails, or none does.
    pub fn fail(&self, failing: bool) {
        self.failing.store(failing, Ordering::Relaxed);
    }
    /// From now on no call through this handle begins, or all go on that wait.
    pub fn freeze(&self, frozen: bool) {
        self.frozen.send_replace(frozen);
    }
    /// The next commit through this handle does not begin, and nothing after it.
    pub fn freeze_next_commit(&self) {
        self.freezes.store(true, Ordering::Relaxed);
    }
    pub fn is_frozen(&self) -> bool {
        *self.frozen.borrow()
    }
    /// From now on somebody else is always faster to write rows of this table.
    pub fn outrun(&self, table: Option<Table>) {
        *self.outrun.lock().expect("not poisoned") = table;
    }
    /// From now on a reading of the projection takes so long.
    pub fn read_for(&self, time: Duration) {
        *self.reads_for.lock().expect("not poisoned") = time;
    }
    /// From now on a reading of the feed takes so long.
    pub fn feed_for(&self, time: Duration) {
        *self.feeds_for.lock().expect("not poisoned") = time;
    }
    /// From now on the feed ends here for whoever reads it through this handle, or where it does.
    pub fn feed_up_to(&self, head: Option<Seq>) {
        *self.feeds_up_to.lock().expect("not poisoned") = head;
    }
    /// Rows and entries read through this handle since the last call.
    pub fn rows_read(&self) -> u64 {
        self.rows_read.swap(0, Ordering::Relaxed)
    }
    /// Whole projections read through this handle.
    pub fn projections_read(&self) -> u64 {
        self.projections_read.load(Ordering::Relaxed)
    }
    fn count(&self, rows: usize) {
        self.rows_read.fetch_add(rows as u64, Ordering::Relaxed);
    }
    async fn thaws(&self) {
        // The sender is here.
        let _ = self.frozen.subscribe().wait_for(|frozen| !*frozen).await;
    }
    /// From now on every item that touches `table` is too large for this store.
    pub fn refuse(&self, table: Option<Table>) {
        *self.narrow.lock().expect("not poisoned") = table;
    }
    /// From now on what an item expects of its rows is not asked.
    pub fn be_blind(&self) {
        self.blind.store(true, Ordering::Relaxed);
    }
    /// Items that were written over what somebody else had written.
    pub fn overwritten(&self) -> u64 {
        self.overwritten.load(Ordering::Relaxed)
    }
    /// Items that somebody else was faster than.
    pub fn conflicts(&self) -> u64 {
        self.conflicts.load(Ordering::Relaxed)
    }
    /// Items that the store will never take.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
    fn count_refused(&self, results: &[Result<Applied, CommitError>]) {
        let refused = results.iter().filter(|r| r.as_ref().is_err_and(CommitError::is_final)).count();
        self.refused.fetch_add(refused as u64, Ordering::Relaxed);
    }
    /// Commits an item over whatever is there.
    async fn overwrite(&self, mut item: Item) -> Result<Applied, CommitError> {
        loop {
            let result = self.inner.commit(vec![item.clone()]).await.pop();
            match result {
                Some(Err(CommitError::Conflict { key, found })) => {
                    self.overwritten.fetch_add(1, Ordering::Relaxed);
                    let row = item.rows.iter_mut().find(|r| r.key == key).expect("a row of the item");
                    row.expect = found.map_or(Expect::Absent, Expect::At);
                }
                Some(result) => return result,
                None => unreachable!("one result an item"),
            }
        }
    }
    /// Commits that failed.
    pub fn failed(&self) -> u64 {
        self.failed.load(Ordering::Relaxed)
    }
}

async fn takes(time: &Mutex<Duration>) {
    let time = *time.lock().expect("not poisoned");
    if !time.is_zero() {
        tokio::time::sleep(time).await;
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
    fn is_shared(&self) -> bool {
        self.inner.is_shared()
    }
    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        // A disk takes time, in which somebody else may plan on the same projection.
        tokio::task::yield_now().await;
        if !items.is_empty() && self.freezes.swap(false, Ordering::Relaxed) {
            self.freeze(true);
        }
        self.thaws().await;
        let outrun = *self.outrun.lock().expect("not poisoned");
        let rows = items.iter().flat_map(|item| &item.rows);
        if let Some(row) = rows.into_iter().find(|row| Some(row.key.table) == outrun) {
            self.conflicts.fetch_add(1, Ordering::Relaxed);
            return items.iter().map(|_| Err(CommitError::Conflict { key: row.key.clone(), found: None })).collect();
        }
        if self.failing.load(Ordering::Relaxed) && !items.is_empty() {
            self.failed.fetch_add(1, Ordering::Relaxed);
            let cause = || Arc::new(std::io::Error::other("the disk is full"));
            return items.iter().map(|_| Err(CommitError::Unavailable(cause()))).collect();
        }
        let narrow = *self.narrow.lock().expect("not poisoned");
        if let Some(table) = narrow.filter(|table| items.iter().any(|i| i.rows.iter().any(|r| r.key.table == *table))) {
            // One by one: what does not touch the table is written.
            let mut results = Vec::new();
            for item in items {
                let refused = item.rows.iter().any(|r| r.key.table == table);
                results.extend(if refused {
                    vec![Err(CommitError::TooLarge)]
                } else {
                    self.inner.commit(vec![item]).await
                });
            }
            self.count_refused(&results);
            return results;
        }
        // Two writers that never lose go on for ever; some dozen wrong rows are enough.
        if self.blind.load(Ordering::Relaxed) && self.overwritten() < OVERWRITTEN_MAX {
            let mut results = Vec::new();
            for item in items {
                results.push(self.overwrite(item).await);
            }
            return results;
        }
        let results = self.inner.commit(items).await;
        self.count_refused(&results);
        let lost = results.iter().filter(|r| matches!(r, Err(CommitError::Conflict { .. }))).count();
        self.conflicts.fetch_add(lost as u64, Ordering::Relaxed);
        results
    }
    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        self.thaws().await;
        let rows = self.inner.get(keys).await?;
        self.count(rows.len());
        Ok(rows)
    }
    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        let rows = self.inner.list(query).await?;
        self.count(rows.len());
        Ok(rows)
    }
    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        self.thaws().await;
        takes(&self.reads_for).await;
        let snapshot = self.inner.read(parts, named).await?;
        self.projections_read.fetch_add(1, Ordering::Relaxed);
        self.count(snapshot.rows.len());
        Ok(snapshot)
    }
    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.thaws().await;
        takes(&self.feeds_for).await;
        let mut page = self.inner.feed(after, logs, limit).await?;
        if let Some(head) = *self.feeds_up_to.lock().expect("not poisoned") {
            page.entries.retain(|entry| entry.seq <= head);
            (page.next, page.head) = (page.next.min(head), page.head.min(head));
        }
        self.count(page.entries.len());
        Ok(page)
    }
    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.inner.feed_of(subjects, after, limit).await
    }
    fn wake(&self) -> watch::Receiver<Seq> {
        self.inner.wake()
    }
    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        self.inner.raise_head(at_least).await
    }
    async fn audit_heads(&self) -> Result<BTreeMap<Writer, Head>, Error> {
        self.inner.audit_heads().await
    }
    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        self.inner.prune(keep).await
    }
}
