//! Elects the one process of a service that plans: it renews a lease row, and the other processes watch that row.
//!
//! Called by the reconcilers of fleet and of roll-outs. Invariants:
//! 1. The clocks of two machines are never compared. The leader counts from before its renewal; a standby counts from
//!    when it saw that renewal. The leader's count is the shorter one, so it stops before a standby takes over.
//! 2. Two processes that lead at once still write nothing twice, since every item expects revisions. The lease only
//!    saves them from planning in vain.

use crate::item::{Expect, Item};
use crate::limits;
use crate::rows::{BadRow, Entry, Key, Record, Revision, Row, Table, body_is_json};
use crate::time::LinkTime;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::marker::PhantomData;

/// The one row of a service's lease.
pub trait LeaderRow: Record {
    /// Of `holder`, at its number `beat`.
    fn new(holder: String, beat: u64) -> Self;
    /// Id of the process that leads; empty: none does.
    fn holder(&self) -> &str;
    /// Rises with every write.
    fn beat(&self) -> u64;
}

macro_rules! leader_rows {
    ($($(#[$doc:meta])* $row:ident $table:ident $id:literal;)*) => { $(
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
        pub struct $row {
            /// Id of the process, drawn at its start; empty: nobody leads.
            pub holder: String,
            /// Rises with every write of the row: whoever watches sees that the holder is there.
            pub beat: u64,
        }

        impl Record for $row {
            const TABLE: Table = Table::$table;
            body_is_json!();
            fn id(&self) -> String {
                $id.to_owned()
            }
        }

        impl LeaderRow for $row {
            fn new(holder: String, beat: u64) -> Self {
                Self { holder, beat }
            }
            fn holder(&self) -> &str {
                &self.holder
            }
            fn beat(&self) -> u64 {
                self.beat
            }
        }
    )* };
}

leader_rows! {
    /// Which process of fleet plans.
    FleetLeader FleetLeader "fleet";
    /// Which process of the rollout service plans and signs.
    OtaLeader OtaLeader "ota";
}

/// Says whether other processes may contend for the lease.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Contenders {
    /// The store opens for one process: whoever holds the row when this one starts is dead.
    None,
    /// Other processes on the same store.
    Some,
    /// Naive: everybody leads and nobody asks.
    Ignored,
}

/// What a process does about its lease at this moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeaseAction {
    /// It leads, and the row needs no write.
    Lead,
    /// It leads, and writes the row again.
    Renew,
    /// Another one leads.
    StandBy,
    /// Nobody leads: it writes itself into the row, and leads once that is committed.
    TakeOver,
    /// It led, and does not any more: it decides nothing before it has read the row again.
    StepDown,
}

/// The role that a process believes it has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LeaderRole {
    /// It leads. Since when its newest claim counts: a reading of its link clock from before that was committed.
    Leads(LinkTime),
    /// It does not.
    StandsBy,
}

/// The lease row as a process has observed it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ObservedLease {
    /// Who holds it; empty: nobody, or there is no row.
    pub holder: String,
    /// Its number.
    pub beat: u64,
    /// Its revision; 0: there is no row.
    pub revision: Revision,
    /// When this revision was seen first, on the link clock of whoever saw it.
    pub since: LinkTime,
    /// It has stood like this since before the process looked for the first time.
    pub from_before: bool,
}

/// Decides what the process `own_id` does about the lease at `now`.
pub fn decide(
    own_id: &str,
    role: LeaderRole,
    seen: &ObservedLease,
    contenders: Contenders,
    now: LinkTime,
) -> LeaseAction {
    let mine = seen.holder == own_id;
    match (role, contenders) {
        (_, Contenders::Ignored) => LeaseAction::Lead,
        (LeaderRole::Leads(_), _) if !mine => LeaseAction::StepDown,
        (LeaderRole::Leads(_), Contenders::None) => LeaseAction::Lead,
        (LeaderRole::Leads(renewed), Contenders::Some) => match now.since(renewed) {
            age if age >= limits::LEAD_ENDS_AFTER => LeaseAction::StepDown,
            age if age >= limits::LEAD_RENEWED_EVERY => LeaseAction::Renew,
            _ => LeaseAction::Lead,
        },
        (LeaderRole::StandsBy, _) if mine || seen.holder.is_empty() => LeaseAction::TakeOver,
        (LeaderRole::StandsBy, Contenders::None) if seen.from_before => LeaseAction::TakeOver,
        (LeaderRole::StandsBy, Contenders::Some) if now.since(seen.since) >= limits::LEAD_FREE_AFTER => {
            LeaseAction::TakeOver
        }
        (LeaderRole::StandsBy, _) => LeaseAction::StandBy,
    }
}

