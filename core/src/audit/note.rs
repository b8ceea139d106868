//! What a decision leaves in the audit, and the head of a chain that some of them quote.

use crate::reason::Code;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// What stands before the first row of a chain.
pub const NOTHING: &str = "0000000000000000000000000000000000000000000000000000000000000000";
/// Action of a row that quotes the heads of the other chains.
pub const ANCHOR: &str = "audit.anchor";
/// Action of a row that says up to where the chain was cut, because those rows are old.
pub const CUT: &str = "audit.cut";

/// Number and hash of one row of a chain; of its newest one: its head.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Head {
    /// Number of the row, from 1. 0: there is none.
    pub n: u64,
    /// Its hash, 64 hexadecimal digits; [`NOTHING`] if there is none.
    pub hash: String,
}

impl Default for Head {
    fn default() -> Self {
        Self { n: 0, hash: NOTHING.to_owned() }
    }
}

/// `n:hash`, as it is noted down and given to `audit verify --head`.
impl fmt::Display for Head {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.n, self.hash)
    }
}

/// What a decision leaves in the audit, written in the item that carries it out. Who and when, and on which request, are the item's.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Note {
    /// Dotted word, such as `task.cancel`.
    pub action: &'static str,
    /// What it is about, as `robot:r7`: kind and id.
    pub about: Vec<String>,
    /// What else was asked for, such as a resolution.
    pub with: BTreeMap<&'static str, String>,
    /// Why, as the person said it; may be empty.
    pub reason: String,
    /// Why it was refused; none: it was done.
    pub refused: Option<Code>,
    /// For [`CUT`]: the newest row that goes.
    pub cut: Option<Head>,
    /// May stand in one row with others of its kind that are committed with it.
    pub crowd: Crowd,
}

/// Whether notes may share a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Crowd {
    /// It has a row of its own.
    Alone,
    /// Notes of one actor and one action that stand beside each other in one transaction share a row.
    Shared,
}

impl Note {
    /// That this was done.
    pub fn new(action: &'static str) -> Self {
        let (about, with, reason) = (Vec::new(), BTreeMap::new(), String::new());
        Self { action, about, with, reason, refused: None, cut: None, crowd: Crowd::Alone }
    }
    /// A row that quotes the heads of the other chains as they are when it is committed.
    pub fn anchor() -> Self {
        Self::new(ANCHOR)
    }
    /// Rows up to this one go with the item, because they are old.
    pub fn cut(up_to: Head) -> Self {
        Self { cut: Some(up_to), ..Self::new(CUT) }
    }
    /// It is also about this.
    #[must_use]
    pub fn about(mut self, kind: &str, id: impl fmt::Display) -> Self {
        self.about.push(format!("{kind}:{id}"));
        self
    }
    /// This was asked for too.
    #[must_use]
    pub fn with(mut self, name: &'static str, value: impl fmt::Display) -> Self {
        self.with.insert(name, value.to_string());
        self
    }
    /// Why, as the person said it.
    #[must_use]
    pub fn because(mut self, reason: impl Into<String>) -> Self {
        self.reason = reason.into();
        self
    }
    /// Many come at once, and one row may tell of them: each is about one thing and has the same fields as the others.
    #[must_use]
    pub fn shared(self) -> Self {
        Self { crowd: Crowd::Shared, ..self }
    }
    /// It was not done.
    #[must_use]
    pub fn refused(self, code: Code) -> Self {
        Self { refused: Some(code), ..self }
    }
    /// Bytes of its texts, about.
    pub fn bytes(&self) -> usize {
        let with: usize = self.with.iter().map(|(name, value)| name.len() + value.len()).sum();
        self.action.len() + self.reason.len() + with + self.about.iter().map(String::len).sum::<usize>()
    }
}
