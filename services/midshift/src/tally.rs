//! The tasks of a run as their rows say it: those of the run's own client, and beside them those of everybody else.
//!
//! Invariant: nothing here is counted from what was sent or planned. Called by `dev`, for its client and its report.

use midshift_core::ids::TaskId;
use midshift_core::rows::{BadRow, Table};
use midshift_core::task::{Phase, TaskIntake, TaskState};
use midshift_core::time::Utc;
use midshift_store::{Change, Error, Fold, Projection, Store};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use tokio_util::sync::CancellationToken;

/// Tasks as their rows say it.
#[derive(Debug, Default)]
pub struct Tasks {
    /// How request ids of the run's own client begin.
    run: String,
    asked: BTreeMap<TaskId, Asked>,
    states: BTreeMap<TaskId, (Phase, Option<Utc>)>,
    /// Tasks of the run with both their rows.
    own: BTreeSet<TaskId>,
}

#[derive(Debug)]
struct Asked {
    created: Utc,
    is_own: bool,
}

impl Tasks {
    /// None yet, of a run whose client's request ids begin with `run`.
    pub fn of_run(run: &str) -> Self {
        Self { run: run.to_owned(), ..Self::default() }
    }
    /// How many of the run's tasks are in one of these phases.
    pub fn count(&self, wanted: impl Fn(Phase) -> bool) -> usize {
        self.own.iter().filter_map(|id| self.states.get(id)).filter(|(phase, _)| wanted(*phase)).count()
    }
    /// The run's tasks.
    pub fn own(&self) -> impl Iterator<Item = &TaskId> {
        self.own.iter()
    }
    /// How many they are.
    pub fn own_count(&self) -> usize {
        self.own.len()
    }
    /// How many tasks are not the run's.
    pub fn of_others(&self) -> usize {
        self.states.len() - self.own.len()
    }
    /// Whether this is a task of the run.
    pub fn has(&self, id: &TaskId) -> bool {
        self.own.contains(id)
    }
    /// Tasks of anybody that are neither over nor waiting for a person.
    pub fn open(&self) -> usize {
        let leads_on = |p: Phase| !p.is_terminal() && p != Phase::NeedsOperator;
        self.states.values().filter(|(phase, _)| leads_on(*phase)).count()
    }
    /// Whether a task is not over.
    pub fn is_live(&self, id: &TaskId) -> bool {
        self.states.get(id).is_some_and(|(phase, _)| !phase.is_terminal())
    }
    /// Seconds of site time from admission to success of the run's tasks, rising.
    pub fn completions_s(&self) -> Vec<f64> {
        let took = |id: &TaskId| {
            let ended = self.states.get(id).filter(|(phase, _)| *phase == Phase::Succeeded)?.1?;
            Some(ended.ms_since(self.asked.get(id)?.created) as f64 / 1000.0)
        };
        let mut took: Vec<f64> = self.own.iter().filter_map(took).collect();
        took.sort_by(f64::total_cmp);
        took
    }
    fn meet(&mut self, id: &TaskId) {
        if self.states.contains_key(id) && self.asked.get(id).is_some_and(|a| a.is_own) {
            self.own.insert(id.clone());
        }
    }
}

/// The tasks, shared with whoever looks.
pub type SharedTasks = Arc<Mutex<Tasks>>;

/// Looks at the tasks.
pub fn look<T>(tasks: &SharedTasks, f: impl FnOnce(&Tasks) -> T) -> T {
    f(&tasks.lock().unwrap_or_else(PoisonError::into_inner))
}

struct Keeper(SharedTasks);

impl Fold for Keeper {
    fn tables() -> &'static [Table] {
        &[Table::TaskIntake, Table::TaskState]
    }
    fn reset(&mut self) {
        let mut tasks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *tasks = Tasks::of_run(&tasks.run);
    }
    fn apply(&mut self, change: Change) -> Result<(), BadRow> {
        let mut tasks = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if change.key.table == Table::TaskIntake {
            if let Some(intake) = change.decode::<TaskIntake>()? {
                let is_own = !tasks.run.is_empty() && intake.request_id.starts_with(&tasks.run);
                tasks.asked.insert(intake.task_id.clone(), Asked { created: intake.created, is_own });
                tasks.meet(&intake.task_id);
            }
        } else if let Some(state) = change.decode::<TaskState>()? {
            tasks.states.insert(state.task_id.clone(), (state.phase, state.ended));
            tasks.meet(&state.task_id);
        }
        Ok(())
    }
}

/// Keeps `tasks` as the rows are, until `stop`.
pub async fn follow(store: Arc<dyn Store>, tasks: SharedTasks, stop: CancellationToken) -> Result<(), Error> {
    let mut projection = Projection::new(Keeper(tasks));
    let mut wake = store.wake();
    loop {
        wake.mark_unchanged();
        projection.advance(store.as_ref()).await?;
        tokio::select! {
            () = stop.cancelled() => return Ok(()),
            changed = wake.changed() => if changed.is_err() { return Ok(()) },
        }
    }
}

/// Reads all rows once more, for the run of this client.
pub async fn settle(store: Arc<dyn Store>, run: &str) -> Result<Tasks, Error> {
    let tasks = Arc::new(Mutex::new(Tasks::of_run(run)));
    Projection::new(Keeper(tasks.clone())).advance(store.as_ref()).await?;
    let mut tasks = tasks.lock().unwrap_or_else(PoisonError::into_inner);
    Ok(std::mem::take(&mut *tasks))
}
