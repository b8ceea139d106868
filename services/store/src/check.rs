//! Whether an item may be applied: limits, ownership, expectations. Pure; every implementation of the store asks here.
//!
//! Invariant: nothing here depends on the engine, so that all engines refuse the same items for the same reason.

use crate::CommitError;
use midshift_core::limits;
use midshift_core::rows::{Expect, Fact, Item, Key, Log, Revision, RowChange, Write};
use std::collections::BTreeSet;

/// Bytes that count against [`limits::GROUP_COMMIT_BYTES`]: row bodies, facts, ids.
pub(crate) fn item_bytes(item: &Item) -> usize {
    let rows = item.rows.iter().map(|r| {
        let body = if let Write::Put { body, .. } = &r.write { body.len() } else { 0 };
        body + r.key.id.len()
    });
    let facts = item.facts.iter().map(|f| f.body.len() + f.subject.len());
    rows.chain(facts).sum()
}

/// What can be said of an item without looking at any row.
pub(crate) fn form(item: &Item) -> Result<(), CommitError> {
    let over = item.rows.len() > limits::ITEM_ROWS_MAX
        || item.facts.len() > limits::ITEM_ROWS_MAX
        || item_bytes(item) > limits::GROUP_COMMIT_BYTES;
    if over {
        return Err(CommitError::TooLarge);
    }
    let mut keys = BTreeSet::new();
    for change in &item.rows {
        if !keys.insert(&change.key) {
            return Err(CommitError::DuplicateKey { key: change.key.clone() });
        }
        may_change(item, change)?;
    }
    item.facts.iter().try_for_each(|fact| may_state(item, fact))
}

fn may_change(item: &Item, change: &RowChange) -> Result<(), CommitError> {
    let table = change.key.table;
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

/// Whether every row stands as the item expects; `found` says where a row stands.
pub(crate) fn expectations(item: &Item, found: impl Fn(&Key) -> Option<Revision>) -> Result<(), CommitError> {
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

/// The revision that a change writes.
pub(crate) fn written(expect: Expect) -> Revision {
    match expect {
        Expect::Absent => Revision(1),
        Expect::At(revision) => revision.next(),
    }
}

/// Where a log stands in [`Log::ALL`].
pub(crate) fn log_index(log: Log) -> usize {
    match log {
        Log::Task => 0,
        Log::Fleet => 1,
        Log::Telemetry => 2,
        Log::RobotInbox => 3,
    }
}
