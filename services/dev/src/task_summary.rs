//! The tasks of a run as their rows say it: those of the run's own client, and beside them those of everybody else.
//!
//! Invariants: nothing here is counted from what was sent or planned.
//! What was over before the run began is neither read nor counted.
//! Called by `dev`, for its client and its report.

use midshift_core::ids::TaskId;
use midshift_core::rows::{BadRow, Key, Log, Row, RowSelection, Seq, Table};
use midshift_core::task::figures::completion_ms;
use midshift_core::task::{Phase, TaskIntake, TaskState};
use midshift_core::time::Utc;
use midshift_store::{Cursor, Error, FEED_PAGE_MAX, Query, Store};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use tokio_util::sync::CancellationToken;

/// Tasks as their rows say it.
#[derive(Debug, Default)]
pub struct Tasks {
    /// How request ids of the run's own client begin.
    run: String,
    /// Number of the newest task when the run began.
    before: u64,
    admitted: BTreeMap<TaskId, Admission>,
    states: BTreeMap<TaskId, (Phase, Option<Utc>)>,
    /// Tasks of the run with both their rows.
    own: BTreeSet<TaskId>,
}

/// When a task was admitted, and whether the run's own client asked for it.
#[derive(Debug)]
struct Admission {
    created: Utc,
    is_own: bool,
}

