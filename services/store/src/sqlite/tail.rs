//! The newest entries of all logs, in memory: readers who keep up never touch the file.
//!
//! Invariant: every entry after `from` up to `head` is here, in commit order. Only the writer adds, after its commit.

use crate::{FEED_PAGE_MAX, FeedPage};
use midshift_core::rows::{Entry, Seq};
use std::collections::VecDeque;
use std::sync::{PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard};

/// Entries and bytes of bodies that are kept.
const ENTRIES_MAX: usize = 16_384;
const BYTES_MAX: usize = 32 * 1024 * 1024;

pub(super) struct Tail(RwLock<State>);

struct State {
    from: Seq,
    head: Seq,
    entries: VecDeque<Entry>,
    bytes: usize,
}

impl Tail {
    pub(super) fn new(head: Seq) -> Self {
        Self(RwLock::new(State { from: head, head, entries: VecDeque::new(), bytes: 0 }))
    }

    /// Starts again at `head`: what lies before it is read from the file.
    pub(super) fn restart(&self, head: Seq) {
        *self.write() = State { from: head, head, entries: VecDeque::new(), bytes: 0 };
    }

    pub(super) fn extend(&self, entries: Vec<Entry>, head: Seq) {
        let mut state = self.write();
        for entry in entries {
            state.bytes += bytes(&entry);
            state.entries.push_back(entry);
        }
        state.head = head;
        while state.entries.len() > ENTRIES_MAX || state.bytes > BYTES_MAX {
            let Some(oldest) = state.entries.pop_front() else { break };
            state.bytes -= bytes(&oldest);
            state.from = oldest.seq;
        }
    }

    /// The page after `after`, unless some of it must be read from the file.
    pub(super) fn page(&self, after: Seq, limit: usize, keep: impl Fn(&Entry) -> bool) -> Option<FeedPage> {
        let state = self.read();
        if after < state.from || after > state.head {
            return None;
        }
        let limit = limit.clamp(1, FEED_PAGE_MAX);
        let start = state.entries.partition_point(|e| e.seq <= after);
        let entries: Vec<Entry> = state.entries.range(start..).filter(|e| keep(e)).take(limit).cloned().collect();
        Some(page_of(entries, limit, state.head))
    }

    fn read(&self) -> RwLockReadGuard<'_, State> {
        self.0.read().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self) -> RwLockWriteGuard<'_, State> {
        self.0.write().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A page of at most `limit` entries; a short one means that there are no more up to `head`.
pub(super) fn page_of(mut entries: Vec<Entry>, limit: usize, head: Seq) -> FeedPage {
    entries.truncate(limit);
    let next = match entries.last() {
        Some(last) if entries.len() == limit => last.seq,
        _ => head,
    };
    FeedPage { entries, next, head }
}

fn bytes(entry: &Entry) -> usize {
    entry.body.as_ref().map_or(0, |b| b.len()) + entry.subject.len()
}
