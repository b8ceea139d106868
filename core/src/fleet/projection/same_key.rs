//! Tasks with a coalesce key that no robot has, and nothing holds: of those with one key only the newest stays.
//!
//! `index` puts a task anew when its rows change; `assignment::readiness` ends the older ones.
//! Invariant: what is here depends on the rows alone. The newest is the one that was admitted last; of one number, the one with the larger id.

use crate::ids::TaskId;
use crate::task::{Phase, TaskIntake, TaskState};
use std::collections::{BTreeMap, BTreeSet};

/// Tasks by key.
#[derive(Clone, Debug, Default)]
pub struct SameKey {
    by_key: BTreeMap<String, BTreeSet<(u64, TaskId)>>,
    keys: BTreeMap<TaskId, String>,
    /// Keys of more than one task.
    repeated: BTreeSet<String>,
}

impl SameKey {
    /// Puts a task where its rows say that it stands.
    pub(super) fn put_task(&mut self, task_id: &TaskId, rows: Option<(&TaskState, &TaskIntake)>) {
        let key = rows.filter(|(task, intake)| may_be_replaced(task, intake)).map(|(_, i)| &i.spec.coalesce_key);
        if self.keys.get(task_id) == key {
            return;
        }
        if let Some(old) = self.keys.remove(task_id) {
            self.by_key.entry(old.clone()).or_default().retain(|(_, id)| id != task_id);
            self.count_again(&old);
        }
        if let Some((key, (task, _))) = key.zip(rows) {
            self.keys.insert(task_id.clone(), key.clone());
            self.by_key.entry(key.clone()).or_default().insert((task.number, task_id.clone()));
            self.count_again(key);
        }
    }

    fn count_again(&mut self, key: &str) {
        let tasks = self.by_key.get(key).map_or(0, BTreeSet::len);
        if tasks == 0 {
            self.by_key.remove(key);
        }
        match tasks > 1 {
            true => self.repeated.insert(key.to_owned()),
            false => self.repeated.remove(key),
        };
    }

    /// Tasks that a newer one replaces, each with the newest of its key.
    pub fn replaced(&self) -> impl Iterator<Item = (&TaskId, &TaskId)> {
        self.repeated.iter().filter_map(|key| self.by_key.get(key)).flat_map(|tasks| {
            let newest = tasks.last().map(|(_, id)| id);
            let older = tasks.iter().map(|(_, id)| id).take(tasks.len().saturating_sub(1));
            older.filter_map(move |id| Some((id, newest?)))
        })
    }
}

/// It has a key, no robot has it, and nobody wants it to stay.
fn may_be_replaced(task: &TaskState, intake: &TaskIntake) -> bool {
    let waits = matches!(task.phase, Phase::Queued | Phase::RetryWait | Phase::Suspended);
    waits && task.opened_robot_id.is_none() && task.holds.is_empty() && !intake.spec.coalesce_key.is_empty()
}
