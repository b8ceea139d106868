//! The newest entries of all logs, in memory: readers who keep up never touch the file.
//!
//! Invariant: every entry after `from` up to `head` is here, in commit order. Only the writer adds, after its commit.

use crate::store::page_of;
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

fn bytes(entry: &Entry) -> usize {
    entry.body.as_ref().map_or(0, |b| b.len()) + entry.subject.len()
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::rows::{Index, Log, Revision};
    use std::sync::Arc;

    fn entry(seq: u64) -> Entry {
        Entry {
            seq: Seq(seq),
            log: Log::Fleet,
            table: None,
            subject: Arc::from("r1"),
            revision: Revision(0),
            index: Index::default(),
            body: None,
            kind: Arc::from("event"),
            actor: Arc::from("fleet"),
            request_id: None,
            at_unix_ms: 0,
        }
    }

    #[test]
    fn a_full_tail_answers_from_its_oldest_entry_on_and_sends_older_cursors_to_the_file() {
        let tail = Tail::new(Seq(100));
        let newest = 100 + ENTRIES_MAX as u64 + 5;
        tail.extend((101..=newest).map(entry).collect(), Seq(newest));
        assert_eq!(tail.page(Seq(104), 10, |_| true), None);
        let page = tail.page(Seq(105), 10, |_| true).expect("a page");
        let numbers: Vec<u64> = page.entries.iter().map(|e| e.seq.0).collect();
        assert_eq!((numbers, page.next), ((106..=115).collect(), Seq(115)));
        assert_eq!(tail.page(Seq(newest + 1), 10, |_| true), None, "only the file knows a number that came later");
        tail.restart(Seq(newest));
        assert_eq!(tail.page(Seq(105), 10, |_| true), None);
    }

    #[test]
    fn a_short_page_of_a_filter_leads_to_the_head() {
        let tail = Tail::new(Seq(0));
        tail.extend((1..=4).map(entry).collect(), Seq(4));
        let page = tail.page(Seq(0), 10, |e| e.seq.0 == 2).expect("a page");
        assert_eq!((page.entries.len(), page.next, page.head), (1, Seq(4), Seq(4)));
    }
}
