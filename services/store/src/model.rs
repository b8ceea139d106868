//! The store as a plain value in memory: the reference that other engines are held against, and the store of `midshift dev`
//! and of the simulation.
//!
//! Invariant: synchronous and deterministic: no task, no file, no randomness; same calls, same clock readings, same answers.
//! Nothing survives the process.

use crate::audit::{AuditDrafts, Heads};
use crate::check::{After, decide, log_index};
use crate::gather::Gathered;
use crate::model_table::Rows;
use crate::store::Wanted;
use crate::{
    Applied, CommitError, Error, FEED_PAGE_MAX, FeedPage, GET_KEYS_MAX, Query, Retention, SEQ_PLAUSIBLE_MAX, Snapshot,
    Store, StoreId, Subjects,
};
use async_trait::async_trait;
use midshift_core::audit::Head;
use midshift_core::ids::SiteId;
use midshift_core::item::Item;
use midshift_core::rows::{Entry, Key, Log, Naming, Row, RowSelection, Seq, Table, Writer};
use midshift_core::time::Clock;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tokio::sync::watch;

/// Entries a log keeps unless told otherwise: about 200 MB for all four at 250 bytes an entry.
const LOG_ENTRIES_DEFAULT: usize = 200_000;

/// A [`Store`] in memory.
pub struct MemoryStore {
    id: StoreId,
    site_id: SiteId,
    clock: Arc<dyn Clock>,
    log_entries_max: usize,
    shared: bool,
    state: Mutex<State>,
    wake: watch::Sender<Seq>,
}

struct State {
    head: Seq,
    tables: BTreeMap<Table, Rows>,
    logs: [MemoryLog; Log::ALL.len()],
    chains: Heads,
    audit_drafts: AuditDrafts,
}

/// The entries of one log that were not pruned.
#[derive(Default)]
struct MemoryLog {
    entries: VecDeque<Entry>,
    /// Number of the newest entry that is gone.
    pruned: Seq,
}

impl MemoryLog {
    fn after(&self, after: Seq) -> impl Iterator<Item = &Entry> {
        self.entries.range(self.entries.partition_point(|e| e.seq <= after)..)
    }

    fn drop_oldest(&mut self) {
        if let Some(entry) = self.entries.pop_front() {
            self.pruned = entry.seq;
        }
    }
}

impl MemoryStore {
    /// An empty store whose numbers start at the clock's wall time now.
    pub fn new(site_id: SiteId, id: StoreId, clock: Arc<dyn Clock>) -> Self {
        let head = Seq(clock.now().wall.0.max(0).cast_unsigned());
        let (tables, logs, chains, audit_drafts) =
            (BTreeMap::new(), Default::default(), Heads::new(), AuditDrafts::default());
        let state = State { head, tables, logs, chains, audit_drafts };
        let wake = watch::Sender::new(head);
        Self { id, site_id, clock, log_entries_max: LOG_ENTRIES_DEFAULT, shared: false, state: Mutex::new(state), wake }
    }

    /// Keeps at most `entries` in each log instead of 200,000.
    #[must_use]
    pub fn with_log_entries_max(mut self, entries: usize) -> Self {
        self.log_entries_max = entries;
        self
    }

    /// Says of itself that it is shared: for tests of services that run several times.
    #[must_use]
    pub fn shared(mut self) -> Self {
        self.shared = true;
        self
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    fn apply(&mut self, item: Item, at_unix_ms: i64, log_entries_max: usize) -> Result<Applied, CommitError> {
        let decided = decide(item, self.head, at_unix_ms, |key| self.row(key).map(|row| row.revision))?;
        for after in decided.rows {
            match after {
                After::Row(row) => self.tables.entry(row.key.table).or_default().insert(row),
                After::Gone(key) => self.tables.entry(key.table).or_default().delete(&key.id),
            }
        }
        for entry in decided.entries {
            let kept = &mut self.logs[log_index(entry.log)];
            kept.entries.push_back(entry);
            if kept.entries.len() > log_entries_max {
                kept.drop_oldest();
            }
        }
        self.head = decided.applied.seq;
        if let Some(draft) = decided.audited {
            self.audit_drafts.push(draft);
        }
        Ok(decided.applied)
    }

    /// After the last item of a call: the rows of the audit.
    fn seal(&mut self) {
        if self.audit_drafts.is_empty() {
            return;
        }
        let appended = std::mem::take(&mut self.audit_drafts).append_to(&mut self.chains);
        for row in appended.rows {
            self.tables.entry(row.key.table).or_default().insert(row);
        }
        for (table, up_to) in appended.cuts {
            self.tables.entry(table).or_default().delete_up_to(up_to.cast_signed());
        }
    }

    fn row(&self, key: &Key) -> Option<&Row> {
        self.tables.get(&key.table)?.get(&key.id)
    }

    fn page(&self, after: Seq, wanted: &Wanted, limit: usize) -> Result<FeedPage, Error> {
        let logs: BTreeSet<usize> = wanted.logs.iter().map(|log| log_index(*log)).collect();
        let oldest = logs.iter().map(|log| self.logs[*log].pruned).max().unwrap_or_default();
        if after < oldest || after > self.head {
            return Err(Error::CursorExpired { asked: after, oldest });
        }
        let limit = limit.clamp(1, FEED_PAGE_MAX);
        let mut entries: Vec<&Entry> = Vec::new();
        for log in logs {
            entries.extend(self.logs[log].after(after).filter(|e| wanted.holds(e)).take(limit));
        }
        entries.sort_unstable_by_key(|e| e.seq);
        entries.truncate(limit);
        let next = if entries.len() < limit { self.head } else { entries[limit - 1].seq };
        Ok(FeedPage { entries: entries.into_iter().cloned().collect(), next, head: self.head })
    }
}

#[async_trait]
impl Store for MemoryStore {
    fn id(&self) -> &StoreId {
        &self.id
    }

