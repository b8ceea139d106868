//! Skips rows with a value of a newer version, for code that only reads them: each is logged once, and the others are read.
//!
//! Invariant: a row that is damaged is an error. Called by folds and followers. Absent on purpose: code that decides by such rows keeps them aside instead
//! (`midshift_core::unknown_rows`).

use crate::Change;
use midshift_core::rows::{BadRow, Key, Record, Row};
use std::collections::BTreeSet;

/// The rows that were skipped when they were read last.
#[derive(Clone, Debug, Default)]
pub struct SkippedRows(BTreeSet<Key>);

impl SkippedRows {
    /// The record that a row holds; none: it holds a value that this build does not know.
    ///
    /// # Errors
    /// A row that is damaged.
    pub fn read<R: Record>(&mut self, row: &Row) -> Result<Option<R>, BadRow> {
        match row.decode() {
            Ok(record) => {
                self.0.remove(&row.key);
                Ok(Some(record))
            }
            Err(error) if error.is_unknown() => {
                if self.0.insert(row.key.clone()) {
                    let (table, id, value) = (row.key.table.name(), &*row.key.id, error.value());
                    tracing::warn!(table, id, value, "a row of a newer version is left out");
                }
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// The same of a row as it became; none also: it was deleted.
    ///
    /// # Errors
    /// A row that is damaged.
    pub fn read_change<R: Record>(&mut self, change: &Change) -> Result<Option<R>, BadRow> {
        let Some(row) = change.row() else {
            self.0.remove(&change.key);
            return Ok(None);
        };
        self.read(&row)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use midshift_core::presence::PresenceRow;
    use midshift_core::rows::{Index, Revision};

    #[test]
    fn a_value_of_a_newer_version_is_left_out_until_it_can_be_read_and_damage_is_an_error() {
        let mut skipped = SkippedRows::default();
        let mut read = |presence: &str| {
            let body = format!("{{\"robot_id\":\"r1\",\"presence\":{presence},\"since_unix_ms\":1}}");
            let key = Key::new(PresenceRow::TABLE, "r1");
            let row = Row { key, revision: Revision(1), index: Index::default(), body: body.into() };
            skipped.read::<PresenceRow>(&row).map(|row| (row.is_some(), skipped.0.len()))
        };
        assert_eq!(read("\"floating\"").ok(), Some((false, 1)));
        assert_eq!(read("\"floating\"").ok(), Some((false, 1)), "said once");
        assert!(read("").is_err());
        assert_eq!(read("\"online\"").ok(), Some((true, 0)));
    }
}
