//! Decides which of many like events are worth a log line: the first few at once, then one line a minute with the count.
//!
//! Invariants:
//! 1. A line about one peer is written at most [`limits::FLOOD_LINES`] times and counted once in [`limits::FLOOD_COUNTED_EVERY`], however often it is due.
//! 2. Memory is bounded: beyond [`limits::FLOOD_PEERS_MAX`] peers that are remembered, further ones count as one for each line.
//! 3. Nothing is lost: each event is written or counted.

use crate::limits;
use crate::time::LinkTime;
use std::collections::BTreeMap;

/// How many events of one peer and line were written and left out since the last count.
#[derive(Clone, Copy, Debug)]
struct LineCounts {
    /// When they are counted next.
    until: LinkTime,
    /// Written since the last count.
    written: u32,
    /// Not written since then.
    left_out: u64,
}

/// Events that were not written, in the last minute.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Count<L> {
    /// Which line.
    pub line: L,
    /// Who caused them; none: many, more than are remembered.
    pub peer: Option<String>,
    /// How many.
    pub times: u64,
}

/// Events of all lines.
#[derive(Debug)]
pub struct Floods<L> {
    seen: BTreeMap<(L, Option<String>), LineCounts>,
}

impl<L> Default for Floods<L> {
    fn default() -> Self {
        Self { seen: BTreeMap::new() }
    }
}

impl<L: Ord + Clone> Floods<L> {
    /// Whether this event is written now. If not it is counted.
    pub fn is_written(&mut self, line: L, peer: String, now: LinkTime) -> bool {
        let mut key = (line, Some(peer));
        if self.seen.len() >= limits::FLOOD_PEERS_MAX && !self.seen.contains_key(&key) {
            key.1 = None;
        }
        let fresh = LineCounts { until: now + limits::FLOOD_COUNTED_EVERY, written: 0, left_out: 0 };
        let seen = self.seen.entry(key).or_insert(fresh);
        let is_written = seen.written < limits::FLOOD_LINES;
        if is_written {
            seen.written += 1;
        } else {
            seen.left_out += 1;
        }
        is_written
    }

    /// What is to be said now of events that were not written, by line and peer. Whoever has been quiet for a whole minute is forgotten.
    pub fn counts(&mut self, now: LinkTime) -> Vec<Count<L>> {
        let mut counts = Vec::new();
        self.seen.retain(|(line, peer), seen| {
            if seen.until > now {
                return true;
            }
            let is_quiet = seen.left_out == 0;
            if !is_quiet {
                counts.push(Count { line: line.clone(), peer: peer.clone(), times: seen.left_out });
            }
            // Written once more only by one that was quiet: a flood gets the count alone.
            (seen.until, seen.left_out) = (now + limits::FLOOD_COUNTED_EVERY, 0);
            !is_quiet
        });
        counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINUTE_MS: u64 = limits::FLOOD_COUNTED_EVERY.as_ms();

    fn count(line: &'static str, peer: Option<&str>, times: u64) -> Count<&'static str> {
        Count { line, peer: peer.map(str::to_owned), times }
    }

    /// How many of `times` events at that moment are written.
    fn written(floods: &mut Floods<&'static str>, line: &'static str, peer: &str, times: usize, ms: u64) -> usize {
        (0..times).filter(|_| floods.is_written(line, peer.to_owned(), LinkTime(ms))).count()
    }

    #[test]
    fn a_flood_is_written_at_once_and_then_counted_once_a_minute() {
        let (mut floods, at_once) = (Floods::default(), limits::FLOOD_LINES as usize);
        assert_eq!(written(&mut floods, "refused", "a", 1_000, 0), at_once);
        assert_eq!(floods.counts(LinkTime(MINUTE_MS - 1)), []);
        for minute in 1..=3_u64 {
            let expected = if minute == 1 { 1_000 - at_once as u64 } else { 500 };
            assert_eq!(floods.counts(LinkTime(minute * MINUTE_MS)), [count("refused", Some("a"), expected)]);
            assert_eq!(floods.counts(LinkTime(minute * MINUTE_MS)), []);
            assert_eq!(written(&mut floods, "refused", "a", 500, minute * MINUTE_MS + 1), 0, "it goes on");
        }
        assert_eq!(floods.counts(LinkTime(4 * MINUTE_MS)), [count("refused", Some("a"), 500)]);
        assert_eq!(floods.counts(LinkTime(5 * MINUTE_MS)), [], "quiet for a minute");
        assert_eq!(written(&mut floods, "refused", "a", 1, 5 * MINUTE_MS), 1, "and so heard at once");
    }

    #[test]
    fn another_peer_and_another_line_are_written_beside_a_flood() {
        let mut floods = Floods::default();
        written(&mut floods, "refused", "a", 1_000, 0);
        assert_eq!(written(&mut floods, "refused", "b", 1, 1), 1);
        assert_eq!(written(&mut floods, "denied", "a", 1, 1), 1);
    }

    #[test]
    fn what_happens_now_and_then_is_written_each_time() {
        let mut floods = Floods::default();
        for minute in 0..100_u64 {
            let now = minute * MINUTE_MS;
            assert_eq!(floods.counts(LinkTime(now)), []);
            assert_eq!(written(&mut floods, "refused", "a", 1, now), 1);
        }
    }

    #[test]
    fn a_flood_of_peers_is_one_flood_of_bounded_memory_and_loses_no_count() {
        let (mut floods, most) = (Floods::default(), limits::FLOOD_PEERS_MAX);
        let all = 10 * most;
        let lines: usize = (0..all).map(|n| written(&mut floods, "refused", &n.to_string(), 1, 0)).sum();
        assert_eq!(lines, most + limits::FLOOD_LINES as usize);
        assert_eq!(floods.seen.len(), most + 1);
        assert_eq!(written(&mut floods, "denied", "x", 1, 0), 1, "another line is still heard");
        let counts = floods.counts(LinkTime(MINUTE_MS));
        assert_eq!(counts, [count("refused", None, (all - lines) as u64)]);
    }
}