/// The leader lease as one process sees it: the row that it read last, and whether it leads.
#[derive(Clone, Debug)]
pub struct LeaderLease<R> {
    own_id: String,
    contenders: Contenders,
    role: LeaderRole,
    seen: Option<ObservedLease>,
    row: PhantomData<R>,
}

impl<R: LeaderRow> LeaderLease<R> {
    /// The lease as the process `own_id` sees it, which has read nothing yet.
    pub const fn new(own_id: String, contenders: Contenders) -> Self {
        Self { own_id, contenders, role: LeaderRole::StandsBy, seen: None, row: PhantomData }
    }
    /// Name of the row.
    pub fn key() -> Key {
        R::new(String::new(), 0).key()
    }
    /// Whether this process decides.
    pub fn leads(&self) -> bool {
        matches!(self.role, LeaderRole::Leads(_)) || self.contenders == Contenders::Ignored
    }
    /// Takes the row as it was read at `now`; none: there is no row.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn read(&mut self, row: Option<&Row>, now: LinkTime) -> Result<(), BadRow> {
        let Some(row) = row else {
            if self.seen.is_none() {
                let nobody = String::new();
                self.seen = Some(ObservedLease {
                    holder: nobody,
                    beat: 0,
                    revision: Revision(0),
                    since: now,
                    from_before: true,
                });
            }
            return Ok(());
        };
        let from_before = self.seen.is_none();
        if self.seen.as_ref().is_some_and(|seen| seen.revision >= row.revision) {
            return Ok(());
        }
        let (decoded, revision) = (row.decode::<R>()?, row.revision);
        let (holder, beat) = (decoded.holder().to_owned(), decoded.beat());
        self.seen = Some(ObservedLease { holder, beat, revision, since: now, from_before });
        Ok(())
    }
    /// Takes what the feed says of the row.
    ///
    /// # Errors
    /// A row that cannot be read.
    pub fn follow(&mut self, entries: &[Entry], now: LinkTime) -> Result<(), BadRow> {
        let of_row = entries.iter().filter(|e| e.table == Some(R::TABLE));
        // An older one says only what the newest overtook.
        let newest = of_row.max_by_key(|e| e.revision).and_then(|e| crate::projection::row_of(e, R::TABLE));
        newest.map_or(Ok(()), |row| self.read(Some(&row), now))
    }
    /// What to do at `now`. Before the row was read nobody leads.
    pub fn next_action(&self, now: LinkTime) -> LeaseAction {
        match &self.seen {
            Some(seen) => decide(&self.own_id, self.role, seen, self.contenders, now),
            None if self.contenders == Contenders::Ignored => LeaseAction::Lead,
            None => LeaseAction::StandBy,
        }
    }
    /// The item that takes over or renews. It conflicts if anybody else wrote the row since it was seen.
    pub fn claim(&self) -> Item {
        self.write(self.own_id.clone(), if self.leads() { "lead.renewed" } else { "lead.taken" })
    }
    /// The claim that was made from a reading of the clock at `at` is committed.
    pub fn claimed(&mut self, at: LinkTime) {
        let seen = self.seen.as_ref();
        let (revision, beat) = seen.map_or((Revision(0), 0), |s| (s.revision, s.beat));
        let (revision, beat) = (revision.next(), beat + 1);
        self.seen = Some(ObservedLease { holder: self.own_id.clone(), beat, revision, since: at, from_before: false });
        self.role = LeaderRole::Leads(at);
    }
    /// The item that lets another one lead at once; none: this process does not lead, or there is no other.
    pub fn release(&self) -> Option<Item> {
        (matches!(self.role, LeaderRole::Leads(_)) && self.contenders == Contenders::Some)
            .then(|| self.write(String::new(), "lead.left"))
    }
    /// It does not lead any more.
    pub const fn step_down(&mut self) {
        self.role = LeaderRole::StandsBy;
    }
    fn write(&self, holder: String, kind: &'static str) -> Item {
        let (beat, revision) = self.seen.as_ref().map_or((0, Revision(0)), |s| (s.beat, s.revision));
        let writer = R::TABLE.writer();
        let mut item = Item::new(writer, writer.as_str());
        let expect = if revision == Revision(0) { Expect::Absent } else { Expect::At(revision) };
        item.put_row(&R::new(holder, beat + 1), expect, kind);
        item
    }
}

