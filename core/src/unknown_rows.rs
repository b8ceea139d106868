//! Keeps aside rows that hold a value of a newer version, such as a state that this build does not know.
//!
//! Called by [`crate::projection`] for every row that a projection takes. Invariants:
//! 1. Such a row is not in the projection, and no decision that touches it reaches the store: it stays as the newer version wrote it.
//! 2. What it is about is not acted on, and whoever asks is told the row and the value.
//! 3. It is read anew whenever it changes.

use crate::ids::{PlaceId, RobotId, TaskId};
use crate::reason::{Code, Reason};
use crate::rows::{BadRow, Key, Revision, Row, Table};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};

/// What can be read of one row that is kept aside.
#[derive(Clone, Debug, PartialEq, Eq)]
struct UnknownRow {
    revision: Revision,
    reason: Reason,
    robots: BTreeSet<RobotId>,
    tasks: BTreeSet<TaskId>,
    /// No person was told yet.
    is_untold: bool,
}

/// Rows kept aside, by key.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct UnknownRows(BTreeMap<Key, UnknownRow>);

impl UnknownRows {
    /// Keeps a row aside that could not be read for this reason.
    pub(crate) fn keep_aside(&mut self, row: &Row, error: &BadRow) {
        let name = format!("{}/{}", row.key.table.name(), row.key.id);
        let body = serde_json::from_str(&row.body).unwrap_or_default();
        let unknown = UnknownRow {
            revision: row.revision,
            reason: Reason::from(Code::RowUnknown).with("row", name).with("value", error.value()),
            robots: robots_of(&row.key, &body),
            tasks: tasks_of(&row.key, &body),
            is_untold: true,
        };
        self.0.insert(row.key.clone(), unknown);
    }
    /// Takes over requests, which no reading of the rows brings again.
    pub fn carry_requests(&mut self, before: &mut Self) {
        let requests = std::mem::take(&mut before.0).into_iter().filter(|(key, _)| key.table == Table::TaskRequest);
        self.0.extend(requests);
    }
    /// The row can be read again, or is gone.
    pub(crate) fn forget(&mut self, key: &Key) {
        self.0.remove(key);
    }
    /// Whether the row is aside as of this revision or a newer one.
    pub(crate) fn has(&self, key: &Key, revision: Revision) -> bool {
        self.0.get(key).is_some_and(|unknown| unknown.revision >= revision)
    }
    /// Why nothing is decided that touches these rows; none: none of them is aside.
    pub fn refusal_of<'a>(&self, mut keys: impl Iterator<Item = &'a Key>) -> Option<&Reason> {
        if self.0.is_empty() {
            return None;
        }
        keys.find_map(|key| self.0.get(key)).map(|unknown| &unknown.reason)
    }
    /// Checks that no row aside is about this robot. A stop or a rule of an area that cannot be read is about all robots.
    ///
    /// # Errors
    /// If there is one; the reason names it.
    pub fn check_robot(&self, robot_id: &RobotId) -> Result<(), Reason> {
        let is_about = |key: &Key, unknown: &UnknownRow| {
            unknown.robots.contains(robot_id) || matches!(key.table, Table::StopRecord | Table::AreaPolicy)
        };
        match self.0.iter().find(|(key, unknown)| is_about(key, unknown)) {
            Some((_, unknown)) => Err(unknown.reason.clone()),
            None => Ok(()),
        }
    }
    /// Whether a row aside is about this robot alone.
    pub fn names(&self, robot_id: &RobotId) -> bool {
        self.0.values().any(|unknown| unknown.robots.contains(robot_id))
    }
    /// Why a task is not acted on; none: no row aside is about it.
    pub fn of_task(&self, task_id: &TaskId) -> Option<&Reason> {
        self.0.values().find(|unknown| unknown.tasks.contains(task_id)).map(|unknown| &unknown.reason)
    }
    /// Whether the row of a place is aside.
    pub fn is_place_aside(&self, place_id: &PlaceId) -> bool {
        !self.0.is_empty() && self.0.contains_key(&Key::new(Table::PlaceGrant, place_id.as_str()))
    }
    /// Places of which a block is aside: nobody knows whether it holds.
    pub fn blocked_places(&self) -> impl Iterator<Item = PlaceId> + '_ {
        let blocks = self.0.keys().filter(|key| key.table == Table::PlaceBlock);
        blocks.filter_map(|key| PlaceId::parse(&key.id).ok())
    }
    /// What no person was told of yet, each once, with a robot that it is about.
    pub fn take_untold(&mut self) -> Vec<(Reason, Option<RobotId>)> {
        let untold =
            self.0.values_mut().filter_map(|unknown| std::mem::take(&mut unknown.is_untold).then_some(unknown));
        untold.map(|unknown| (unknown.reason.clone(), unknown.robots.first().cloned())).collect()
    }
}

/// Why a row cannot be read, for whoever reads it by itself.
pub fn reason(row: &Row, error: &BadRow) -> Reason {
    let mut rows = UnknownRows::default();
    rows.keep_aside(row, error);
    rows.take_untold().pop().map_or_else(|| Code::RowUnknown.into(), |(reason, _)| reason)
}

fn robots_of(key: &Key, body: &Value) -> BTreeSet<RobotId> {
    let holders = body["holders"].as_array().into_iter().flatten().map(|holder| &holder["robot_id"]);
    let named = holders.chain([&body["robot_id"]]).filter_map(Value::as_str);
    let own = match key.table {
        Table::RobotAuthority | Table::RobotControl | Table::Session => Some(&*key.id),
        _ => None,
    };
    named.chain(own).filter_map(|id| RobotId::parse(id).ok()).collect()
}

fn tasks_of(key: &Key, body: &Value) -> BTreeSet<TaskId> {
    let own = matches!(key.table, Table::TaskState | Table::TaskIntake).then_some(&*key.id);
    // A request says it below the word of what is asked.
    let asked = body["ask"].as_object().into_iter().flatten().map(|(_, ask)| ask);
    let listed = asked.clone().filter_map(|ask| ask["task_ids"].as_array()).flatten();
    let named = asked.map(|ask| &ask["task_id"]).chain(listed).chain([&body["task_id"]]).filter_map(Value::as_str);
    own.into_iter().chain(named).filter_map(|id| TaskId::parse(id).ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::UnknownRows;
    use crate::ids::TaskId;
    use crate::rows::{Index, Key, Revision, Row, Table};
    use crate::task::{TaskRequest, TaskState};

    #[test]
    fn a_request_that_cannot_be_read_is_carried_into_the_next_reading_of_rows_and_a_row_is_read_there() {
        let aside = |rows: &mut UnknownRows, table, body: &str| {
            let row =
                Row { key: Key::new(table, "T2"), revision: Revision(1), index: Index::default(), body: body.into() };
            let error = match table {
                Table::TaskRequest => row.decode::<TaskRequest>().err(),
                _ => row.decode::<TaskState>().err(),
            };
            rows.keep_aside(&row, &error.expect("a word of a newer version"));
        };
        let (mut before, mut next) = (UnknownRows::default(), UnknownRows::default());
        aside(&mut before, Table::TaskRequest, r#"{"ask":{"lend":{"task_ids":["T1"]}}}"#);
        aside(&mut before, Table::TaskState, "{}");
        next.carry_requests(&mut before);
        let is_aside = |id: &str| next.of_task(&TaskId::parse(id).expect("an id")).is_some();
        assert_eq!(["T1", "T2"].map(is_aside), [true, false]);
    }
}
