//! Ready tasks with a coalesce key: of those with one key only the newest stays.
//!
//! `index` puts a task anew when its rows change; `assignment::readiness` ends the older ones.
//! Invariant: what is here depends on the rows alone. The newest has the largest admission number; of one number, the larger id.

use crate::ids::{AreaId, TaskId};
use crate::site::Site;
use crate::task::{TaskIntake, TaskState};
use std::collections::{BTreeMap, BTreeSet};

/// The key that a caller chose, and the areas that the task goes to: whoever may send it there may cancel it there.
type Key = (String, BTreeSet<AreaId>);

/// Tasks by key.
#[derive(Clone, Debug, Default)]
pub struct SameKey {
    by_key: BTreeMap<Key, BTreeSet<(u64, TaskId)>>,
    keys: BTreeMap<TaskId, (Key, u64)>,
    /// Keys of more than one task.
    repeated: BTreeSet<Key>,
}

impl SameKey {
    /// Puts a task, with its rows if it is ready, where these say that it stands.
    pub(super) fn put_task(&mut self, task_id: &TaskId, ready: Option<(&TaskState, &TaskIntake)>, site: &Site) {
        // What is opened is bound to its robot.
        let rows = ready.filter(|(task, i)| task.opened_robot_id.is_none() && !i.spec.coalesce_key.is_empty());
        let new = rows.map(|(task, i)| ((i.spec.coalesce_key.clone(), site.areas_of_task(&i.spec)), task.number));
        if self.keys.get(task_id) == new.as_ref() {
            return;
        }
        if let Some((key, number)) = self.keys.remove(task_id) {
            if let Some(tasks) = self.by_key.get_mut(&key) {
                tasks.remove(&(number, task_id.clone()));
            }
            self.count_again(&key);
        }
        if let Some((key, number)) = new {
            self.by_key.entry(key.clone()).or_default().insert((number, task_id.clone()));
            self.count_again(&key);
            self.keys.insert(task_id.clone(), (key, number));
        }
    }

    fn count_again(&mut self, key: &Key) {
        let tasks = self.by_key.get(key).map_or(0, BTreeSet::len);
        if tasks == 0 {
            self.by_key.remove(key);
        }
        match tasks > 1 {
            true => self.repeated.insert(key.clone()),
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