/// Remembers which entries of a service's log this process wrote: all others are another process' own.
#[derive(Debug, Default)]
pub struct OwnEntries {
    /// First and last number of each item, rising.
    ranges: VecDeque<(u64, u64)>,
}

impl OwnEntries {
    /// An item of so many entries was applied, the last of which is `last`.
    pub fn wrote(&mut self, last: u64, entries: u64) {
        if entries > 0 {
            self.ranges.push_back((last.saturating_sub(entries - 1), last));
        }
    }
    /// Whether the entry is this process' own. Asked in the order of the feed.
    pub fn is_own(&mut self, seq: u64) -> bool {
        while self.ranges.front().is_some_and(|(_, last)| *last < seq) {
            self.ranges.pop_front();
        }
        self.ranges.front().is_some_and(|(first, _)| *first <= seq)
    }
    /// Forgets everything: what is read again counts as another's.
    pub fn clear(&mut self) {
        self.ranges.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::LinkDuration;

    fn seen(holder: &str, since: u64, from_before: bool) -> ObservedLease {
        ObservedLease { holder: holder.to_owned(), beat: 7, revision: Revision(7), since: LinkTime(since), from_before }
    }

    #[test]
    fn the_table_of_the_lease() {
        use LeaseAction::{Lead, Renew, StandBy, StepDown, TakeOver};
        let table: &[(&str, LeaderRole, ObservedLease, Contenders, u64, LeaseAction)] = &[
            ("no row", LeaderRole::StandsBy, seen("", 0, true), Contenders::Some, 0, TakeOver),
            ("an empty row", LeaderRole::StandsBy, seen("", 900, false), Contenders::Some, 900, TakeOver),
            ("somebody leads", LeaderRole::StandsBy, seen("b", 0, true), Contenders::Some, 3_999, StandBy),
            ("somebody led", LeaderRole::StandsBy, seen("b", 0, true), Contenders::Some, 4_000, TakeOver),
            (
                "somebody led, seen late",
                LeaderRole::StandsBy,
                seen("b", 60_000, false),
                Contenders::Some,
                63_999,
                StandBy,
            ),
            ("a dead one's file", LeaderRole::StandsBy, seen("b", 0, true), Contenders::None, 0, TakeOver),
            (
                "taken by one that came later",
                LeaderRole::StandsBy,
                seen("b", 5, false),
                Contenders::None,
                99_999,
                StandBy,
            ),
            ("own, not led", LeaderRole::StandsBy, seen("a", 0, false), Contenders::Some, 1, TakeOver),
            ("renewed now", LeaderRole::Leads(LinkTime(0)), seen("a", 0, false), Contenders::Some, 999, Lead),
            (
                "renewed a second ago",
                LeaderRole::Leads(LinkTime(0)),
                seen("a", 0, false),
                Contenders::Some,
                1_000,
                Renew,
            ),
            (
                "not renewed in vain",
                LeaderRole::Leads(LinkTime(0)),
                seen("a", 0, false),
                Contenders::Some,
                2_999,
                Renew,
            ),
            ("could not renew", LeaderRole::Leads(LinkTime(0)), seen("a", 0, false), Contenders::Some, 3_000, StepDown),
            (
                "frozen for a minute",
                LeaderRole::Leads(LinkTime(0)),
                seen("a", 0, false),
                Contenders::Some,
                60_000,
                StepDown,
            ),
            (
                "taken over",
                LeaderRole::Leads(LinkTime(9_900)),
                seen("b", 9_950, false),
                Contenders::Some,
                9_950,
                StepDown,
            ),
            ("left by itself", LeaderRole::Leads(LinkTime(0)), seen("", 10, false), Contenders::Some, 10, StepDown),
            (
                "alone for an hour",
                LeaderRole::Leads(LinkTime(0)),
                seen("a", 0, false),
                Contenders::None,
                3_600_000,
                Lead,
            ),
            ("alone no more", LeaderRole::Leads(LinkTime(0)), seen("b", 5, false), Contenders::None, 5, StepDown),
            ("naive", LeaderRole::StandsBy, seen("b", 0, true), Contenders::Ignored, 0, Lead),
        ];
        for (what, role, seen, contenders, now, next_action) in table {
            assert_eq!(decide("a", *role, seen, *contenders, LinkTime(*now)), *next_action, "{what}");
        }
    }

    #[test]
    fn a_leader_stops_before_anybody_takes_over_though_one_clock_is_a_tenth_faster() {
        let LinkDuration(ends) = limits::LEAD_ENDS_AFTER;
        let LinkDuration(free) = limits::LEAD_FREE_AFTER;
        assert!(ends * 11 / 10 < free * 10 / 11, "{ends} {free}");
        assert!(limits::LEAD_RENEWED_EVERY < limits::LEAD_ENDS_AFTER);
    }

    fn row(item: &Item, revision: u64) -> Row {
        let crate::item::Write::Put { index, body } = item.rows[0].write.clone() else { panic!("no row") };
        Row { key: item.rows[0].key.clone(), revision: Revision(revision), index, body }
    }

    #[test]
    fn a_leader_frozen_for_a_minute_finds_another_one_in_its_place() {
        let mut a = LeaderLease::<FleetLeader>::new("a".to_owned(), Contenders::Some);
        let mut b = LeaderLease::<FleetLeader>::new("b".to_owned(), Contenders::Some);
        a.read(None, LinkTime(0)).expect("no row");
        assert_eq!(a.next_action(LinkTime(0)), LeaseAction::TakeOver);
        let first = a.claim();
        assert_eq!(first.rows[0].expect, Expect::Absent);
        a.claimed(LinkTime(0));
        // Another machine, another clock.
        b.read(Some(&row(&first, 1)), LinkTime(500_000)).expect("a row");
        assert_eq!(b.next_action(LinkTime(500_000)), LeaseAction::StandBy);
        let stale = a.claim();
        let second = b.claim();
        assert_eq!(
            (b.next_action(LinkTime(504_000)), second.rows[0].expect),
            (LeaseAction::TakeOver, Expect::At(Revision(1)))
        );
        b.claimed(LinkTime(504_000));
        assert_eq!(stale.rows[0].expect, Expect::At(Revision(1)), "what it wanted to write conflicts");
        assert_eq!(a.next_action(LinkTime(60_000)), LeaseAction::StepDown);
        a.step_down();
        a.read(Some(&row(&second, 2)), LinkTime(60_000)).expect("a row");
        assert_eq!(a.next_action(LinkTime(60_000)), LeaseAction::StandBy);
        // It leaves, and the other one need not wait.
        let left = b.release().expect("it leads");
        a.read(Some(&row(&left, 3)), LinkTime(60_001)).expect("a row");
        assert_eq!(a.next_action(LinkTime(60_001)), LeaseAction::TakeOver);
    }

    #[test]
    fn whoever_saw_an_older_revision_again_learns_nothing_from_it() {
        let mut a = LeaderLease::<OtaLeader>::new("a".to_owned(), Contenders::Some);
        a.read(None, LinkTime(0)).expect("no row");
        let first = row(&a.claim(), 1);
        a.claimed(LinkTime(1_000));
        a.read(Some(&first), LinkTime(1_500)).expect("its own");
        assert_eq!(a.next_action(LinkTime(1_900)), LeaseAction::Lead);
        assert_eq!(a.next_action(LinkTime(2_000)), LeaseAction::Renew);
    }

    #[test]
    fn what_another_process_wrote_between_two_items_is_told_apart() {
        let mut own = OwnEntries::default();
        own.wrote(12, 3);
        own.wrote(20, 1);
        own.wrote(20, 0);
        let asked: Vec<bool> = (9..=21).map(|seq| own.is_own(seq)).collect();
        let mine: Vec<u64> = (9..=21).zip(asked).filter(|(_, own)| *own).map(|(seq, _)| seq).collect();
        assert_eq!(mine, [10, 11, 12, 20]);
    }
}
