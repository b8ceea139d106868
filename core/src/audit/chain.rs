//! Rows of a chain: how decisions become one, how its bytes are hashed and read back.

use super::note::{ANCHOR, CUT, Crowd, Head, Note};
use crate::identity::TokenId;
use crate::reason::Code;
use crate::rows::{Index, Key, Record, Revision, Row, Table, Writer, body_is_json};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

/// Outcome of what was done; what was refused has the code of its reason.
pub const DONE: &str = "DONE";
/// Digits of a hash.
const HASH_DIGITS: usize = 64;
/// Names of the last two fields of a row.
const PREV: &str = ",\"prev\":\"";
const HASH: &str = "\",\"hash\":\"";
const END: &str = "\"}";
/// Things that one shared row is about at most.
const CROWD_MAX: usize = 256;

/// What sets a row apart from a decision; kept beside it as its state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A decision of a person or program.
    Decision,
    /// It quotes the heads of the other chains.
    Anchor,
    /// It says up to where the chain was cut.
    Cut,
}

impl Kind {
    /// Its number in a list's filter.
    pub const fn number(self) -> i64 {
        match self {
            Self::Decision => 0,
            Self::Anchor => 1,
            Self::Cut => 2,
        }
    }
    /// Of a row with this action.
    pub fn from_action(action: &str) -> Self {
        match action {
            ANCHOR => Self::Anchor,
            CUT => Self::Cut,
            _ => Self::Decision,
        }
    }
}

/// On whose behalf a row is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attribution {
    /// The actor as it is named in rows: a person, a program, a robot or a service.
    pub actor: Arc<str>,
    /// The token that was shown; none: none was.
    pub token: Option<TokenId>,
    /// The request behind it.
    pub request_id: Option<Arc<str>>,
    /// UTC of the wall when committed, unix ms.
    pub at_unix_ms: i64,
}

/// What one row is going to say, while more may come to it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Draft {
    /// Whose chain.
    pub writer: Writer,
    /// What was done, about which things, and why.
    pub note: Box<Note>,
    /// On whose behalf.
    pub by: Attribution,
}

impl Draft {
    /// Takes another one into this row: values of a field stand side by side in the order of what they are about, with a space between them. Gives
    /// it back if it needs a row of its own.
    pub fn join(&mut self, other: Self) -> Option<Self> {
        let (note, theirs) = (&mut *self.note, &*other.note);
        let alike = note.crowd == Crowd::Shared
            && theirs.crowd == Crowd::Shared
            && (note.action, note.refused, &note.reason) == (theirs.action, theirs.refused, &theirs.reason)
            && note.with.keys().eq(theirs.with.keys())
            && (&self.by.actor, &self.by.token, self.by.at_unix_ms)
                == (&other.by.actor, &other.by.token, other.by.at_unix_ms)
            && self.by.request_id.is_some() == other.by.request_id.is_some()
            && note.about.len() + theirs.about.len() <= CROWD_MAX;
        if !alike {
            return Some(other);
        }
        for (value, more) in note.with.values_mut().zip(theirs.with.values()) {
            value.push(' ');
            value.push_str(more);
        }
        note.about.extend(other.note.about);
        if let (Some(known), Some(more)) = (&self.by.request_id, &other.by.request_id) {
            self.by.request_id = Some(format!("{known} {more}").into());
        }
        None
    }
}

/// One row of a chain as it is read. Of a newer release it may say more than this.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AuditRow {
    /// Whose chain.
    pub service: String,
    /// Its number, from 1.
    pub n: u64,
    /// UTC of the wall when committed, unix ms.
    pub at_unix_ms: i64,
    /// The actor that the action is counted for, by name.
    pub actor: String,
    /// Which token was shown; empty: none was, or an older release wrote the row.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub token_id: String,
    /// Dotted word.
    pub action: String,
    /// What it is about, as `robot:r7`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub about: Vec<String>,
    /// What else was asked for.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub with: BTreeMap<String, String>,
    /// The request behind it; empty: none was named. Of a row that tells of many: one for each thing that it is about, with a space between them.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub request_id: String,
    /// Why, as the person said it.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub reason: String,
    /// [`DONE`], or the code of the reason why not.
    pub outcome: String,
    /// Of an anchor: heads of the other chains.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub heads: BTreeMap<String, Head>,
    /// Of a cut: the newest row that went.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cut: Option<Head>,
    /// Hash of the row before.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub prev: String,
    /// Its own.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub hash: String,
}

impl AuditRow {
    /// The row with this body; none: it cannot be read.
    pub fn read(body: &str) -> Option<Self> {
        serde_json::from_str(body).ok()
    }
    /// Whether it is about `id`: of this kind, or of any if `id` is written without one.
    pub fn is_about(&self, wanted: &str) -> bool {
        let same = |about: &String| about == wanted || about.split_once(':').is_some_and(|(_, id)| id == wanted);
        self.about.iter().any(same)
    }
    /// Its number and hash.
    pub fn head(&self) -> Head {
        Head { n: self.n, hash: self.hash.clone() }
    }
}

