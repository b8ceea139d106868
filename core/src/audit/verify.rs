//! Whether a chain is what was written: row for row, against heads that somebody kept, and over the lines of an export.
//!
//! Invariant: the first thing that is wrong is what is said; nothing behind it is believed. One row at a time is held in memory.

use super::chain::{AuditRow, id_of, index_of, link, open};
use super::note::{CUT, Head};
use crate::limits;
use crate::rows::{Revision, Row, Table};
use crate::time::Utc;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// What is wrong with a chain, named by the row that shows it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Broken {
    /// A row is not as it was written.
    #[error("row {n} was altered")]
    Altered {
        /// Number of the altered row in its chain, from 1.
        n: u64,
    },
    /// A row does not follow the one before it, each whole by itself.
    #[error("row {n} does not follow row {before}: one of them was altered", before = n - 1)]
    Unlinked {
        /// The later one.
        n: u64,
    },
    /// Another row stands where one belongs.
    #[error("row {expected} is not there, row {found} is in its place: rows were taken away, put in or moved")]
    Order {
        /// Which belongs there.
        expected: u64,
        /// Which is there.
        found: u64,
    },
    /// The chain begins behind its first row, and no row of it says that it was cut there.
    #[error("it begins with row {first}, and no row says that those before it were cut: they were taken away")]
    Beheaded {
        /// Its first row.
        first: u64,
    },
    /// It begins behind a row that somebody knows of and that was not old enough to go, whatever its own rows say of a cut.
    #[error("it begins with row {first}, and {by} has row {known}: only what is older than {days} days may be cut, and it was not, or nobody here can tell", days = limits::AUDIT_DAYS)]
    CutEarly {
        /// Its first row.
        first: u64,
        /// One that was there.
        known: u64,
        /// Who knows it.
        by: String,
    },
    /// Rows are gone that somebody knows of.
    #[error("it ends with row {last}, and {by} has row {known}: its end was taken away")]
    Truncated {
        /// The last that is there; 0: none is.
        last: u64,
        /// One that was there.
        known: u64,
        /// Who knows it.
        by: String,
    },
    /// A row holds together and is not the one that was there.
    #[error("row {n} is not the one that {by} has: it was written anew")]
    Rewritten {
        /// Number of the row in its chain, from 1.
        n: u64,
        /// Who has another.
        by: String,
    },
}

impl Broken {
    /// One word for it.
    pub const fn word(&self) -> &'static str {
        match self {
            Self::Altered { .. } => "ALTERED",
            Self::Unlinked { .. } => "UNLINKED",
            Self::Order { .. } => "ORDER",
            Self::Beheaded { .. } | Self::CutEarly { .. } => "BEHEADED",
            Self::Truncated { .. } => "TRUNCATED",
            Self::Rewritten { .. } => "REWRITTEN",
        }
    }
    /// The row that it names.
    pub const fn row(&self) -> u64 {
        match self {
            Self::Altered { n } | Self::Unlinked { n } | Self::Rewritten { n, .. } => *n,
            Self::Order { expected, .. } => *expected,
            Self::Beheaded { first } => *first,
            Self::Truncated { known, .. } | Self::CutEarly { known, .. } => *known,
        }
    }
}

/// A chain that holds together.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Verified {
    /// Its first row; above 1: older ones were cut. 0: it has none.
    pub first: u64,
    /// How many rows of it were verified.
    pub rows: u64,
    /// Its newest row.
    pub head: Head,
}

/// A row of a chain that somebody has noted down.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Mark {
    /// Whose chain.
    pub service: String,
    /// Which row, and its hash.
    pub head: Head,
    /// Who has it, for the text of an error.
    pub by: String,
    /// When the row that quotes it was committed, UTC of the wall, unix ms; none: a note of which nobody knows when it was taken.
    pub at_unix_ms: Option<i64>,
}

/// Where a chain begins and ends, and when it was cut there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Ends {
    /// Its first row; 0: it has none.
    pub first: u64,
    /// Its newest row; 0: it has none.
    pub last: u64,
    /// When its newest row of a cut was committed, unix ms; none: it has none.
    pub cut_unix_ms: Option<i64>,
    /// Now, for whoever verifies: nothing was cut later. Unix ms.
    pub now_unix_ms: i64,
}

impl Ends {
    /// What a mark below the first row says: it may be missing only if it was quoted so long before the cut that the row was old by then. Clocks of two
    /// processes that write rows may differ by an hour.
    fn missing(&self, mark: &Mark) -> Result<(), Broken> {
        const KEPT_MS: i64 = (limits::AUDIT_DAYS * 24 * 3_600_000).cast_signed();
        const CLOCKS_MS: i64 = 3_600_000;
        let cut = self.cut_unix_ms.map(|cut| cut.min(self.now_unix_ms));
        let was_old = cut.zip(mark.at_unix_ms).is_some_and(|(cut, at)| at < cut.saturating_sub(KEPT_MS) + CLOCKS_MS);
        let early = || Broken::CutEarly { first: self.first, known: mark.head.n, by: mark.by.clone() };
        if was_old { Ok(()) } else { Err(early()) }
    }
}

