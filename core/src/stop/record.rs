//! The copy of a stop that services read: written by what follows the stop service, which itself never sees the store.

use super::latch::{Reset, Stop};
use crate::rows::{Index, Record, Table};
use serde::{Deserialize, Serialize};

/// One stop and its reset.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopRecord {
    /// As it was engaged.
    pub stop: Stop,
    /// As it was reset; none: it is effective.
    pub reset: Option<Reset>,
}

impl StopRecord {
    /// It is engaged and not reset.
    pub const fn is_effective(&self) -> bool {
        self.reset.is_none()
    }
}

impl Record for StopRecord {
    const TABLE: Table = Table::StopRecord;
    fn id(&self) -> String {
        self.stop.stop_id.to_string()
    }
    fn index(&self) -> Index {
        Index { state: Some(i64::from(self.is_effective())), order: Some(self.stop.engaged.0), ..Index::default() }
    }
}