/// A body taken apart: what is hashed, and what it says of the hashes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Opened<'a> {
    /// The bytes that are hashed after [`Opened::prev`]: the row without its last two fields.
    pub said: String,
    /// Hash of the row before.
    pub prev: &'a str,
    /// Its own, as it says.
    pub hash: &'a str,
}

/// Takes the body of a row apart; none: it is not of a row's form.
pub fn open(body: &str) -> Option<Opened<'_>> {
    let rest = body.strip_suffix(END)?;
    let (rest, hash) = rest.split_at_checked(rest.len().checked_sub(HASH_DIGITS)?)?;
    let rest = rest.strip_suffix(HASH)?;
    let (rest, prev) = rest.split_at_checked(rest.len().checked_sub(HASH_DIGITS)?)?;
    let said = rest.strip_suffix(PREV)?;
    Some(Opened { said: format!("{said}}}"), prev, hash })
}

/// SHA-256 over the hash before and what the row says, hexadecimal.
pub fn link(prev: &str, said: &str) -> String {
    let mut digest = Sha256::new();
    digest.update(prev.as_bytes());
    digest.update(said.as_bytes());
    digest.finalize().iter().fold(String::with_capacity(HASH_DIGITS), |mut hex, byte| {
        let _ = write!(hex, "{byte:02x}");
        hex
    })
}

/// Body and hash of what a row says behind `prev`. `said` is a JSON object with at least one field.
fn seal(prev: &str, said: &str) -> (String, String) {
    let hash = link(prev, said);
    let open = said.strip_suffix('}').unwrap_or(said);
    (format!("{open}{PREV}{prev}{HASH}{hash}{END}"), hash)
}

/// Id of row `n` within its table: ids are ordered as the numbers are.
pub fn id_of(n: u64) -> String {
    format!("{n:016}")
}

/// The next row of the chain of `writer`, and moves its head. None: this writer has no chain.
pub fn append(heads: &mut BTreeMap<Writer, Head>, writer: Writer, note: &Note, by: &Attribution) -> Option<Row> {
    let table = Table::audit_of(writer)?;
    let before = heads.get(&writer).cloned().unwrap_or_default();
    let others = heads.iter().filter(|(other, _)| **other != writer && note.action == ANCHOR);
    let row = AuditRow {
        service: writer.as_str().to_owned(),
        n: before.n + 1,
        at_unix_ms: by.at_unix_ms,
        actor: by.actor.to_string(),
        token_id: by.token.as_ref().map(ToString::to_string).unwrap_or_default(),
        action: note.action.to_owned(),
        about: note.about.clone(),
        with: note.with.iter().map(|(name, value)| ((*name).to_owned(), value.clone())).collect(),
        request_id: by.request_id.as_deref().unwrap_or_default().to_owned(),
        reason: note.reason.clone(),
        outcome: note.refused.map_or(DONE, Code::as_str).to_owned(),
        heads: others.map(|(other, head)| (other.as_str().to_owned(), head.clone())).collect(),
        cut: note.cut.clone(),
        prev: String::new(),
        hash: String::new(),
    };
    // A row holds only plain data, which serde_json cannot fail to write.
    let said = serde_json::to_string(&row).unwrap_or_else(|e| unreachable!("a row is not JSON: {e}"));
    let (body, hash) = seal(&before.hash, &said);
    heads.insert(writer, Head { n: row.n, hash });
    let index = index_of(row.n, &row.action);
    Some(Row { key: Key::new(table, id_of(row.n)), revision: Revision(1), index, body: body.into() })
}

pub(super) fn index_of(n: u64, action: &str) -> Index {
    Index { state: Some(Kind::from_action(action).number()), parent: None, order: Some(n.cast_signed()) }
}

macro_rules! chains {
    ($($(#[$doc:meta])* $row:ident $table:ident;)*) => { $(
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $row(pub AuditRow);

        impl Record for $row {
            const TABLE: Table = Table::$table;
            body_is_json!();
            fn id(&self) -> String {
                id_of(self.0.n)
            }
            fn index(&self) -> Index {
                index_of(self.0.n, &self.0.action)
            }
        }
    )* };
}

chains! {
    /// What people and programs asked of task intake.
    TaskAudit TaskAudit;
    /// What they decided about robots, places and areas.
    FleetAudit FleetAudit;
    /// What they decided about software.
    OtaAudit OtaAudit;
    /// Stops and resets, as they were copied.
    StopAudit StopAudit;
    /// What they decided about tokens and identities of robots.
    IdentityAudit IdentityAudit;
}

#[cfg(test)]
#[path = "tests.rs"]
mod tests;
