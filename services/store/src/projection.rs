//! A service's view of some tables, kept in memory: built from a snapshot at start and carried forward by the feed.
//!
//! Invariant: carried forward or built anew, a projection is the same (`tests/store/projection.rs`). It never writes.
//! Called by the reconcilers; a fold turns rows into whatever shape their planner reads.

use crate::{Error, FEED_PAGE_MAX, Store, StoreId};
use midshift_core::rows::{BadRow, Entry, Index, Key, Log, Record, Revision, Row, Seq, Table};
use std::collections::BTreeSet;
use std::sync::Arc;

/// One row as it became.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Change {
    /// Which row.
    pub key: Key,
    /// Its revision; the last one plus one if it was deleted.
    pub revision: Revision,
    /// Its index columns.
    pub index: Index,
    /// Its body; none: the row was deleted.
    pub body: Option<Arc<str>>,
}

impl Change {
    /// The record that the row holds; none if the row was deleted.
    ///
    /// # Errors
    /// If the body is not what its table holds.
    pub fn decode<R: Record>(&self) -> Result<Option<R>, BadRow> {
        self.row().map(|row| row.decode()).transpose()
    }

    /// The row; none if it was deleted.
    pub(crate) fn row(&self) -> Option<Row> {
        let (key, index, body) = (self.key.clone(), self.index.clone(), self.body.clone()?);
        Some(Row { key, revision: self.revision, index, body })
    }

    fn of_row(row: Row) -> Self {
        Self { key: row.key, revision: row.revision, index: row.index, body: Some(row.body) }
    }

    fn of_entry(entry: Entry) -> Option<Self> {
        let key = Key { table: entry.table?, id: entry.subject };
        Some(Self { key, revision: entry.revision, index: entry.index, body: entry.body })
    }
}

/// What a projection keeps of the rows.
pub trait Fold: Send {
    /// The tables it reads. Changes of others never reach [`Fold::apply`].
    fn tables() -> &'static [Table];
    /// Forgets everything; all rows follow.
    fn reset(&mut self);
    /// Takes one row as it became.
    ///
    /// # Errors
    /// If the row does not decode; the projection is built anew at the next call.
    fn apply(&mut self, change: Change) -> Result<(), BadRow>;
}

/// A fold and how far into the feed it has come.
#[derive(Debug)]
pub struct Projection<F> {
    fold: F,
    position: Option<(StoreId, Seq)>,
}

impl<F: Fold> Projection<F> {
    /// A projection that has read nothing yet; the first [`Projection::advance`] builds it.
    pub fn new(fold: F) -> Self {
        Self { fold, position: None }
    }

    /// The fold as of [`Projection::seq`].
    pub fn fold(&self) -> &F {
        &self.fold
    }

    /// How far it has come; 0 before the first build.
    pub fn seq(&self) -> Seq {
        self.position.as_ref().map_or(Seq(0), |(_, seq)| *seq)
    }

    /// Reads the tables whole.
    ///
    /// # Errors
    /// As [`Store::snapshot`], or a row that does not decode.
    pub async fn rebuild(&mut self, store: &dyn Store) -> Result<(), Error> {
        self.position = None;
        let snapshot = store.snapshot(F::tables()).await?;
        self.fold.reset();
        for row in snapshot.rows {
            self.fold.apply(Change::of_row(row))?;
        }
        self.position = Some((store.id().clone(), snapshot.seq));
        Ok(())
    }

    /// Comes up to the store's head. `true` if a row of its tables changed. Builds anew if the cursor has expired or
    /// belongs to another store.
    ///
    /// # Errors
    /// As [`Store::feed`] and [`Projection::rebuild`].
    pub async fn advance(&mut self, store: &dyn Store) -> Result<bool, Error> {
        let Some((_, mut after)) = self.position.take().filter(|(id, _)| id == store.id()) else {
            self.rebuild(store).await?;
            return Ok(true);
        };
        let mut changed = false;
        loop {
            let page = match store.feed(after, &logs::<F>(), FEED_PAGE_MAX).await {
                Ok(page) => page,
                Err(Error::CursorExpired { .. }) => {
                    self.rebuild(store).await?;
                    return Ok(true);
                }
                Err(error) => {
                    self.position = Some((store.id().clone(), after));
                    return Err(error);
                }
            };
            let changes = page.entries.into_iter().filter_map(Change::of_entry);
            for change in changes.filter(|c| F::tables().contains(&c.key.table)) {
                self.fold.apply(change)?;
                changed = true;
            }
            after = page.next;
            if page.next >= page.head {
                self.position = Some((store.id().clone(), after));
                return Ok(changed);
            }
        }
    }
}

/// The logs that changes of the fold's tables are in.
fn logs<F: Fold>() -> Vec<Log> {
    let writers =
        F::tables().iter().flat_map(|table| [Log::of_writer(table.writer()), Log::of_writer(table.born_by())]);
    writers.collect::<BTreeSet<_>>().into_iter().collect()
}
