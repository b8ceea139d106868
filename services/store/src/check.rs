//! Whether an item may be applied: limits, ownership, expectations. Pure; every implementation of the store asks here.
//!
//! Invariant: nothing here depends on the engine, so that all engines refuse the same items for the same reason.

use crate::{Applied, CommitError, ID_BYTES_MAX};
use midshift_core::audit::{Attribution, Draft};
use midshift_core::item::{Expect, Fact, Item, RowChange, Write};
use midshift_core::rows::{Entry, Index, Key, Log, Revision, Row, Seq, Table};
use std::collections::BTreeSet;
use std::sync::Arc;

/// What can be said of an item without looking at any row.
fn form(item: &Item) -> Result<(), CommitError> {
    if item.is_too_large() {
        return Err(CommitError::TooLarge);
    }
    texts(item)?;
    let mut keys = BTreeSet::new();
    for change in &item.rows {
        if !keys.insert(&change.key) {
            return Err(CommitError::DuplicateKey { key: change.key.clone() });
        }
        may_change(item, change)?;
    }
    if item.note.is_some() && Table::audit_of(item.writer).is_none() {
        return Err(CommitError::NotTheWriter { writer: item.writer, owned: "an audit" });
    }
    item.facts.iter().try_for_each(|fact| may_state(item, fact))
}

/// Refuses text that one of the engines cannot hold: PostgreSQL has no NUL, and its indexes no long keys.
fn texts(item: &Item) -> Result<(), CommitError> {
    let bodies = item.facts.iter().map(|f| &f.body);
    let bodies = bodies
        .chain(item.rows.iter().filter_map(|r| if let Write::Put { body, .. } = &r.write { Some(body) } else { None }));
    let keyed = item.rows.iter().map(|r| &r.key.id).chain(item.facts.iter().map(|f| &f.subject));
    let parents = item
        .rows
        .iter()
        .filter_map(|r| if let Write::Put { index, .. } = &r.write { index.parent.as_ref() } else { None });
    let keyed = keyed.chain(parents).chain([&item.actor]).chain(&item.request_id);
    if keyed.clone().any(|text| text.len() > ID_BYTES_MAX) {
        return Err(CommitError::TooLarge);
    }
    if keyed.chain(bodies).any(|text| text.as_bytes().contains(&0)) {
        return Err(CommitError::NulByte);
    }
    Ok(())
}

fn may_change(item: &Item, change: &RowChange) -> Result<(), CommitError> {
    let table = change.key.table;
    if table.is_audit() {
        // Rows of an audit come from notes alone.
        return Err(CommitError::NotTheWriter { writer: item.writer, owned: table.name() });
    }
    let owner = match (&change.write, change.expect) {
        (Write::Keep, _) => return Ok(()),
        (Write::Put { .. }, Expect::Absent) => table.born_by(),
        (Write::Put { .. }, Expect::At(_)) | (Write::Delete, _) => table.writer(),
    };
    if owner == item.writer {
        return Ok(());
    }
    Err(CommitError::NotTheWriter { writer: item.writer, owned: table.name() })
}

fn may_state(item: &Item, fact: &Fact) -> Result<(), CommitError> {
    if fact.log.writer() == item.writer {
        return Ok(());
    }
    Err(CommitError::NotTheWriter { writer: item.writer, owned: fact.log.name() })
}

/// What a row becomes.
#[derive(Clone, Debug)]
pub(crate) enum After {
    /// It stands.
    Row(Row),
    /// There is none.
    Gone(Key),
}

/// What an item does once it is taken.
#[derive(Debug)]
pub(crate) struct Decided {
    /// Each row that changes.
    pub(crate) rows: Vec<After>,
    /// Its entries, numbered from the head given.
    pub(crate) entries: Vec<Entry>,
    /// What it leaves in the audit.
    pub(crate) audited: Option<Draft>,
    /// The answer.
    pub(crate) applied: Applied,
}

/// Judges one item against where the rows stand (`found`) and says what it does. `head` is the newest number given so far.
pub(crate) fn decide(
    item: Item,
    head: Seq,
    at_unix_ms: i64,
    found: impl Fn(&Key) -> Option<Revision>,
) -> Result<Decided, CommitError> {
    form(&item)?;
    expectations(&item, found)?;
    let tells_marks = item.tells_marks();
    let Item { writer, actor, token, request_id, rows, facts, note, silent: _ } = item;
    let by = Attribution { actor: actor.clone(), token, request_id: request_id.clone(), at_unix_ms };
    let audited = note.map(|note| Draft { writer, note, by });
    let applied = Applied { seq: head, revisions: Vec::new() };
    let mut decided = Decided { rows: Vec::new(), entries: Vec::new(), audited, applied };
    let entry = |seq: &mut Seq, log, subject, kind: &str, body| {
        *seq = Seq(seq.0 + 1);
        Entry {
            seq: *seq,
            log,
            table: None,
            subject,
            revision: Revision(0),
            index: Index::default(),
            body,
            kind: Arc::from(kind),
            actor: actor.clone(),
            request_id: request_id.clone(),
            at_unix_ms,
        }
    };
    let seq = &mut decided.applied.seq;
    for change in rows {
        let is_told = change.is_told(tells_marks);
        let RowChange { key, expect, write, kind } = change;
        let revision = match expect {
            Expect::Absent => Revision(1),
            Expect::At(revision) => revision.next(),
        };
        let (index, body) = match write {
            Write::Keep => continue,
            Write::Put { index, body } => (index, Some(body)),
            Write::Delete => (Index::default(), None),
        };
        if is_told {
            let entry = entry(seq, Log::of_writer(writer), key.id.clone(), kind, body.clone());
            decided.entries.push(Entry { table: Some(key.table), revision, index: index.clone(), ..entry });
        }
        match body {
            Some(body) => {
                decided.applied.revisions.push((key.clone(), revision));
                decided.rows.push(After::Row(Row { key, revision, index, body }));
            }
            None => decided.rows.push(After::Gone(key)),
        }
    }
    for Fact { log, subject, kind, body } in facts {
        decided.entries.push(entry(seq, log, subject, kind, Some(body)));
    }
    Ok(decided)
}

fn expectations(item: &Item, found: impl Fn(&Key) -> Option<Revision>) -> Result<(), CommitError> {
    for change in &item.rows {
        let found = found(&change.key);
        let holds = match change.expect {
            // Deleting what is expected to be absent says nothing that could be done.
            Expect::Absent => found.is_none() && change.write != Write::Delete,
            Expect::At(revision) => found == Some(revision),
        };
        if !holds {
            return Err(CommitError::Conflict { key: change.key.clone(), found });
        }
    }
    Ok(())
}

/// Where a log stands in [`Log::ALL`].
pub(crate) fn log_index(log: Log) -> usize {
    match log {
        Log::Task => 0,
        Log::Fleet => 1,
        Log::Telemetry => 2,
        Log::RobotInbox => 3,
        Log::Ota => 4,
        Log::Stop => 5,
        Log::Identity => 6,
    }
}
