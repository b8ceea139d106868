//! One decision being written: rows go into one item and, at once, into the view, so that the next decision of the cycle sees them.
//!
//! Invariant: a row written twice in one decision stands in its item once, with the first expectation and the last body.

use super::view::{Rowed, View, Viewed};
use crate::rows::{Expect, Fact, Item, Key, Log, Revision, Row, RowChange, Table, Write, Writer};
use crate::time::Now;
use std::collections::BTreeMap;

/// A decision under way.
pub struct Tx<'a> {
    /// The picture it is made on.
    pub view: &'a mut View,
    /// When it is made.
    pub now: Now,
    item: Item,
    at: BTreeMap<Key, usize>,
}

impl<'a> Tx<'a> {
    /// Begins a decision on behalf of `actor`.
    pub fn new(view: &'a mut View, now: Now, actor: &str) -> Self {
        Self { view, now, item: Item::new(Writer::Fleet, actor), at: BTreeMap::new() }
    }
    /// Notes the request behind it.
    pub fn on_request(mut self, request_id: Option<&str>) -> Self {
        self.item.request_id = request_id.map(Into::into);
        self
    }
    /// Rows written so far.
    pub fn rows(&self) -> usize {
        self.item.rows.len()
    }
    /// Creates or changes a row.
    pub fn put<R: Viewed>(&mut self, record: R, kind: &'static str) {
        let key = record.key();
        let known = R::slot(self.view).get(&*key.id).map_or(Revision(0), |r| r.revision);
        let write = Write::Put { index: record.index(), body: record.body() };
        let revision = match self.note(key.clone(), known, write, kind) {
            Expect::Absent => Revision(1),
            Expect::At(known) => known.next(),
        };
        let old = R::slot(self.view).insert(key.id.to_string(), Rowed { revision, row: record });
        R::changed(self.view, &key.id, old.as_ref().map(|r| &r.row));
    }
    /// Guards a row that is only relied upon: if somebody else changes it first, this decision is not made.
    pub fn rely<R: Viewed>(&mut self, id: &str) {
        let key = Key::new(R::TABLE, id);
        if self.at.contains_key(&key) {
            return;
        }
        let known = R::slot(self.view).get(id).map(|r| r.revision);
        self.at.insert(key.clone(), self.item.rows.len());
        self.item.keep(key, known.map_or(Expect::Absent, Expect::At));
    }
    /// States a fact beside the rows.
    pub fn tell(&mut self, subject: &str, kind: &'static str, body: &impl serde::Serialize) {
        let body = serde_json::to_string(body).unwrap_or_else(|e| unreachable!("plain fields: {e}"));
        self.item.facts.push(Fact { log: Log::Fleet, subject: subject.into(), kind, body: body.into() });
    }
    /// Deletes a row, if there is one.
    pub fn delete<R: Viewed>(&mut self, id: &str, kind: &'static str) {
        let Some(old) = R::slot(self.view).remove(id) else { return };
        self.note(Key::new(R::TABLE, id), old.revision, Write::Delete, kind);
        R::changed(self.view, id, Some(&old.row));
    }
    /// Writes `write`, and says what the row is expected to be before this decision.
    fn note(&mut self, key: Key, known: Revision, write: Write, kind: &'static str) -> Expect {
        if let Some(&i) = self.at.get(&key) {
            let row = &mut self.item.rows[i];
            row.write = match (row.expect, write) {
                (Expect::Absent, Write::Delete) => Write::Keep,
                (_, write) => write,
            };
            row.kind = kind;
            return row.expect;
        }
        let expect = if known == Revision(0) { Expect::Absent } else { Expect::At(known) };
        self.at.insert(key.clone(), self.item.rows.len());
        self.item.rows.push(RowChange { key, expect, write, kind });
        expect
    }
    /// The item, if the decision changed anything. Attempts stand before all else in it: whoever follows the feed knows the attempt
    /// when the change of its task comes.
    pub fn finish(mut self) -> Option<Item> {
        self.item.rows.sort_by_key(|row| row.key.table != Table::Attempt);
        (!self.item.is_empty()).then_some(self.item)
    }
}

/// A row as `View::absorb` takes it, from an entry of a log.
pub fn row_of(entry: &crate::rows::Entry, table: Table) -> Option<Row> {
    let key = Key { table, id: entry.subject.clone() };
    entry.body.clone().map(|body| Row { key, revision: entry.revision, index: entry.index.clone(), body })
}