    fn site_id(&self) -> &SiteId {
        &self.site_id
    }

    fn is_shared(&self) -> bool {
        self.shared
    }

    async fn commit(&self, items: Vec<Item>) -> Vec<Result<Applied, CommitError>> {
        let at_unix_ms = self.clock.now().wall.0;
        let mut state = self.state();
        let before = state.head;
        let results = items.into_iter().map(|item| state.apply(item, at_unix_ms, self.log_entries_max)).collect();
        state.seal();
        if state.head > before {
            self.wake.send_replace(state.head);
        }
        results
    }

    async fn get(&self, keys: Vec<Key>) -> Result<Vec<Row>, Error> {
        if keys.len() > GET_KEYS_MAX {
            return Err(Error::TooManyKeys { asked: keys.len() });
        }
        let state = self.state();
        Ok(keys.iter().filter_map(|key| state.row(key).cloned()).collect())
    }

    async fn list(&self, query: Query) -> Result<Vec<Row>, Error> {
        Ok(self.state().tables.get(&query.table).map_or_else(Vec::new, |rows| rows.list(&query)))
    }

    async fn read(&self, parts: &[RowSelection], named: Naming) -> Result<Snapshot, Error> {
        let state = self.state();
        let mut gathered = Gathered::new(parts, named);
        for part in parts {
            match part {
                RowSelection::Whole(table) => {
                    gathered.add(state.tables.get(table).into_iter().flat_map(Rows::iter).cloned())
                }
                RowSelection::InStates(table, states) => {
                    gathered.add(state.tables.get(table).into_iter().flat_map(|rows| rows.in_states(states)).cloned());
                }
                RowSelection::Rows(_) | RowSelection::OfParents { .. } => {}
            }
        }
        loop {
            let parents = gathered.parents();
            let is_whole = parents.is_empty();
            for (table, parent) in parents {
                let rows = state.tables.get(&table).into_iter().flat_map(|rows| rows.of_parent(&parent));
                gathered.add(rows.cloned());
            }
            let missing = gathered.missing();
            if missing.is_empty() && is_whole {
                return Ok(gathered.at(state.head));
            }
            let rows = missing.iter().filter_map(|key| state.tables.get(&key.table)?.get(&key.id));
            gathered.add(rows.cloned());
        }
    }

    async fn feed(&self, after: Seq, logs: &[Log], limit: usize) -> Result<FeedPage, Error> {
        self.state().page(after, &Wanted::from_logs(logs), limit)
    }

    async fn feed_of(&self, subjects: Subjects<'_>, after: Seq, limit: usize) -> Result<FeedPage, Error> {
        self.state().page(after, &Wanted::from_subjects(subjects)?, limit)
    }

    fn wake(&self) -> watch::Receiver<Seq> {
        self.wake.subscribe()
    }

    async fn raise_head(&self, at_least: Seq) -> Result<Seq, Error> {
        if at_least > SEQ_PLAUSIBLE_MAX {
            return Err(Error::ImplausibleSeq { asked: at_least });
        }
        let mut state = self.state();
        if at_least > state.head {
            state.head = at_least;
            self.wake.send_replace(state.head);
        }
        Ok(state.head)
    }

    async fn audit_heads(&self) -> Result<BTreeMap<Writer, Head>, Error> {
        Ok(self.state().chains.clone())
    }

    async fn prune(&self, keep: Retention) -> Result<u64, Error> {
        let mut state = self.state();
        let mut gone = 0;
        for kept in &mut state.logs {
            while let Some(oldest) = kept.entries.front() {
                let old = oldest.at_unix_ms < keep.before_unix_ms || kept.entries.len() as u64 > keep.entries_max;
                if !old || oldest.seq > keep.floor {
                    break;
                }
                kept.drop_oldest();
                gone += 1;
            }
        }
        Ok(gone)
    }
}