impl Mark {
    /// What the anchor in this line quotes; nothing if it is none.
    pub fn in_line(line: &str) -> Vec<Self> {
        // Most lines have no such field, and are not worth to be read twice.
        let row = line.contains("\"heads\"").then(|| AuditRow::read(line)).flatten();
        row.iter().flat_map(Self::quoted).collect()
    }
    /// Reads `service:n:hash`; none: it is not of that form.
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.splitn(3, ':');
        let (service, n, hash) = (parts.next()?, parts.next()?.parse().ok()?, parts.next()?);
        let is_hash = hash.len() == 64 && hash.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        let head = Head { n, hash: hash.to_owned() };
        (!service.is_empty() && is_hash).then(|| Self {
            service: service.to_owned(),
            head,
            by: "your note".to_owned(),
            at_unix_ms: None,
        })
    }
    /// What an anchor quotes.
    pub fn quoted(row: &AuditRow) -> impl Iterator<Item = Self> + '_ {
        let by = format!("row {} of {}", row.n, row.service);
        let quoted = row.heads.iter().filter(|(_, head)| head.n > 0);
        let at_unix_ms = Some(row.at_unix_ms);
        quoted.map(move |(service, head)| Self {
            service: service.clone(),
            head: head.clone(),
            by: by.clone(),
            at_unix_ms,
        })
    }
    /// Whether `body`, the row of this number, is the one noted down; none: there is none in a chain with these ends.
    ///
    /// # Errors
    /// It is not, or it should be there.
    pub fn hold(&self, body: Option<&str>, ends: Ends) -> Result<(), Broken> {
        let (n, by) = (self.head.n, || self.by.clone());
        match body {
            Some(body) if open(body).is_some_and(|row| row.hash == self.head.hash) => Ok(()),
            Some(_) => Err(Broken::Rewritten { n, by: by() }),
            None if n < ends.first => ends.missing(self),
            None if n > ends.last => Err(Broken::Truncated { last: ends.last, known: n, by: by() }),
            None => Err(Broken::Order { expected: n, found: n + 1 }),
        }
    }
}

/// A chain that is being read, from its oldest row on.
#[derive(Clone, Debug)]
pub struct Chain {
    service: String,
    /// Noted rows that have not been passed, by number.
    marks: BTreeMap<u64, BTreeSet<Mark>>,
    /// Where it begins, if not with row 1, until a row says that it was cut there.
    cut: Option<Head>,
    /// When it was.
    cut_unix_ms: Option<i64>,
    now: Utc,
    first: u64,
    rows: u64,
    head: Head,
}

impl Chain {
    /// Of `service`, to be held against what is noted of it. `now` is the time of whoever verifies: a cut that says that it is to come is none of later.
    pub fn new(service: &str, noted: impl IntoIterator<Item = Mark>, now: Utc) -> Self {
        let mut marks: BTreeMap<u64, BTreeSet<Mark>> = BTreeMap::new();
        for mark in noted.into_iter().filter(|mark| mark.service == service && mark.head.n > 0) {
            marks.entry(mark.head.n).or_default().insert(mark);
        }
        let (service, head) = (service.to_owned(), Head::default());
        Self { service, marks, cut: None, cut_unix_ms: None, now, first: 0, rows: 0, head }
    }

