//! Items: what is written as one atomic change, with its conditions and what it leaves in the audit.

use crate::audit::Note;
use crate::identity::{Actor, TokenId};
use crate::ids::RobotId;
use crate::limits;
use crate::reason::{self, Refusal};
use crate::rows::{Index, Key, Log, Record, Revision, Writer};
use std::sync::Arc;

/// What must be true of a row for its item to be applied.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Expect {
    /// There is none.
    Absent,
    /// It stands at this revision.
    At(Revision),
}

/// What happens to a row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Write {
    /// It becomes this.
    Put {
        /// Index columns.
        index: Index,
        /// What the row becomes, as JSON.
        body: Arc<str>,
    },
    /// It goes.
    Delete,
    /// It was relied upon and stays as it is.
    Keep,
}

/// One row of an item.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RowChange {
    /// Which row.
    pub key: Key,
    /// On what condition.
    pub expect: Expect,
    /// What is done.
    pub write: Write,
    /// What happened, for the log (`task.assigned`); shown by event lists and audits.
    pub kind: &'static str,
}

impl RowChange {
    /// Whether it leaves an entry in the log of its writer, in an item whose marks do ([`Item::tells_marks`]) or do not.
    pub fn is_told(&self, tells_marks: bool) -> bool {
        !matches!(self.write, Write::Keep) && (tells_marks || !self.key.table.is_mark())
    }
}

/// A fact that is not a row change: a robot's event in its inbox.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fact {
    /// Where it is kept.
    pub log: Log,
    /// What it is about (`robot_id` for the inbox).
    pub subject: Arc<str>,
    /// What happened.
    pub kind: &'static str,
    /// What is said of it, as JSON.
    pub body: Arc<str>,
}

/// All or nothing. Small on purpose: a plan is many items, so that one stale row costs one assignment and not the plan.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Item {
    /// Who writes.
    pub writer: Writer,
    /// On whose behalf: a principal, a robot, or the service itself.
    pub actor: Arc<str>,
    /// The token that was shown for it; none: none was. Stands in the audit beside the actor.
    pub token: Option<TokenId>,
    /// The request behind it, if any.
    pub request_id: Option<Arc<str>>,
    /// Rows with their conditions, each key at most once.
    pub rows: Vec<RowChange>,
    /// Facts beside the rows.
    pub facts: Vec<Fact>,
    /// What it leaves in the audit of its writer; none: nobody asked for it.
    pub note: Option<Box<Note>>,
    /// A robot that must not have been heard meanwhile.
    pub silent: Option<Silent>,
}

/// That no process has heard a robot since the newest heartbeats of all robots were read up to a position. Where only one process opens the
/// store, its own board is the whole truth and this asks nothing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Silent {
    /// Which robot.
    pub robot_id: RobotId,
    /// Position in the log of newest heartbeats that the decision knew; 0: nothing of it.
    pub position: u64,
}

impl Item {
    /// An empty item of `writer` on behalf of `actor`.
    pub fn new(writer: Writer, actor: impl Into<Actor>) -> Self {
        let actor = actor.into();
        Self {
            writer,
            token: actor.token().cloned(),
            actor: actor.name().clone(),
            request_id: None,
            rows: Vec::new(),
            facts: Vec::new(),
            note: None,
            silent: None,
        }
    }
    /// An item that says alone that something was refused as things are. None: what is wrong in form, or is about nothing
    /// that there is, is no decision.
    pub fn for_refusal(
        writer: Writer,
        actor: impl Into<Actor>,
        request_id: Option<&str>,
        note: Note,
        why: &Refusal,
    ) -> Option<Self> {
        let is_decision =
            matches!(why.kind(), reason::Kind::Precondition | reason::Kind::Conflict | reason::Kind::Denied);
        let mut item = Self::new(writer, actor);
        item.request_id = request_id.map(Into::into);
        item.audit(note.refused(why.reason.code));
        is_decision.then_some(item)
    }
    /// Creates a row.
    pub fn create<R: Record>(&mut self, record: &R, kind: &'static str) -> &mut Self {
        self.put_row(record, Expect::Absent, kind)
    }
    /// Changes a row that stands at `revision`.
    pub fn update<R: Record>(&mut self, record: &R, revision: Revision, kind: &'static str) -> &mut Self {
        self.put_row(record, Expect::At(revision), kind)
    }
    /// Creates or changes a row.
    pub fn put_row<R: Record>(&mut self, record: &R, expect: Expect, kind: &'static str) -> &mut Self {
        let write = Write::Put { index: record.index(), body: record.body() };
        self.rows.push(RowChange { key: record.key(), expect, write, kind });
        self
    }
    /// Guards a row that is only relied upon.
    pub fn keep_row(&mut self, key: Key, expect: Expect) -> &mut Self {
        self.rows.push(RowChange { key, expect, write: Write::Keep, kind: "" });
        self
    }
    /// Deletes a row that stands at `revision`.
    pub fn delete(&mut self, key: Key, revision: Revision, kind: &'static str) -> &mut Self {
        self.rows.push(RowChange { key, expect: Expect::At(revision), write: Write::Delete, kind });
        self
    }
    /// Leaves this in the audit.
    pub fn audit(&mut self, note: Note) -> &mut Self {
        self.note = Some(Box::new(note));
        self
    }
    /// Bytes that count against [`limits::GROUP_COMMIT_BYTES`]: row bodies, facts, ids.
    pub fn bytes(&self) -> usize {
        let rows = self.rows.iter().map(|r| {
            let body = if let Write::Put { body, .. } = &r.write { body.len() } else { 0 };
            body + r.key.id.len()
        });
        let facts = self.facts.iter().map(|f| f.body.len() + f.subject.len());
        rows.chain(facts).sum::<usize>() + self.note.as_ref().map_or(0, |note| note.bytes())
    }
    /// Whether it is larger than any store takes.
    pub fn is_too_large(&self) -> bool {
        self.rows.len() > limits::ITEM_ROWS_MAX
            || self.facts.len() > limits::ITEM_ROWS_MAX
            || self.bytes() > limits::GROUP_COMMIT_BYTES
    }
    /// Whether its marks leave entries. How far a service has read concerns nobody else, and the service reads it from the row: a mark leaves an entry
    /// where nothing else of the item does, so that whoever waits for it is woken.
    pub fn tells_marks(&self) -> bool {
        self.facts.is_empty() && !self.rows.iter().any(|row| row.is_told(false))
    }
    /// Whether it would change anything.
    pub fn is_empty(&self) -> bool {
        self.note.is_none() && self.facts.is_empty() && self.rows.iter().all(|r| matches!(r.write, Write::Keep))
    }
}