impl Tasks {
    /// None yet, of a run whose client's request ids begin with `run`.
    /// It began when `before` was the number of the newest task.
    pub fn of_run(run: &str, before: u64) -> Self {
        Self { run: run.to_owned(), before, ..Self::default() }
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
    /// How many tasks are not the run's, of those that are alive or came since it began.
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
    /// Tasks of anybody that succeeded between two moments, UTC, as so many an hour of that clock. Nothing for no time.
    pub fn per_hour(&self, from: Utc, until: Utc) -> f64 {
        let is_within = |ended: &Option<Utc>| ended.is_some_and(|at| from < at && at <= until);
        let states = self.states.values();
        let done = states.filter(|(phase, ended)| *phase == Phase::Succeeded && is_within(ended)).count();
        match until.ms_since(from) {
            0 => 0.0,
            ms => done as f64 * 3_600_000.0 / ms as f64,
        }
    }
    /// Seconds of site time from admission to success of the run's tasks, rising.
    pub fn completions_s(&self) -> Vec<f64> {
        let took = |id: &TaskId| {
            let (phase, ended) = *self.states.get(id)?;
            Some(completion_ms(phase, self.admitted.get(id)?.created, ended)? as f64 / 1000.0)
        };
        let mut took: Vec<f64> = self.own.iter().filter_map(took).collect();
        took.sort_by(f64::total_cmp);
        took
    }
    /// Takes a row as it became. Tasks are never deleted while a run lasts.
    fn apply_row(&mut self, row: &Row) -> Result<(), BadRow> {
        if row.key.table == Table::TaskIntake {
            let intake = row.decode::<TaskIntake>()?;
            let is_own = !self.run.is_empty() && intake.request_id.starts_with(&self.run);
            self.admitted.insert(intake.task_id.clone(), Admission { created: intake.created, is_own });
            self.note_own(&intake.task_id);
        } else {
            let state = row.decode::<TaskState>()?;
            self.states.insert(state.task_id.clone(), (state.phase, state.ended));
            self.note_own(&state.task_id);
        }
        Ok(())
    }
    fn note_own(&mut self, id: &TaskId) {
        if self.states.contains_key(id) && self.admitted.get(id).is_some_and(|a| a.is_own) {
            self.own.insert(id.clone());
        }
    }
}

/// The tasks, shared with whoever looks.
pub type SharedTasks = Arc<Mutex<Tasks>>;

/// Reads something of the tasks under their lock.
pub fn read_tasks<T>(tasks: &SharedTasks, f: impl FnOnce(&Tasks) -> T) -> T {
    f(&tasks.lock().unwrap_or_else(PoisonError::into_inner))
}

/// What the run looks at.
const TABLES: [Table; 2] = [Table::TaskIntake, Table::TaskState];

/// The number of the newest task; what is admitted later has a higher one. 0: there is none.
///
/// # Errors
/// If the store cannot be read.
pub async fn newest_number(store: &dyn Store) -> Result<u64, Error> {
    let query = Query { newest_first: true, limit: 1, ..Query::all(Table::TaskIntake) };
    Ok(store.list(query).await?.first().map_or(Ok(0), |row| row.decode::<TaskIntake>().map(|intake| intake.number))?)
}

/// Reads the tasks anew: those that are alive, and all that were admitted since the run began.
/// Tasks that were over by then cost nothing.
/// Returns where the feed goes on.
async fn read_rows(store: &dyn Store, tasks: &SharedTasks) -> Result<Seq, Error> {
    let live = Phase::ALL.into_iter().filter(|phase| !phase.is_terminal()).map(Phase::number).collect();
    let alive = store.read(&[RowSelection::InStates(Table::TaskState, live)], |_| Vec::new()).await?;
    let (run, before) = read_tasks(tasks, |tasks| (tasks.run.clone(), tasks.before));
    let mut fresh = Tasks::of_run(&run, before);
    for row in &alive.rows {
        fresh.apply_row(row)?;
    }
    let mut after = Some(Cursor { order: before.saturating_add(1).cast_signed(), id: Arc::from("") });
    while after.is_some() {
        let intakes = store.list(Query { after, ..Query::all(Table::TaskIntake) }).await?;
        let states = intakes.iter().map(|row| Key { table: Table::TaskState, id: row.key.id.clone() }).collect();
        for row in intakes.iter().chain(&store.get(states).await?) {
            fresh.apply_row(row)?;
        }
        after = intakes.last().map(Cursor::of_row);
    }
    *tasks.lock().unwrap_or_else(PoisonError::into_inner) = fresh;
    Ok(alive.seq)
}

/// Takes what the feed holds after `seq`; returns where it goes on.
async fn advance(store: &dyn Store, tasks: &SharedTasks, mut seq: Seq) -> Result<Seq, Error> {
    let logs = [Log::Task, Log::Fleet];
    loop {
        let page = match store.feed(seq, &logs, FEED_PAGE_MAX).await {
            Err(Error::CursorExpired { .. }) => return read_rows(store, tasks).await,
            page => page?,
        };
        for entry in page.entries.into_iter().filter(|entry| entry.table.is_some_and(|of| TABLES.contains(&of))) {
            let Some((table, body)) = entry.table.zip(entry.body) else { continue };
            let key = Key { table, id: entry.subject };
            let row = Row { key, revision: entry.revision, index: entry.index, body };
            tasks.lock().unwrap_or_else(PoisonError::into_inner).apply_row(&row)?;
        }
        seq = page.next;
        if page.next >= page.head {
            return Ok(seq);
        }
    }
}

/// Keeps `tasks` as the rows are, until `stop`.
///
/// # Errors
/// If the store cannot be read.
pub async fn follow(store: Arc<dyn Store>, tasks: SharedTasks, stop: CancellationToken) -> Result<(), Error> {
    let mut wake = store.wake();
    let mut seq = read_rows(store.as_ref(), &tasks).await?;
    loop {
        wake.mark_unchanged();
        seq = advance(store.as_ref(), &tasks, seq).await?;
        tokio::select! {
            () = stop.cancelled() => return Ok(()),
            changed = wake.changed() => if changed.is_err() { return Ok(()) },
        }
    }
}

/// Reads the rows once more, for the run of this client, which began when `before` was the newest task.
///
/// # Errors
/// If the store cannot be read.
pub async fn read_once(store: Arc<dyn Store>, run: &str, before: u64) -> Result<Tasks, Error> {
    let tasks = Arc::new(Mutex::new(Tasks::of_run(run, before)));
    read_rows(store.as_ref(), &tasks).await?;
    let mut tasks = tasks.lock().unwrap_or_else(PoisonError::into_inner);
    Ok(std::mem::take(&mut *tasks))
}