    /// Takes the next row as its table has it, and gives it back as it is read.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn take_row(&mut self, row: &Row) -> Result<AuditRow, Broken> {
        let read = self.append(&row.body)?;
        let index = index_of(read.n, &read.action);
        let is_kept = *row.key.id == id_of(read.n) && row.revision == Revision(1) && row.index == index;
        let is_own = Table::audit_named(&self.service) == Some(row.key.table);
        if is_kept && is_own { Ok(read) } else { Err(Broken::Altered { n: read.n }) }
    }

    /// Takes the next row by its body.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn append(&mut self, body: &str) -> Result<AuditRow, Broken> {
        let expected = self.head.n + 1;
        let named = |read: Option<&AuditRow>| match read {
            Some(read) if self.rows == 0 => read.n,
            _ => expected,
        };
        let read = AuditRow::read(body);
        let altered = Broken::Altered { n: named(read.as_ref()) };
        let (Some(read), Some(opened)) = (read, open(body)) else { return Err(altered) };
        if read.service != self.service || read.n == 0 {
            return Err(altered);
        }
        if self.rows > 0 && read.n != expected {
            return Err(Broken::Order { expected, found: read.n });
        }
        if link(opened.prev, &opened.said) != opened.hash {
            return Err(Broken::Altered { n: read.n });
        }
        if self.rows == 0 && read.n > 1 {
            self.cut = Some(Head { n: read.n - 1, hash: opened.prev.to_owned() });
        } else if opened.prev != self.head.hash {
            return Err(Broken::Unlinked { n: read.n });
        }
        if let Some(mark) =
            self.marks.remove(&read.n).and_then(|marks| marks.into_iter().find(|m| m.head.hash != opened.hash))
        {
            return Err(Broken::Rewritten { n: read.n, by: mark.by });
        }
        if read.action == CUT && read.cut.is_some() && read.cut == self.cut {
            (self.cut, self.cut_unix_ms) = (None, Some(read.at_unix_ms));
        }
        self.first = if self.rows == 0 { read.n } else { self.first };
        self.rows += 1;
        self.head = Head { n: read.n, hash: opened.hash.to_owned() };
        Ok(read)
    }

    /// The row that was taken last.
    pub fn head(&self) -> &Head {
        &self.head
    }

    /// Whether rows are noted down that have not come yet.
    fn has_more(&self) -> bool {
        self.marks.range(self.head.n + 1..).next().is_some()
    }

    /// After the last row. A row that was quoted long enough before it was cut is not asked for; one that a person noted is.
    ///
    /// # Errors
    /// What is wrong with the chain as a whole.
    pub fn finish(self) -> Result<Verified, Broken> {
        if self.cut.is_some() {
            return Err(Broken::Beheaded { first: self.first });
        }
        let (first, last) = (self.first, self.head.n);
        let ends = Ends { first, last, cut_unix_ms: self.cut_unix_ms, now_unix_ms: self.now.0 };
        self.marks.range(..first).flat_map(|(_, marks)| marks).try_for_each(|mark| ends.missing(mark))?;
        let beyond = self.marks.range(self.head.n + 1..).next_back().and_then(|(_, marks)| marks.first());
        if let Some(mark) = beyond {
            return Err(Broken::Truncated { last: self.head.n, known: mark.head.n, by: mark.by.clone() });
        }
        Ok(Verified { first: self.first, rows: self.rows, head: self.head })
    }
}

/// First line of an export: of what, and where its chains end.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Export {
    /// How the lines are laid out: `midshift-audit-1`.
    pub format: String,
    /// The site.
    pub site: String,
    /// Its store.
    pub store: String,
    /// When it was made, UTC of the wall, unix ms.
    pub at_unix_ms: i64,
    /// The newest row of each chain that is in it.
    pub heads: BTreeMap<String, Head>,
}

impl Export {
    /// What its first line says of its form.
    pub const FORMAT: &'static str = "midshift-audit-1";

    /// Reads a first line; none: it is no export of a form that this build knows.
    pub fn parse(line: &str) -> Option<Self> {
        serde_json::from_str(line).ok().filter(|export: &Self| export.format == Self::FORMAT)
    }
    /// Its heads, as noted rows.
    pub fn marks(&self) -> impl Iterator<Item = Mark> + '_ {
        let by = || "the first line of the export".to_owned();
        self.heads.iter().map(move |(service, head)| Mark {
            service: service.clone(),
            head: head.clone(),
            by: by(),
            at_unix_ms: None,
        })
    }
}

/// The chains of an export while its lines are read.
#[derive(Clone, Debug)]
pub struct Held {
    now: Utc,
    chains: BTreeMap<String, Chain>,
    verdicts: BTreeMap<String, Broken>,
}

impl Held {
    /// Of an export with this first line, to be held against rows noted elsewhere and quoted by the anchors in it; `now` is the
    /// time of whoever verifies.
    pub fn new(export: &Export, noted: &[Mark], now: Utc) -> Self {
        let names = export.heads.keys().chain(noted.iter().map(|mark| &mark.service));
        let marks: Vec<Mark> = export.marks().chain(noted.iter().cloned()).collect();
        let chain = |name: &String| (name.clone(), Chain::new(name, marks.iter().cloned(), now));
        Self { now, chains: names.map(chain).collect(), verdicts: BTreeMap::new() }
    }
    /// Takes a line behind the first. A chain is not read behind what is wrong with it.
    pub fn add_line(&mut self, line: &str) {
        let named = AuditRow::read(line).map(|row| row.service);
        // A line that cannot be read is of the first chain that has not ended: an export has them one after the other.
        let open = self.chains.iter().find(|(_, chain)| chain.has_more()).map(|(name, _)| name.clone());
        let Some(service) = named.or(open).or_else(|| self.chains.keys().next_back().cloned()) else { return };
        if self.verdicts.contains_key(&service) {
            return;
        }
        let chain = self.chains.entry(service.clone()).or_insert_with(|| Chain::new(&service, [], self.now));
        if let Err(broken) = chain.append(line) {
            self.verdicts.insert(service, broken);
        }
    }
    /// For each chain, what came out.
    pub fn finish(self) -> BTreeMap<String, Result<Verified, Broken>> {
        let mut verdicts: BTreeMap<_, _> =
            self.verdicts.into_iter().map(|(name, broken)| (name, Err(broken))).collect();
        for (name, chain) in self.chains {
            verdicts.entry(name).or_insert_with(|| chain.finish());
        }
        verdicts
    }
}
